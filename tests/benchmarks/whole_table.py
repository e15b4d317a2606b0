"""Tables printed whole: a pipe counts as 80 columns, in which a wide table loses its figures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

_WIDEST = 400
"""Columns."""


def print_whole(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print `rows` below `columns`, as wide as they need, all but the first column aligned to the right."""
    table = Table(title=title, title_justify="left", title_style="bold")
    for number, column in enumerate(columns):
        table.add_column(column, justify="left" if number == 0 else "right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print_table(table)


def print_table(table: Table) -> None:
    """Print `table` as wide as it needs."""
    needed = Console(width=_WIDEST).measure(table).maximum
    Console(width=max(needed, Console().width)).print(table, highlight=False)
