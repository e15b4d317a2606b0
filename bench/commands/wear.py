"""`golfbench wear`: how near recorded swings come to the limits of the model-based check."""

from __future__ import annotations

from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.table import Table

from bench.commands.options import Json, argument
from bench.commands.output import finite, plain_table
from bench.commands.progress import progress_of
from bench.commands.session import exit_unless, show_json

if TYPE_CHECKING:
    from bench.simulation.replay import Margin

Records = Annotated[list[Path], argument("RECORD...", "Parquet files of swings, or folders of them.")]

_PARTS = {
    "air": "valve, chamber sensors or supply of the {joint}",
    "flow": "dead band, centre or leakage of the {joint} valve, or a chamber sensor",
    "velocity": "friction of the {joint}, or the supply",
    "jump": "encoder of the {joint}: coupling, cable, latency",
    "effort": "head and shaft, or scale of the {joint} encoder",
}
"""Where a residual comes from, by comparison."""


def wear(records: Records, json_: Json = False) -> None:
    """Show how near recorded swings come to the limits of the model-based check, and the trend: wear.

    Exits with 1 if one is near its limit, or the trend reaches it within as many swings again (at most 200).
    """
    import numpy as np

    from bench.simulation.replay import margins, residual_shares
    from bench.telemetry.recorder import read_swing
    from bench.viewer.recorded_series import record_files

    files = record_files(records)
    swings = []
    with progress_of("replaying swings", len(files)) as show:
        for done, file in enumerate(files):
            cycles, metadata = read_swing(file)
            time = str(metadata.get("time_utc", file.name))
            swings.append((time, residual_shares(cycles, metadata, str(file))))
            show(done + 1)
    swings.sort(key=lambda swing: swing[0])
    found = margins(np.array([shares for _, shares in swings]))
    near = [one for one in found if one.near]
    if json_:
        rows = [{name: finite(value) for name, value in one._asdict().items()} for one in found]
        show_json({"swings": len(swings), "margins": rows, "near": bool(near)})
        exit_unless(not near)
        return
    console = Console()
    console.print(_table(found, f"{len(swings)} swings: largest residuals, % of their limits"))
    for one in near:
        console.print(
            f"{one.joint} {one.kind} is near its limit: {_PARTS[one.kind].format(joint=one.joint)}. "
            "Look at it; if nothing is broken, measure the robot again with golfbench commission.",
            style="yellow",
            highlight=False,
        )
    exit_unless(not near)


def _table(found: list[Margin], title: str) -> Table:
    figures = ("first swings", "latest", "per 100 swings")
    table = plain_table("joint", "comparison", *figures, right=figures, title=title)
    for one in found:
        growth = "" if isnan(one.growth) else f"{1e4 * one.growth:+.1f}" if one.growth else "no trend"
        values: tuple[Any, ...] = (f"{100 * one.before:.0f}", f"{100 * one.latest:.0f}", growth)
        table.add_row(one.joint, one.kind, *values, style="yellow" if one.near else None)
    return table
