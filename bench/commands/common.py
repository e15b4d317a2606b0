"""Parts that all commands share: options, arguments, output, progress, and the engine of sweeps."""

from __future__ import annotations

import getpass
import json
import os
import socket
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from bench.base.atomic_file import NotStored, write_whole
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


def discard_typed() -> None:
    """Discard keys typed at the terminal: they do not answer the next prompt."""
    if at_terminal():
        import termios

        termios.tcflush(sys.stdin, termios.TCIFLUSH)


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
    """Source of the console's client; True: for a stop, also after loss of communication."""

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
            NoAnswer: no connection, or, unless `stopping`, loss of communication with the console's bench.
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
        expected, action = "a name that ends in .png, .svg or .pdf", "Give --plot a name such as plot.png."
        raise BenchError("--plot", str(plot), expected, action)
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


def show_result(json_: bool, content: Any, *shown: Any) -> None:
    """Print `content` as JSON for a program, or `shown` for people: texts and tables."""
    if json_:
        return show_json(content)
    console = Console()
    for one in shown:
        console.print(one, highlight=False)


def plain_table(
    *columns: str,
    rows: Iterable[Iterable[Any]] = (),
    right: Collection[str] = (),
    title: str | None = None,
    **style: Any,
) -> Table:
    """Return a table of `rows` with a rule below its head; the columns in `right` are of numbers."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=title, **style)
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


def console_of(piped_width: int) -> Console:
    """Return the terminal, or what writes `piped_width` columns into a file or pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=piped_width)


def write_text(text: str, output: Path | None) -> None:
    """Write `text` whole to the file `output`, or to standard output without one."""
    if output is None:
        return typer.echo(text, nl=False)
    write_whole(output, text)


def finite(value: Any) -> Any:
    """Return `value` for JSON: None for a float that is no number, or infinite."""
    return None if isinstance(value, float) and not isfinite(value) else value


def progress_bar() -> Progress:
    """Return a bar on standard error that goes away at its end; nothing when that is no terminal.

    Use it as a context: `with progress_bar() as progress: task = progress.add_task(text, total=n)`.
    """
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )


@contextmanager
def paused(bar: Progress) -> Iterator[None]:
    """Take `bar` off the screen while a person is asked."""
    bar.stop()
    try:
        yield
    finally:
        bar.start()


@contextmanager
def progress_of(text: str, total: float = 1.0) -> Iterator[Callable[[float], None]]:
    """Yield a function that shows how much of `text` is done."""
    with progress_bar() as bar:
        task = bar.add_task(text, total=total)
        yield lambda done: bar.update(task, completed=done)
        bar.update(task, completed=total)


@contextmanager
def progress_of_steps() -> Iterator[Callable[..., None]]:
    """Yield a function of a step's text, how much of it is done, and its total, by default 1."""
    with progress_bar() as bar:
        tasks: dict[str, TaskID] = {}

        def show(step: str, done: float, total: float = 1.0) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step, total=total)
            bar.update(tasks[step], completed=done)

        yield show
