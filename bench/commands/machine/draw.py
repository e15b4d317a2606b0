"""`golfbench draw` at the command line: the configured robot as STEP, glTF and URDF, with its masses."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from bench.commands.common.options import option
from bench.commands.common.session import Session

if TYPE_CHECKING:
    from bench.viewer.drawing.model_files import MassRow
    from sim.plant import PlantParameters


class DrawingFormat(StrEnum):
    """Format of the drawing."""

    STEP = "step"
    GLTF = "gltf"
    URDF = "urdf"


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
    """Write one format or all; return the files to name."""
    from importlib.util import find_spec

    from bench.viewer.drawing.drawing import placed
    from bench.viewer.drawing.model_files import write_gltf, write_step, write_urdf

    written = []
    bodies = placed(plant)
    if format_ in (None, DrawingFormat.GLTF):
        written.append(output / "robot.glb")
        write_gltf(written[-1], bodies)
    if format_ in (None, DrawingFormat.URDF):
        written += write_urdf(output, plant, min_frame_distance)[-2:]
    if format_ is DrawingFormat.STEP or (format_ is None and find_spec("build123d") is not None):
        written.append(output / "robot.step")
        write_step(written[-1], bodies)
    elif format_ is None:
        typer.echo('no robot.step: that needs build123d (pip install "golfbench[cad]")', err=True)
    return written


def mass_table(rows: list[MassRow]) -> Table:
    """Return the masses as a table: assumed in the dynamics, then drawn; pins and bores within the latter."""
    table = Table(title="Masses: assumed in the dynamics / drawn", title_justify="left")
    for name in ("body", "mass kg", "centre m", "inertia kg m²", "pins, bores kg"):
        table.add_column(name, justify="left" if name == "body" else "right")
    for row in rows:
        table.add_row(
            row.body.replace("_", " "),
            f"{row.mass_assumed_kg:.4f} / {row.mass_drawn_kg:.4f}",
            f"{row.com_x_assumed_m:.4f} / {row.com_x_drawn_m:.4f}",
            f"{row.inertia_assumed_kg_m2:.5f} / {row.inertia_drawn_kg_m2:.5f}",
            f"{row.pins_kg:+.4f}",
        )
    return table
