"""`golfbench size`: from a demand to hardware, as a front of candidates with their configurations."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from bench.base.errors import BenchError
from bench.base.interrupt import deferred_interrupt
from bench.commands.common.options import ClusterAddress, Processes, option, sweep_engine
from bench.commands.common.output import console_of
from bench.commands.common.progress import progress_of_steps
from bench.commands.common.session import Session

if TYPE_CHECKING:
    from bench.design.sizing.catalogue import Catalogue
    from bench.design.sizing.hardware import Hardware
    from bench.design.sizing.search import SizingRun, SizingSearch
    from bench.design.sizing.study import SizedPoint, SizingDemand

_PIPED_WIDTH = 190
"""Columns of the table in a file or pipe."""

Output = Annotated[Path | None, option("Folder of results.", "DIR", shown="DATA_DIR/sizing")]
Speed = Annotated[float, option("Head speed at the ball.", "M_PER_S", low=5.0, high=80.0)]
Attack = Annotated[float, option("Attack angle, + up.", "DEG", low=-8.0, high=8.0)]
ClubName = Annotated[str | None, option("Club to swing.", "NAME", shown="the configuration's")]
PartsFile = Annotated[Path | None, option("Catalogue of parts, TOML.", "FILE", shown="golfbench's own")]
Names = Annotated[list[str] | None, option("Part of the grid; repeatable.", "NAME")]
NamesOrNone = Annotated[
    list[str] | None, option('Part of the grid, or "none"; repeatable.', "NAME", shown="none, as shipped")
]
Absorbers = Annotated[list[str] | None, option("Pair of absorbers of the grid; repeatable.", "ARM,WRIST")]
Pressures = Annotated[list[float] | None, option("Regulated pressure, bar absolute; repeatable.", "BAR")]
Levers = Annotated[list[float] | None, option("Wrist's lever; repeatable.", "MM")]
Angles = Annotated[list[float] | None, option("Mounting angle of that lever; repeatable.", "DEG")]
Rounds = Annotated[int, option("Rounds of cheaper parts around the cheapest that will do.", low=0)]
Swings = Annotated[int, option("Candidates whose whole swing is designed at the demanded speed.", low=0)]
FaultSpacing = Annotated[
    int, option("Ticks between tried faults; 0: none.", "TICKS", low=0, names="--faults")
]


def size(
    context: typer.Context,
    output: Output = None,
    speed: Speed = 58.1,
    attack: Attack = 0.0,
    club: ClubName = None,
    catalogue: PartsFile = None,
    vane: Names = None,
    cylinder: Names = None,
    valve: Names = None,
    absorbers: Absorbers = None,
    pressure_bar: Pressures = None,
    lever_mm: Levers = None,
    lever_angle: Angles = None,
    frame: Names = None,
    hose: NamesOrNone = None,
    vent: NamesOrNone = None,
    rounds: Rounds = 2,
    swings: Swings = 1,
    faults: FaultSpacing = 0,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
) -> None:
    """Size the robot's hardware for a head speed: a front of speed over price, and its configurations.

    Candidates are combined from a catalogue of parts. The fastest downswing of each is found by collocation;
    around the cheapest that exceeds the speed by 5 % single parts are made cheaper; for the cheapest of the
    front the whole swing is designed on the plant. Results are reused when the command is run again.
    """
    from bench.design.sizing.catalogue import load_catalogue, shipped_catalogue
    from bench.design.sizing.search import SizingRun

    configuration = context.ensure_object(Session).configuration()
    known = shipped_catalogue() if catalogue is None else load_catalogue(catalogue)
    search = _search(
        known,
        (vane, cylinder, valve, absorbers, frame, hose, vent),
        (pressure_bar, lever_mm, lever_angle),
        (rounds, swings, faults),
    )
    demand = _demand(speed, attack, club or configuration.swing.club)
    folder = output or configuration.bench.data_dir / "sizing"
    with (
        sweep_engine(configuration, processes, cluster, len(search.grid.candidates(known))) as engine,
        deferred_interrupt() as asked,
        progress_of_steps() as show,
    ):
        run = SizingRun(known, demand, folder, engine, show, asked.is_made)
        points = run.points(search)
    _report(run, points, folder)


def _demand(speed: float, attack: float, club: str) -> SizingDemand:
    from bench.design.sizing.study import SizingDemand

    return SizingDemand(speed, radians(attack), club)


def _search(
    catalogue: Catalogue,
    parts: tuple[list[str] | None, ...],
    numbers: tuple[list[float] | None, ...],
    depth: tuple[int, int, int],
) -> SizingSearch:
    """Return the search over the options' values; the grid's defaults replace omitted options.

    Raises:
        BenchError: a part is not in the catalogue, or absorbers are no pair.
    """
    from bench.design.sizing.search import SizingGrid, SizingSearch

    vanes, cylinders, valves, absorbers, frames, hoses, vents = parts
    pressures, levers, angles = numbers
    own = SizingGrid()
    grid = SizingGrid(
        tuple(vanes or own.vanes),
        tuple(cylinders or own.cylinders),
        tuple(valves or own.valves),
        tuple(_pair(text) for text in absorbers) if absorbers else own.absorbers,
        tuple(1e5 * bar for bar in pressures) if pressures else own.pressures,
        tuple(1e-3 * lever for lever in levers) if levers else own.levers,
        tuple(radians(angle) for angle in angles) if angles else own.lever_angles,
        tuple(frames or own.frames),
        _or_none(hoses, own.hoses),
        _or_none(vents, own.vents),
    )
    grid.candidates(catalogue)  # refuses unknown parts before the long part
    return SizingSearch(grid, *depth)


def _or_none(names: list[str] | None, own: tuple[str, ...]) -> tuple[str, ...]:
    """Return parts that may be left out, written "none", or the grid's `own`."""
    return tuple("" if name == "none" else name for name in names) if names else own


def _pair(text: str) -> tuple[str, str]:

    arm, separator, wrist = text.partition(",")
    if not separator or not arm or not wrist:
        raise BenchError(
            "--absorbers", repr(text), "two absorbers, ARM,WRIST", "Give both, as in --absorbers A40,A90."
        )
    return arm, wrist


def _report(run: SizingRun, points: Sequence[SizedPoint], folder: Path) -> None:
    """Print the table, and write the picture, the figures and a configuration for each point of the front."""
    from bench.config import load_configuration
    from bench.design.sizing.picture import draw_front
    from bench.design.sizing.study import candidate_text, non_dominated

    front = non_dominated(points)
    shipped = load_configuration(Path("shipped"))
    for point in front:
        file = folder / f"{point.hardware.name}.toml"
        file.write_text(candidate_text(run.catalogue, point.hardware, shipped, run.demand), encoding="utf-8")
    (folder / "points.json").write_text(json.dumps([asdict(point) for point in points], indent=2) + "\n")
    draw_front(points, run.demand.speed, folder / "front.png")
    console = console_of(_PIPED_WIDTH)
    console.print(front_table(points, front))
    console.print(
        f"{len(points)} candidates, {len(front)} on the front; the plans took {run.seconds / 60:.1f} min. "
        f"Picture, figures and a configuration for each point of the front: {folder}",
        highlight=False,
    )
    failed = [point for point in points if point.plan.failure]
    for point in failed:
        console.print(f"no plan: {point.hardware.name}: {point.plan.failure}", highlight=False)


def front_table(points: Sequence[SizedPoint], front: Sequence[SizedPoint]) -> Table:
    """Return a table of the front and of the points with a swing: the plan, then the swing."""
    table = Table(title="Front: no other candidate is both faster and cheaper", title_justify="left")
    for name in ("vane", "arm", "wrist", "valves, hose, vents", "absorbers", "bar", "EUR"):
        table.add_column(name)
    for name in ("plan m/s", "cushions J", "peak bar", "swing m/s", "air g", "peak bar"):
        table.add_column(name, justify="right")
    table.add_column("cushion %: struck, missed, silent")
    table.add_column("unsafe")
    for point in points:
        if point in front or point.swing is not None:
            table.add_row(*_plan_cells(point), *_swing_cells(point))
    return table


def _plan_cells(point: SizedPoint) -> tuple[str, ...]:
    hardware, plan = point.hardware, point.plan
    return (
        hardware.vane,
        hardware.arm,
        f"{hardware.wrist}, {1e3 * hardware.lever:g} mm" + _mounting(hardware),
        " ".join(filter(None, (*hardware.valves, hardware.hose, hardware.vent))),
        f"{hardware.arm_absorber} {hardware.wrist_absorber}",
        f"{hardware.pressure / 1e5:g}",
        str(point.price),
        f"{plan.speed:.1f}",
        f"{plan.carried[0]:.0f}, {plan.carried[1]:.0f}",
        f"{plan.peak_pressure / 1e5:.1f}",
    )


def _mounting(hardware: Hardware) -> str:
    """Return mounting angle and ranges where they are not the shipped robot's."""
    turned = f", {degrees(hardware.lever_angle):g}°" if hardware.lever_angle else ""
    return turned + (f", {hardware.frame}" if hardware.frame != "R80" else "")


def _swing_cells(point: SizedPoint) -> tuple[str, ...]:
    swing = point.swing
    if swing is None:
        return ("", "", "", "", "")
    if swing.failure:
        return ("none", "", "", swing.failure, "")
    shares = ", ".join(f"{100 * share:.0f}" for share in (swing.struck, swing.missed, swing.silent))
    tried = (
        f"{swing.unsafe}, stuck valves {swing.stuck_unsafe}, of {swing.cases}" if swing.cases else "not tried"
    )
    return (f"{swing.speed:.2f}", f"{1e3 * swing.air:.0f}", f"{swing.peak_pressure / 1e5:.1f}", shares, tried)
