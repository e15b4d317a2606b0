"""The progress bar of anything that takes longer than a second."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


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
