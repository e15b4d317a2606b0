"""How `golfbench swing golfers` shows deviations, and what of a golfer the robot cannot reach."""

from __future__ import annotations

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from bench.swing.golfers import HUNT_WIENS, Deviation, Golfer, HumanDownswing
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters

Row = tuple[Golfer, HumanDownswing, Deviation]


def out_of_reach(plant: PlantParameters, human: HumanDownswing) -> str:
    """Return which joints of the robot cannot go where the human's do, and by how much."""
    extension = right_arm_length(plant.robot, human.angle[:, 1]) - plant.robot.l56
    places = (human.angle[:, 0], extension, human.angle[:, 2])
    told = []
    for name, unit, actuator, place in zip(
        ("shoulder", "right arm", "wrist"), ("rad", "m", "rad"), plant.actuators, places, strict=True
    ):
        beyond = max(actuator.lower - float(np.min(place)), float(np.max(place)) - actuator.upper)
        if beyond > 0.005:
            told.append(f"{name} {beyond:.2f} {unit}")
    return ", ".join(told)


def golfers_table(name: str, rows: list[Row], plant: PlantParameters) -> Table:
    """Return a row a golfer: speeds, deviations of each joint and the head, what is out of reach."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, title=f"{name} against golfers", title_justify="left")
    table.caption = (
        "Root mean square over the downswing, clocks laid together at the ball, of the human's range; "
        f"Hunt and Wiens quote {100 * HUNT_WIENS:.1f} % without a public definition."
    )
    table.add_column("golfer", no_wrap=True)
    for heading in ("m/s, golfer", "m/s, model", "amplitude", "shoulder", "arm", "wrist", "head"):
        table.add_column(heading, justify="right")
    table.add_column("beyond the robot's range")
    for golfer, human, away in rows:
        table.add_row(
            golfer.name,
            f"{golfer.head_speed:.1f}",
            f"{human.head_speed:.1f}",
            f"{human.amplitude:.2f}",
            *(f"{100 * share:.0f} %" for share in away),
            out_of_reach(plant, human),
        )
    return table
