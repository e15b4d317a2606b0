"""`golfbench identify`: which robot made the recorded swings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from bench.commands.common.options import Json, argument, option
from bench.commands.common.output import plain_table
from bench.commands.common.progress import progress_of
from bench.commands.common.session import Session, show_json

if TYPE_CHECKING:
    from bench.learning.identify import Identified


Records = Annotated[list[Path], argument("RECORD...", "Parquet files of swings of one profile.")]
Output = Annotated[Path | None, option("Write the identified robot as a configuration, .toml.", "FILE")]


def identify(context: typer.Context, records: Records, output: Output = None, json_: Json = False) -> None:
    """Identify friction, valve flow, dead volumes, supply, vane, club and latency from recorded swings.

    Use swings made with the control of --config, none of them the first after arming.
    """
    from bench.learning.identify import identify as identified
    from bench.learning.identify import read_recorded, variation_of, write_plant_file
    from bench.simulation.series import Bench

    configuration = context.ensure_object(Session).configuration()
    profile, swings = read_recorded(records)
    bench = Bench.of(configuration, profile)
    with progress_of("simulated robots") as show:
        found = identified(bench, swings, progress=show)
    if output is not None:
        robot = variation_of(found.values, bench).applied_to(bench.model)
        write_plant_file(output, robot, found, configuration)
    if json_:
        return show_json(_record(found))
    console = Console()
    console.print(_table(found, f"identified from {len(swings)} swings"))
    console.print(
        f"Factors on the configured robot. Simulated swings were off by {found.before:.1f} times what swings "
        f"alike differ by, and are by {found.after:.1f} times now.",
        highlight=False,
    )


def _record(found: Identified) -> dict[str, Any]:
    from bench.learning.identify import NAMES

    rows = zip(NAMES, found.values.tolist(), found.error.tolist(), found.known.tolist(), strict=True)
    fields = ("name", "value", "standard_error", "identified")
    parameters = [dict(zip(fields, row, strict=True)) for row in rows]
    return {"parameters": parameters, "before": found.before, "after": found.after}


def _table(found: Identified, title: str) -> Table:

    from bench.learning.identify import NAMES

    figures = ("value", "standard error")
    table = plain_table("parameter", *figures, "", right=figures, title=title)
    for name, value, error, known in zip(NAMES, found.values, found.error, found.known, strict=True):
        unit = ("{:+.2f} ms", "{:.2f} ms") if name == NAMES[-1] else ("{:.3f}", "{:.3f}")
        note = "" if known else "not identified"
        table.add_row(name, unit[0].format(value), unit[1].format(error), note)
    return table
