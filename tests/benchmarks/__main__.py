"""Run a benchmark: `python -m tests.benchmarks [--keep] [NAME [OPTION ...]]`, or `make benchmark`.

Each benchmark is a file here with `run(arguments) -> list[Row]`; its options: `python -m tests.benchmarks
loop_timing --help`. `--keep` writes its figures to `tests/results/`. Exit code 1 when a promised figure is
missed.
"""

from __future__ import annotations

import importlib
import sys

from rich.console import Console
from rich.table import Table

from tests.benchmarks.results import keep, provenance
from tests.benchmarks.row import Row

BENCHMARKS = (
    "adversary",
    "campaign_kills",
    "campaign_speed",
    "campaign_statistics",
    "canopen_commissioning",
    "canopen_reactions",
    "command_fuzz",
    "commissioning",
    "during_stops",
    "dynamics_speed",
    "frame_fuzz",
    "healthy_swings",
    "impact",
    "kills",
    "launch_monitor_fuzz",
    "learning",
    "loop_timing",
    "native_fuzz",
    "reactions",
    "sdo_fuzz",
    "soak",
)


def show(rows: list[Row], console: Console) -> None:
    """Print `rows`, a table for each benchmark."""
    for title in dict.fromkeys(row.benchmark for row in rows):
        table = Table("figure", title=title, title_justify="left", title_style="bold", expand=False)
        table.add_column("value", justify="right")
        table.add_column("promised", justify="right")
        table.add_column("note", style="dim")
        for row in (row for row in rows if row.benchmark == title):
            style = "" if row.holds else "bold red"
            value = f"{row.value:,.4g}" if abs(row.value) < 1e4 else f"{row.value:,.0f}"
            table.add_row(
                row.name,
                f"{value} {row.unit}".strip(),
                row.promise,
                row.note,
                style=style,
            )
        console.print(table)


def main() -> int:
    """Run the given benchmark, by default dynamics_speed."""
    arguments = sys.argv[1:]
    kept = arguments[:1] == ["--keep"]
    name, *options = arguments[kept:] or ["dynamics_speed"]
    if name not in BENCHMARKS:
        print(f"no benchmark {name}; there are: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    console, made = Console(), provenance() if kept else ""
    rows: list[Row] = importlib.import_module(f"tests.benchmarks.{name}").run(options)
    show(rows, console)
    if kept:
        console.print(f"kept: {keep(name, options, rows, made)}")
    return verdict(rows, console)


def verdict(rows: list[Row], console: Console) -> int:
    """Print the figures that miss their promise; return the exit code."""
    missed = [row for row in rows if not row.holds]
    for row in missed:
        console.print(f"[bold red]missed[/] {row.benchmark}: {row.name}: {row.value:.4g} {row.unit}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
