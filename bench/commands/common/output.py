"""What several commands print: tables, texts in a file or on the terminal, numbers for programs."""

from __future__ import annotations

from collections.abc import Collection
from math import isfinite
from pathlib import Path
from typing import Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
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
    """Write `text` to the file `output`, or to standard output without one."""
    if output is None:
        typer.echo(text, nl=False)
    else:
        output.write_text(text, encoding="utf-8")


def finite(value: Any) -> Any:
    """Return `value` for JSON: None for a float that is no number, or infinite."""
    return None if isinstance(value, float) and not isfinite(value) else value
