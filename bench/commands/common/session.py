"""The global options, as every command sees them."""

from __future__ import annotations

import getpass
import json
import socket
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bench.base.errors import ExitCode

if TYPE_CHECKING:
    from bench.base.address import BenchAddress
    from bench.config import Configuration
    from bench.network.client import BenchClient


def user_name() -> str:
    """Return the default name of who commands, user@host."""
    return f"{getpass.getuser()}@{socket.gethostname()}"


def at_terminal() -> bool:
    """Return whether a person can answer questions."""
    return sys.stdin is not None and sys.stdin.isatty()


def exit_unless(holds: object) -> None:
    """End the command with REFUSED unless its result `holds`; the output already states the reason."""
    if not holds:
        raise typer.Exit(ExitCode.REFUSED)


def show_json(content: Any) -> None:
    """Print `content` as JSON for a program."""
    typer.echo(json.dumps(content, indent=2))


@dataclass
class Session:
    """`typer.Context.obj` in every command."""

    config: Path | None = None
    """Requested configuration, a path or a variant's name; None means the default one."""
    debug: bool = False
    kept: Callable[[bool], BenchClient] | None = None
    """Client of the console's connection, for a stop (True) also of a silent bench."""

    def configuration(self) -> Configuration:
        """Return the checked configuration.

        Raises:
            BenchError: its file is missing, cannot be read, or is no TOML.
            ExceptionGroup: BenchErrors, one for each mistake in it.
        """
        from bench.config import load_configuration

        return load_configuration(self.config)

    def address(self) -> BenchAddress:
        """Return name and addresses of the bench; the rest of the configuration is not read.

        Raises: as `configuration`.
        """
        from bench.base.address import load_address

        return load_address(self.config)

    def connect(self, *, stopping: bool = False) -> AbstractContextManager[BenchClient]:
        """Return a client for a `with`: on the console's connection, or on one that ends with the block.

        Raises:
            NoAnswer: there is no connection, or the console's bench is silent and this is not for `stopping`.
        """
        if self.kept is not None:
            return nullcontext(self.kept(stopping))
        from bench.network.client import BenchClient

        return BenchClient.connect(self.address())
