"""Run the benchmarks: `python -m tests.benchmarks [NAME ...] [--json FILE]`, or `make benchmark`.

Each benchmark is a file here with `run() -> list[Row]`. Long ones run only when they are named, and take
options of their own: `python -m tests.benchmarks loop_timing --help`. Exit code 1 when a promised figure is
missed.
"""

from __future__ import annotations

import argparse
import importlib
import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.benchmarks.row import Row

BENCHMARKS = (
    "model_calls",
    "dynamics_speed",
    "equal_error",
    "lockstep",
    "shared_memory",
    "canopen_driver",
    "canopen_socket",
    "feed_forward",
    "model_check",
)
LONG = (
    "impact",
    "bag_swings",
    "bag_learning",
    "bag_speeds",
    "loop_timing",
    "command_fuzz",
    "frame_fuzz",
    "native_fuzz",
    "sdo_fuzz",
    "launch_monitor_fuzz",
    "campaign_statistics",
    "carry_and_rules",
    "campaign_verdicts",
    "paired_differences",
    "reactions",
    "adversary",
    "healthy_swings",
    "during_stops",
    "homing_offsets",
    "air_at_address",
    "stuck_valves",
    "sweeps",
    "canopen_reactions",
    "canopen_bus",
    "kills",
    "recorder_kills",
    "telemetry_age",
    "telemetry_viewer",
    "page_views",
    "soak",
    "campaign_kills",
    "campaign_speed",
    "campaign_detection",
    "campaign_examples",
    "campaign_show",
    "commissioning",
    "learning",
    "identified",
    "swing_design",
    "machine_gains",
)
"""Their `run` takes the rest of the command line."""
PACKAGES = ("numpy", "numba", "mujoco", "pin", "eclipse-zenoh")


def machine() -> dict[str, str]:
    """Return what the figures depend on: processor, Python, versions."""
    cpuinfo = Path("/proc/cpuinfo")
    models = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
    processor = models[0].split(":", 1)[1].strip() if models else platform.processor()
    return {
        "processor": processor,
        "system": platform.platform(),
        "python": platform.python_version(),
        **{package: version(package) for package in PACKAGES},
    }


def show(rows: list[Row], console: Console) -> None:
    """Print `rows`, a table for each benchmark."""
    for title in dict.fromkeys(row.benchmark for row in rows):
        table = Table("figure", title=title, title_justify="left", title_style="bold", expand=False)
        table.add_column("value", justify="right")
        table.add_column("promised", justify="right")
        table.add_column("note", style="dim")
        for row in (row for row in rows if row.benchmark == title):
            promise = (
                "" if row.at_least is None else f"at least {row.at_least:g}",
                "" if row.at_most is None else f"at most {row.at_most:g}",
            )
            style = "" if row.holds else "bold red"
            value = f"{row.value:,.4g}" if abs(row.value) < 1e4 else f"{row.value:,.0f}"
            table.add_row(
                row.name,
                f"{value} {row.unit}".strip(),
                " ".join(filter(None, promise)),
                row.note,
                style=style,
            )
        console.print(table)


def main() -> int:
    """Run the named benchmarks, or all but the long ones."""
    console = Console()
    rows: list[Row] = []
    if sys.argv[1:2] and sys.argv[1] in LONG:
        rows = importlib.import_module(f"tests.benchmarks.{sys.argv[1]}").run(sys.argv[2:])
        show(rows, console)
        return verdict(rows, console)
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)} (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures there")
    arguments = parser.parse_args()
    if unknown := sorted(set(arguments.names) - set(BENCHMARKS)):
        known = f"known: {', '.join(BENCHMARKS)}; alone: {', '.join(LONG)}"
        parser.error(f"unknown benchmark {', '.join(unknown)}; {known}")
    for name in arguments.names or BENCHMARKS:
        with console.status(f"{name} ..."):
            measured = importlib.import_module(f"tests.benchmarks.{name}").run()
        show(measured, console)
        rows += measured
    if arguments.json:
        figures = [{**row._asdict(), "holds": row.holds} for row in rows]
        arguments.json.write_text(json.dumps({"machine": machine(), "rows": figures}, indent=1) + "\n")
    return verdict(rows, console)


def verdict(rows: list[Row], console: Console) -> int:
    """Print the figures that miss their promise; return the exit code."""
    missed = [row for row in rows if not row.holds]
    for row in missed:
        console.print(f"[bold red]missed[/] {row.benchmark}: {row.name}: {row.value:.4g} {row.unit}")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
