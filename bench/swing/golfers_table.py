"""How `golfbench swing golfers` shows deviations, and what of a golfer the robot cannot reach."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table

from bench.swing.golfers import (
    HUNT_WIENS,
    Deviation,
    Golfer,
    HumanDownswing,
    beside,
    deviation,
    human_downswing,
)
from bench.swing.profile import Profile
from sim.kinematics import forward_kinematics, right_arm_length
from sim.plant import PlantParameters


class Row(NamedTuple):
    """A golfer beside a swing of the robot."""

    golfer: Golfer
    human: HumanDownswing
    swing: Profile
    away: Deviation


def golfer_row(plant: PlantParameters, golfer: Golfer, swing: Profile) -> Row:
    """Return how far `swing` is from `golfer`."""
    human = human_downswing(plant, golfer)
    return Row(golfer, human, swing, deviation(plant, swing, human))


def golfer_record(plant: PlantParameters, row: Row) -> dict[str, Any]:
    """Return `row` for a program to read; deviations are shares of the human's range."""
    return {
        "golfer": row.golfer.name,
        "text": row.golfer.text,
        "golfer_head_speed_mps": row.golfer.head_speed,
        "model_head_speed_mps": row.human.head_speed,
        "amplitude": row.human.amplitude,
        "robot": row.swing.name,
        "robot_head_speed_mps": row.swing.delivery.get("head_speed_mps"),
        "deviation": row.away._asdict(),
        "beyond_the_robots_range": out_of_reach(plant, row.human),
    }


def out_of_reach(plant: PlantParameters, human: HumanDownswing) -> tuple[float, float, float]:
    """Return how far the human goes beyond the ranges of shoulder (rad), right arm (m) and wrist (rad)."""
    extension = right_arm_length(plant.robot, human.angle[:, 1]) - plant.robot.l56
    places = (human.angle[:, 0], extension, human.angle[:, 2])
    shoulder, arm, wrist = (
        max(actuator.lower - float(np.min(place)), float(np.max(place)) - actuator.upper, 0.0)
        for actuator, place in zip(plant.actuators, places, strict=True)
    )
    return shoulder, arm, wrist


def golfers_table(rows: list[Row], plant: PlantParameters) -> Table:
    """Return a row a golfer: speeds, deviations of each joint and the head, what is out of reach."""
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title="The robot against golfers",
        title_justify="left",
    )
    table.caption = (
        "Shoulder to head: root mean square over the downswing, clocks laid together at the ball, in % of "
        f"the human's range; Hunt and Wiens quote {100 * HUNT_WIENS:.1f} % without a public definition. "
        "Beyond: how far the golfer is out of the robot's range: shoulder (rad), right arm (m), wrist (rad)."
    )
    table.add_column("golfer", no_wrap=True)
    for heading in ("m/s", "model", "robot", "shoulder", "arm", "wrist", "head"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("beyond", no_wrap=True)
    for row in rows:
        speed = row.swing.delivery.get("head_speed_mps")
        table.add_row(
            row.golfer.name,
            f"{row.golfer.head_speed:.1f}",
            f"{row.human.head_speed:.1f}",
            "" if speed is None else f"{speed:.1f}",
            *(f"{100 * share:.0f}" for share in row.away),
            " ".join(f"{value:.2f}" for value in out_of_reach(plant, row.human)),
        )
    return table


def draw_golfers(rows: list[Row], plant: PlantParameters, path: Path) -> None:
    """Write a picture (PNG, SVG or PDF by the suffix of `path`): each golfer's downswing and the robot's.

    Raises:
        ValueError: no picture format has that suffix.
        OSError: `path` cannot be written.
    """
    figure = Figure(figsize=(11.0, 2.1 * len(rows) + 0.8), layout="constrained")
    axes = figure.subplots(len(rows), 4, squeeze=False)
    names = ("shoulder θ1, °", "arm θ2, °", "wrist θ3, °", "head, m")
    for across, row in zip(axes, rows, strict=True):
        robot = beside(row.swing, row.human)
        before = 1e3 * (row.human.time - row.human.time[-1])
        for i in range(3):
            across[i].plot(before, np.degrees(row.human.angle[:, i]), "--", color="#d1495b")
            across[i].plot(before, np.degrees(robot[:, i]), color="#1f5fa8")
        head = forward_kinematics(plant.robot, robot)
        across[3].plot(*row.human.head.T, "--", color="#d1495b")
        across[3].plot(head[:, 0], head[:, 1], color="#1f5fa8")
        across[3].set_aspect("equal", adjustable="datalim")
        for ax, name, share in zip(across, names, row.away, strict=True):
            ax.set_title(f"{name}: {100 * share:.0f} %", fontsize=9)
            ax.tick_params(labelsize=7)
            ax.grid(alpha=0.25)
        across[0].set_ylabel(f"{row.golfer.name}\n{row.golfer.head_speed:.1f} m/s", fontsize=9)
    for ax in axes[-1, :3]:
        ax.set_xlabel("ms before the ball", fontsize=8)
    figure.suptitle(
        "Dashed: golfer (model). Line: robot. Shares: root mean square over the human's range; "
        f"Hunt and Wiens quote {100 * HUNT_WIENS:.1f} %.",
        fontsize=9,
    )
    figure.savefig(path, dpi=110)
