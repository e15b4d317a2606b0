"""`golfbench size`, `golfbench draw`: hardware for a head speed; the configured hardware as drawings."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from math import degrees, radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.table import Table

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError
from bench.base.interrupt import deferred_interrupt
from bench.commands.common import (
    ClubName,
    ClusterAddress,
    Processes,
    Session,
    console_of,
    option,
    plain_table,
    progress_of_steps,
    sweep_engine,
    write_text,
)
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.design.sizing.catalogue import Hardware
    from bench.design.sizing.search import SizedPoint, SizingGrid, SizingRun
    from bench.viewer.drawing.model_files import MassRow
    from sim.plant import PlantParameters

_PIPED_WIDTH = 190
"""Columns of the table in a file or pipe."""


def size(
    context: typer.Context,
    output: Annotated[Path | None, option("Folder of results.", "DIR", shown="DATA_DIR/sizing")] = None,
    speed: Annotated[float, option("Head speed at the ball.", "M_PER_S", low=5.0, high=80.0)] = 58.1,
    attack: Annotated[float, option("Attack angle, + up.", "DEG", low=-8.0, high=8.0)] = 0.0,
    club: ClubName = None,
    catalogue: Annotated[
        Path | None, option("Catalogue of parts, TOML.", "FILE", shown="golfbench's own")
    ] = None,
    grid: Annotated[
        list[str] | None,
        option(
            "Value of the grid in place of its defaults; repeatable. KEY: vane, cylinder, valve, absorbers "
            "(ARM,WRIST), pressure_bar (absolute), lever_mm (of the wrist), lever_angle (its mounting, deg), "
            'frame, hose, vent (or "none").',
            "KEY=VALUE",
        ),
    ] = None,
    swings: Annotated[
        int, option("Candidates whose whole swing is designed at the demanded speed.", low=0)
    ] = 1,
    faults: Annotated[
        int, option("Ticks between tried faults; 0: none.", "TICKS", low=0, names="--faults")
    ] = 0,
    processes: Processes = 0,
    cluster: ClusterAddress = "",
) -> None:
    """Size the robot's hardware for a head speed: a front of speed over price, and its configurations.

    Candidates are combined from a catalogue of parts. The fastest downswing of each is found by collocation;
    around the cheapest that exceeds the speed by 5 % single parts are made cheaper; for the cheapest of the
    front the whole swing is designed on the plant. Results are reused when the command is run again.
    """
    from bench.design.sizing.catalogue import load_catalogue, shipped_catalogue
    from bench.design.sizing.search import SizingDemand, SizingRun, SizingSearch

    configuration = context.ensure_object(Session).configuration()
    known = shipped_catalogue() if catalogue is None else load_catalogue(catalogue)
    search = SizingSearch(_grid(grid or ()), swings=swings, spacing=faults)
    cases = len(search.grid.candidates(known))  # refuses unknown parts before the long part
    demand = SizingDemand(speed, radians(attack), club or configuration.swing.club)
    folder = output or configuration.bench.data_dir / "sizing"
    with (
        sweep_engine(configuration, processes, cluster, cases) as engine,
        deferred_interrupt() as asked,
        progress_of_steps() as show,
    ):
        run = SizingRun(known, demand, folder, engine, show, asked.is_made)
        points = run.points(search)
    _report(run, points, folder)


def _pair(text: str) -> tuple[str, str]:
    arm, wrist = text.split(",")
    if not arm or not wrist:
        raise ValueError(text)
    return arm, wrist


def _or_none(text: str) -> str:
    return "" if text == "none" else text


_GRID: Mapping[str, tuple[str, Callable[[str], Any]]] = {
    "vane": ("vanes", str),
    "cylinder": ("cylinders", str),
    "valve": ("valves", str),
    "absorbers": ("absorbers", _pair),
    "pressure_bar": ("pressures", lambda text: 1e5 * read_number(text)),
    "lever_mm": ("levers", lambda text: 1e-3 * read_number(text)),
    "lever_angle": ("lever_angles", lambda text: radians(read_number(text))),
    "frame": ("frames", str),
    "hose": ("hoses", _or_none),
    "vent": ("vents", _or_none),
}
"""Field of the grid by key, and what reads a value."""


def _grid(given: Sequence[str]) -> SizingGrid:
    """Return the grid with the values `given` as KEY=VALUE; its defaults replace omitted keys."""
    from bench.design.sizing.search import SizingGrid

    values: dict[str, list[Any]] = {}
    for text in given:
        key, _, value = text.partition("=")
        try:
            field, read = _GRID[key]
            values.setdefault(field, []).append(read(value))
        except (KeyError, ValueError):
            expected = f"KEY=VALUE with one of {', '.join(_GRID)}"
            action = "Give a part of the catalogue or a number; two absorbers as ARM,WRIST."
            raise BenchError("--grid", repr(text), expected, action) from None
    return SizingGrid(**{field: tuple(found) for field, found in values.items()})


def _report(run: SizingRun, points: Sequence[SizedPoint], folder: Path) -> None:
    """Print the table, and write the picture, the figures and a configuration for each point of the front."""
    from bench.config import load_configuration
    from bench.design.sizing.search import candidate_text, draw_front, non_dominated

    front = non_dominated(points)
    shipped = load_configuration(Path("shipped"))
    for point in front:
        file = folder / f"{point.hardware.name}.toml"
        write_text(candidate_text(run.catalogue, point.hardware, shipped, run.demand), file)
    write_text(json.dumps([asdict(point) for point in points], indent=2) + "\n", folder / "points.json")
    draw_front(points, run.demand.speed, folder / "front.png")
    console_of(_PIPED_WIDTH).print(front_table(points, front))
    typer.echo(
        f"{len(points)} candidates, {len(front)} on the front; the plans took {run.seconds / 60:.1f} min. "
        f"Picture, figures and a configuration for each point of the front: {folder}"
    )
    for point in points:
        if point.plan.failure:
            typer.echo(f"no plan: {point.hardware.name}: {point.plan.failure}")


def front_table(points: Sequence[SizedPoint], front: Sequence[SizedPoint]) -> Table:
    """Return a table of the front and of the points with a swing: the plan, then the swing."""
    table = Table(title="Front: no other candidate is both faster and cheaper", title_justify="left")
    for name in ("vane", "arm", "wrist", "valves, hose, vents", "absorbers", "bar", "EUR"):
        table.add_column(name)
    for name in ("plan m/s", "absorbers J", "peak bar", "swing m/s", "air g", "peak bar"):
        table.add_column(name, justify="right")
    table.add_column("absorber %: struck, missed, lost link")
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


# Drawings --------------------------------------------------------------------------------------------

DrawingFormat = Literal["step", "gltf", "urdf"]


def draw(
    context: typer.Context,
    output: Annotated[Path, option("Folder for the files; made if it is missing.", "DIR")] = Path("drawing"),
    format_: Annotated[
        DrawingFormat | None,
        option("One format.", shown="all; step only with the extra cad", names="--format"),
    ] = None,
    club: Annotated[str | None, option("Club in the mount.", "NAME", shown="the configuration's")] = None,
) -> None:
    """Draw the configured robot with stand, drive, tee and guard, and compare its masses.

    robot.step is for a workshop (mm), robot.glb for people, golfbench.urdf with meshes for simulators (m).
    masses.csv has mass, centre of mass and inertia as drawn and as in the dynamics. Files are replaced.
    """
    from bench.viewer.drawing.model_files import mass_rows, write_mass_table

    configuration = context.ensure_object(Session).configuration()
    plant = configuration.plant_with(club=club)
    output.mkdir(parents=True, exist_ok=True)
    rows = mass_rows(plant)
    for path in _write(output, plant, configuration.envelope.min_frame_distance, format_):
        typer.echo(str(path))
    path = output / "masses.csv"
    write_mass_table(path, rows)
    typer.echo(str(path))
    console = Console()
    console.print(mass_table(rows))
    for row in rows:
        console.print(f"[bold]{row.body.replace('_', ' ')}[/bold]: {row.reason}")


def _write(
    output: Path, plant: PlantParameters, min_frame_distance: float, format_: DrawingFormat | None
) -> list[Path]:

    from bench.viewer.drawing.drawing import placed
    from bench.viewer.drawing.model_files import gltf, write_step, write_urdf

    written = []
    bodies = placed(plant)
    if format_ in (None, "gltf"):
        written.append(output / "robot.glb")
        write_whole(written[-1], gltf(bodies))
    if format_ in (None, "urdf"):
        written += write_urdf(output, plant, min_frame_distance)[-2:]
    if format_ == "step" or (format_ is None and importlib.util.find_spec("build123d") is not None):
        written.append(output / "robot.step")
        write_step(written[-1], bodies)
    elif format_ is None:
        typer.echo('no robot.step: that needs build123d (pip install "golfbench[cad]")', err=True)
    return written


def mass_table(rows: list[MassRow]) -> Table:
    """Return the masses as a table: assumed in the dynamics, then drawn; pins and bores within the latter."""
    figures = ("mass kg", "centre m", "inertia kg m²", "pins, bores kg")
    title = "Masses: assumed in the dynamics / drawn"
    table = plain_table("body", *figures, right=figures, title=title, title_justify="left")
    for row in rows:
        table.add_row(
            row.body.replace("_", " "),
            f"{row.mass_assumed_kg:.4f} / {row.mass_drawn_kg:.4f}",
            f"{row.com_x_assumed_m:.4f} / {row.com_x_drawn_m:.4f}",
            f"{row.inertia_assumed_kg_m2:.5f} / {row.inertia_drawn_kg_m2:.5f}",
            f"{row.pins_kg:+.4f}",
        )
    return table
