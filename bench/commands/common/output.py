"""What several commands print: tables, texts, numbers for programs, and progress beyond a second."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table


def plain_table(*columns: str, right: Collection[str] = (), title: str | None = None, **style: Any) -> Table:
    """Return a table with a rule below its head; the columns in `right` are of numbers."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=title, **style)
    for column in columns:
        table.add_column(column, justify="right" if column in right else "left", overflow="fold")
    return table


def console_of(piped_width: int) -> Console:
    """Return the terminal, or what writes `piped_width` columns into a file or pipe."""
    console = Console()
    return console if console.is_terminal else Console(width=piped_width)


def write_text(text: str, output: Path | None) -> None:
    """Write `text` whole to the file `output`, or to standard output without one."""
    from bench.base.atomic_file import atomic_file

    if output is None:
        return typer.echo(text, nl=False)
    with atomic_file(output) as stream:
        stream.write(text.encode())


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
