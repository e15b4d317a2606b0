"""Parts that all commands share: the global options, common options and arguments, and the sweeps' engine."""

from __future__ import annotations

import getpass
import json
import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError, ExitCode

if TYPE_CHECKING:
    from bench.base.address import BenchAddress
    from bench.config import Configuration
    from bench.network.client import BenchClient
    from bench.simulation.sweep import Engine


def user_name() -> str:
    """Return the default name of who commands, user@host; the user's number where it has no name."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}"


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


def option(
    text: str,
    metavar: str | None = None,
    *,
    low: float | None = None,
    high: float | None = None,
    shown: str | bool = True,
    names: str | tuple[str, ...] = (),
) -> Any:
    """Return an option with a value from `low` to `high`; `shown` stands for its default in the help.

    `names` are those of the parameter unless given.
    """
    given = (names,) if isinstance(names, str) else names
    return typer.Option(*given, metavar=metavar, help=text, min=low, max=high, show_default=shown)


def flag(name: str, text: str) -> Any:
    """Return an option without a value."""
    return typer.Option(name, help=text)


def argument(
    metavar: str, text: str, *, shown: str | bool = True, complete: Callable[..., list[str]] | None = None
) -> Any:
    """Return an argument; `shown` stands for its default in the help, `complete` returns known values."""
    return typer.Argument(metavar=metavar, help=text, show_default=shown, autocompletion=complete)


def known_profiles() -> list[str]:
    """Return the names of the profiles that come with golfbench."""
    from bench.swing.library import profile_names

    return profile_names()


Json = Annotated[bool, flag("--json", "Print JSON.")]
ClubName = Annotated[str | None, option("Club of the configuration.", "NAME", shown="the mounted one")]
"""Option of a command that simulates: this club on its site instead of the mounted one."""
ProfileName = Annotated[
    str | None,
    argument("PROFILE", "Name or path of a profile.", shown="the configuration's", complete=known_profiles),
]
"""Argument of a command that tries a swing: this profile instead of the configuration's."""
Plot = Annotated[Path | None, option("Also plot it: .png, .svg or .pdf.", "FILE")]


def require_picture(plot: Path | None) -> None:
    """Raise BenchError unless the suffix of `plot` is that of a picture, and its folder is there."""
    if plot is not None and plot.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise BenchError(
            "--plot",
            str(plot),
            "a name that ends in .png, .svg or .pdf",
            "Give --plot a name such as plot.png.",
        )
    require_folder("--plot", plot)


def require_folder(name: str, file: Path | None) -> None:
    """Raise BenchError unless the folder of `file`, the value of option `name`, is there: before any work."""
    if file is not None and not file.parent.is_dir():
        action = "Make the folder, or name a file in another one."
        raise NotStored(name, str(file), f"a file in a folder that exists, not {file.parent}", action)


Processes = Annotated[int, option("Number of processes; 0: one per core.", low=0)]
ClusterAddress = Annotated[
    str,
    option(
        "Scheduler of a cluster that runs it instead, tcp://HOST:PORT or tls://HOST:PORT.",
        "ADDRESS",
        names="--cluster",
    ),
]


@contextmanager
def sweep_engine(configuration: Configuration, processes: int, cluster: str, cases: int) -> Iterator[Engine]:
    """Yield the engine for so many `cases`.

    Raises:
        BenchError: the cluster is not there, or a certificate for it.
    """
    from bench.base.address import identity_files
    from bench.simulation.sweep import local_engine

    if not cluster:
        yield local_engine(processes, cases)
        return
    scheme, separator, rest = cluster.partition("://")
    if scheme not in ("tcp", "tls") or not separator or not rest:
        expected = "tcp://HOST:PORT or tls://HOST:PORT"
        raise BenchError("--cluster", repr(cluster), expected, "Copy what golfbench cluster says.")
    from bench.simulation.cluster_engine import connected

    files = identity_files(configuration.network.identity) if scheme == "tls" else None
    with connected(cluster, files) as engine:
        yield engine
