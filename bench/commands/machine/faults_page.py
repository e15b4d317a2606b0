"""A fault matrix as a table for the terminal, and as one HTML page with a heat map."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import jinja2
from rich.table import Table

from bench.faults.hazard_file import next_swing_text
from bench.faults.summary import PHASES

_MARKS = {
    "irrelevant": "·",
    "harmless": "○",
    "safe": "●",
    "undetected": "?",
    "unsafe": "[bold red]✗[/bold red]",
}


def matrix_table(summary: dict[str, Any]) -> Table:
    """Return one row a fault and one column a phase, the worst verdict of each."""
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in summary["verdicts"].items())
    table = Table(
        title=f"{summary['cases']} cases: {verdicts}; {summary['left_out_by_rule']} pairs left out by rule",
        caption="● detected and safe  ○ harmless  ? undetected, another shot or pose  "
        "✗ unsafe  · left out by rule",
    )
    table.add_column("fault")
    for phase in PHASES:
        table.add_column(phase.replace("-", "\n"), justify="center")
    for heading in ("ticks", "most energy"):
        table.add_column(heading, justify="right")
    for row in summary["rows"]:
        ticks = row["detection_ticks"]
        table.add_row(
            row["breakage"],
            *(_MARKS[row["phases"].get(phase, {}).get("verdict", "irrelevant")] for phase in PHASES),
            f"{ticks[0]}-{ticks[-1]}" if ticks else "",
            f"{100 * row['worst_stop']:.0f} %" if row["worst_stop"] else "",
        )
    return table


def reasons_table(summary: dict[str, Any]) -> Table:
    """Return the faults that end unsafe, with instants and reasons."""
    table = Table("fault", "unsafe", "reasons", title="Unsafe ends", box=None)
    for row in summary["rows"]:
        if unsafe := row["verdicts"].get("unsafe", 0):
            table.add_row(row["breakage"], str(unsafe), "\n".join(row["reasons"][:4]))
    return table


def matrix_page(summary: dict[str, Any], comparison: list[dict[str, Any]] | None = None) -> str:
    """Return the page: one file without external resources."""
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((files("bench.faults") / "page.html.j2").read_text(encoding="utf-8"))
    return template.render(
        summary=summary, next_swing=next_swing_text(summary), phases=PHASES, comparison=comparison or []
    )
