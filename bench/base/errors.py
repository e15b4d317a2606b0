"""Errors for users: location, found value, expected value, action."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from enum import IntEnum
from importlib import import_module
from typing import Any

FOR_PROGRAMS = "GOLFBENCH_ERRORS"
"""Variable of the environment: with "json" the command line prints each error as a JSON object in a line."""


class ExitCode(IntEnum):
    """The exit codes of the command line, the same for every command."""

    OK = 0
    REFUSED = 1
    """The command ran, and the result is negative."""
    BAD_INPUT = 2
    """Wrong usage, or an invalid configuration, profile or file."""
    DEVICE = 69
    """A device or a service the command needs cannot do its work."""
    INTERNAL = 70
    """An error in golfbench itself."""
    FILE = 74
    """A file or folder cannot be read or written."""
    NO_ANSWER = 75
    """The bench does not answer: denied or not running."""
    INTERRUPTED = 130
    """Ctrl-C."""
    TERMINATED = 143
    """SIGTERM, as systemd and `kill` send it."""


class BenchError(Exception):
    """Invalid external input, with what its owner needs to correct it. Exits with BAD_INPUT.

    Args:
        location: file and key, option, or device.
        found: the value found there.
        expected: valid values, with their unit.
        action: what to do.
        code: exit code in place of that of its class.
    """

    exit_code = ExitCode.BAD_INPUT

    def __init__(
        self, location: str, found: str, expected: str, action: str, *, code: ExitCode | None = None
    ) -> None:
        super().__init__(location, found, expected, action)
        self.location, self.found, self.expected, self.action = location, found, expected, action
        self.exit_code = code or self.exit_code

    def __str__(self) -> str:
        return f"{self.location}: found {self.found}, expected {self.expected}. {self.action}"

    def record(self) -> dict[str, str]:
        """Return the parts by their names."""
        return {name: getattr(self, name) for name in ("location", "found", "expected", "action")}


class Refused(BenchError):
    """Valid input whose action is refused: it is unsafe, or not possible now."""

    exit_code = ExitCode.REFUSED


def did_you_mean(wanted: str, known: Iterable[str], otherwise: str) -> str:
    """Return the action for an unknown name: the nearest of the `known` ones, else `otherwise`."""
    near = get_close_matches(wanted, list(known), n=1)
    return f"Did you mean {near[0]}?" if near else otherwise


def load_extra(module: str, extra: str, location: str, otherwise: str = "") -> Any:
    """Return `module`, of a package that golfbench's `extra` installs.

    Raises:
        BenchError: at `location`: it is not installed; `otherwise` says what goes without it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        found, action = f"package {package} is not installed ({error})", f'pip install "golfbench[{extra}]"'
        raise BenchError(location, found, f"the package {package}", f"Run {action}{otherwise}.") from error
