"""The robot at address as STEP for a workshop, and the masses of its bodies next to those of the dynamics.

STEP: exact solids, one labelled assembly a body, millimetres. The only module that needs build123d (extra
`cad`). Z up, X along the target line, as in the URDF.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.base.errors import BenchError
from bench.records.telemetry.atomic_file import atomic_file, atomic_path
from bench.viewer.drawing.bodies import Bar, DrawnBody, Ellipsoid, Mesh, Solid, Tube
from bench.viewer.drawing.drawing import PlacedBody, draw
from bench.viewer.drawing.model_files import Y_UP_TO_Z_UP
from sim.plant import PlantParameters

REASONS = {
    "shoulder_link": "bar exact; its bores and the pins of R2 and R6 are not in the dynamics",
    "left_arm": "bar, plate and cylinder exact; the bores of R2 and R3 are not in the dynamics",
    "club": "the dynamics hold mount and head as points on the shaft's line, the head at the shaft's end",
    "right_arm_rod": "rod, piston and eye over the whole stroke; the thesis has the inertia of a 0.2 m rod",
    "right_arm_cylinder": "caps at both ends; the thesis has a uniform bar",
}
"""Cause of a difference, by body."""


class MassRow(NamedTuple):
    """One body: assumed in the dynamics, drawn in its frame. Central inertia about the plane's normal."""

    body: str
    mass_assumed_kg: float
    mass_drawn_kg: float
    com_x_assumed_m: float
    com_x_drawn_m: float
    com_y_drawn_m: float
    inertia_assumed_kg_m2: float
    inertia_drawn_kg_m2: float
    pins_kg: float
    """Mass of pins less that of bores, in the drawn mass."""
    reason: str


def mass_rows(plant: PlantParameters) -> list[MassRow]:
    """Return a row for each body of the dynamics."""
    return [_row(body) for body in draw(plant).moving if body.assumed is not None]


def _row(body: DrawnBody) -> MassRow:
    assumed, drawn = body.assumed, body.weighed
    if assumed is None:
        raise ValueError(f"{body.name} has no body in the dynamics")
    return MassRow(
        body.name,
        assumed.mass,
        drawn.volume,
        assumed.centre_of_mass,
        float(drawn.centroid[0]),
        float(drawn.centroid[1]),
        assumed.inertia,
        float(drawn.inertia[2, 2]),
        drawn.volume - body.without_joints.volume,
        REASONS[body.name],
    )


def write_mass_table(path: Path, rows: list[MassRow]) -> None:
    """Write `rows` as CSV to `path`, units in the column names. Raises NotStored."""
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(MassRow._fields)
    writer.writerows(rows)
    with atomic_file(path) as stream:
        stream.write(text.getvalue().encode())


_MM = 1000.0


def load_build123d() -> Any:
    """Return the package.

    Raises:
        BenchError: it is not installed.
    """
    try:
        import build123d
    except ImportError as error:
        found = f"no package build123d ({error})"
        action = 'pip install "golfbench[cad]"; glTF and URDF need nothing more'
        raise BenchError("draw --format step", found, "the extra that makes exact solids", action) from error
    return build123d


def _location(b: Any, turn: Any, at: Any) -> Any:
    """Return the place of a rotation matrix and a point (mm)."""
    rotation = np.array(turn)
    x, z = (tuple(map(float, rotation[:, axis])) for axis in (0, 2))
    return b.Plane(origin=tuple(map(float, at)), x_dir=x, z_dir=z).location


def solid_shape(b: Any, solid: Solid) -> Any:
    """Return `solid` as a shape of build123d, `b`, in mm."""
    match solid:
        case Bar():
            shape = b.Solid.make_box(*(_MM * size for size in solid.size))
            shape = shape.moved(b.Location(tuple(-_MM * size / 2 for size in solid.size)))
            height = _MM * solid.size[2]
            for bore in solid.bores:
                drill = b.Solid.make_cylinder(_MM * bore.radius, 2 * height)
                shape = shape.cut(drill.moved(b.Location((_MM * bore.x, _MM * bore.y, -height))))
            return shape.moved(_location(b, solid.turn, _MM * np.array(solid.centre)))
        case Tube():
            way = tuple(map(float, np.array(solid.end) - np.array(solid.start)))
            shape = b.Solid.make_cylinder(_MM * solid.outer, _MM * solid.length)
            if solid.inner > 0:
                shape = shape.cut(b.Solid.make_cylinder(_MM * solid.inner, _MM * solid.length))
            return shape.moved(b.Plane(origin=tuple(_MM * v for v in solid.start), z_dir=way).location)
        case Ellipsoid(cut=None) if len(set(solid.half)) == 1:
            ball = b.Solid.make_sphere(_MM * solid.half[0], angle1=-90, angle2=90, angle3=360)
            return ball.moved(b.Location(tuple(_MM * value for value in solid.centre)))
        case Ellipsoid():
            return _faceted(b, solid.mesh)


def _faceted(b: Any, mesh: Mesh) -> Any:
    """Return a mesh as a faceted solid: CAD programs misread the surfaces of scaled spheres."""
    corners = _MM * mesh.vertices[mesh.triangles]
    faces = [b.Face(b.Wire.make_polygon([tuple(map(float, c)) for c in triangle])) for triangle in corners]
    return b.Solid(b.Shell(faces))


def _one(shape: Any) -> Any:
    """Return the only solid of `shape`; ValueError unless there is exactly one."""
    solids = shape.solids()
    if len(solids) != 1:
        raise ValueError(f"{len(solids)} solids, expected one")
    return solids[0]


def step_assembly(b: Any, bodies: Sequence[PlacedBody]) -> Any:
    """Return the bodies as a labelled, coloured assembly; `b` is build123d."""
    assemblies = []
    for one in bodies:
        location = _location(b, Y_UP_TO_Z_UP @ one.turn, _MM * (Y_UP_TO_Z_UP @ one.at))
        children = []
        for part in one.body.parts:
            shape = _one(solid_shape(b, part.solid)).moved(location)
            shape.label = part.name
            shape.color = b.Color(*(value / 255 for value in part.material.colour))
            children.append(shape)
        assemblies.append(b.Compound(label=one.body.name, children=children))
    return b.Compound(label="golfbench", children=assemblies)


def write_step(path: Path, bodies: Sequence[PlacedBody]) -> None:
    """Write the bodies to `path`. Raises NotStored, BenchError without build123d."""
    b = load_build123d()
    assembly = step_assembly(b, bodies)
    with atomic_path(path) as partial:
        b.export_step(assembly, str(partial))
