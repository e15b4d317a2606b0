"""Masses of the drawn bodies beside those that the dynamics calculate with, and why they differ."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

from bench.drawing.bodies import DrawnBody
from bench.drawing.drawing import draw
from bench.telemetry.whole_file import whole_file
from sim.plant import PlantParameters

REASONS = {
    "shoulder_link": "bar exact; its bores and the pins of R2 and R6 are not in the dynamics",
    "left_arm": "bar, plate and cylinder exact; the bores of R2 and R3 are not in the dynamics",
    "club": "the dynamics hold mount and head as points on the shaft's line, the head at the shaft's end",
    "right_arm_rod": "rod, piston and eye over the whole stroke; the thesis has the inertia of a 0.2 m rod",
    "right_arm_cylinder": "caps at both ends; the thesis has a uniform bar",
}
"""By body: what a difference comes from."""


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
    with whole_file(path) as stream:
        stream.write(text.getvalue().encode())
