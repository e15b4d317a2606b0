"""Balls and clubs of a campaign as tables of its report.

On hardware a ball is what was measured of it: the plan's factors of restitution, drag and lift say what a
simulated ball is and do not appear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import degrees
from typing import Any, NamedTuple

from bench.campaign.carry import Measured
from bench.campaign.display_units import UnitSystem, display_unit
from bench.campaign.plan import CampaignPlan
from bench.golfer import followed_texts
from bench.shot.shot import Shot
from sim.ball import Ball

FLIGHT_OF: Mapping[str, str] = {
    "reference": "flown from the measured launch with the reference ball's aerodynamics, all balls alike: it "
    "compares launches, not flights",
    "monitor": "as the launch monitor reported it",
    "measured": "flown from the measured launch with the aerodynamics measured on each ball",
    "simulated": "flown with the simulated ball's own aerodynamics",
    "model": "flown with the plan's own factors by an older golfbench: it says nothing of a real ball",
}
"""Meaning of each source of carry and flight."""
_DIGITS = 12
"""Printed digits of the SHA-256 of a golfer's file."""


class EquipmentTable(NamedTuple):
    """A table of the report."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    overdue: tuple[str, ...] = ()
    """First cells of the rows whose calibration was overdue at the tests."""


def ball_table(
    plan: CampaignPlan, measured: Measured, *, simulated: bool, units: UnitSystem = UnitSystem.SI
) -> EquipmentTable:
    """Return the balls that are hit, with their measured aerodynamics."""
    head = ["ball", "role"]
    if simulated:
        mass, width = display_unit("mass_kg", units), display_unit("diameter_m", units)
        head += [f"mass, {mass.unit}", f"diameter, {width.unit}", "restitution", "friction", "drag", "lift"]
    head.append("measured aerodynamics")
    rows = []
    for name in plan.ball_names:
        row = [name, "control" if name not in plan.design.balls else "compared"]
        if simulated:
            row += _simulated_figures(plan.balls.get(name), units)
        row.append(measured[name].text if name in measured else "none")
        rows.append(tuple(row))
    caption = "Balls" + (
        "; restitution, drag and lift as factors of the simulation on those of club and flight model"
        if simulated
        else "; what they are is measured, nothing of it comes from the plan"
    )
    return EquipmentTable(f"{caption}.", tuple(head), tuple(rows))


def _simulated_figures(ball: Ball | None, units: UnitSystem) -> list[str]:
    if ball is None:
        return ["–"] * 6
    figures = (ball.restitution_factor, ball.friction, ball.drag_factor, ball.lift_factor)
    sizes = (
        display_unit("mass_kg", units).text(ball.mass),
        display_unit("diameter_m", units).text(2 * ball.radius),
    )
    return [*sizes, *(f"{figure:g}" for figure in figures)]


def club_table(plan: CampaignPlan, units: UnitSystem = UnitSystem.SI) -> EquipmentTable:
    """Return the clubs."""
    length, mass = display_unit("length_m", units), display_unit("head_mass_kg", units)
    rows = tuple(
        (
            name,
            f"{degrees(club.loft):.2f}",
            f"{degrees(club.lie):.2f}",
            f"{degrees(club.face_angle):.2f}",
            length.text(club.length_to_face),
            mass.text(club.head_mass),
        )
        for name, club in plan.clubs.items()
    )
    head = (
        "club",
        "loft, °",
        "lie, °",
        "face angle, °",
        f"length to the face, {length.unit}",
        f"head mass, {mass.unit}",
    )
    return EquipmentTable("Clubs, as plan and configuration have them.", head, rows)


def golfer_table(golfers: Mapping[str, Any], units: UnitSystem = UnitSystem.SI) -> EquipmentTable:
    """Return the golfers that the swings follow, as a campaign's entry has them."""
    speed = display_unit("club_speed_mps", units)
    rows = tuple(
        (
            arm,
            f"{one['golfer']}, {one['sha256'][:_DIGITS]}…",
            one["follow"],
            speed.text(one["head_speed_mps"]),
            *followed_texts(one),
        )
        for arm, one in golfers.items()
    )
    head = ("swing, club", "golfer, SHA-256 of the file", "follows", f"golfer's club, {speed.unit}")
    definitions = "; ".join(dict.fromkeys(one["definition"] for one in golfers.values()))
    caption = f"Measured golfers, and deviations of the robot's planned motion. {definitions}."
    return EquipmentTable(caption, (*head, "shoulder", "arm", "wrist", "head"), rows)


def carry_words(shots: Sequence[Shot]) -> str:
    """Return which carry the shots have; empty without one."""
    sources = dict.fromkeys(shot.carry_source for shot in shots if shot.carry_source)
    return "; ".join(f"{source} – {FLIGHT_OF.get(source, 'unknown')}" for source in sources)


def without_simulated_balls(configuration: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration of a real bench for the report: without the balls of its simulation."""
    kept = {key: value for key, value in configuration.items() if key != "balls"}
    if isinstance(plant := kept.get("plant"), Mapping):
        kept["plant"] = {key: value for key, value in plant.items() if key != "ball"}
    return kept
