"""The progress bar of anything that takes longer than a second."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


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
