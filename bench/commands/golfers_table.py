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

_SHORT = 0.1
"""m/s; smaller shortfalls are within swing-to-swing scatter."""


class GolferRow(NamedTuple):
    """A golfer beside a swing of the robot."""

    golfer: Golfer
    human: HumanDownswing
    swing: Profile
    away: Deviation

    @property
    def short(self) -> float:
        """m/s by which the robot's head is slower than the golfer's."""
        return max(self.golfer.head_speed - self.swing.delivery.get("head_speed_mps", 0.0), 0.0)


def golfer_row(plant: PlantParameters, golfer: Golfer, swing: Profile) -> GolferRow:
    """Return how far `swing` is from `golfer`."""
    human = human_downswing(plant, golfer)
    return GolferRow(golfer, human, swing, deviation(plant, swing, human))


def golfer_record(plant: PlantParameters, row: GolferRow) -> dict[str, Any]:
    """Return `row` for a program to read; deviations are shares of the human's range."""
    return {
        "golfer": row.golfer.name,
        "text": row.golfer.text,
        "golfer_head_speed_mps": row.golfer.head_speed,
        "model_head_speed_mps": row.human.head_speed,
        "amplitude": row.human.amplitude,
        "robot": row.swing.name,
        "robot_head_speed_mps": row.swing.delivery.get("head_speed_mps"),
        "short_mps": row.short,
        "golfer_downswing_s": float(row.human.time[-1]),
        "robot_downswing_s": row.swing.downswing_time,
        "robot_attack_angle_deg": row.swing.delivery.get("attack_angle_deg"),
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


def _table(title: str, caption: str, *columns: str) -> Table:
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
        title=title,
        caption=caption,
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("golfer", no_wrap=True)
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    return table


def deviations_table(rows: list[GolferRow]) -> Table:
    """Return a row a golfer: how far each joint and the head are from his or hers."""
    table = _table(
        "The robot against golfers",
        "Root mean square over the downswing, clocks laid together at the ball, in % of the human's range; "
        f"Hunt and Wiens quote {100 * HUNT_WIENS:.1f} % without a public definition.",
        "shoulder",
        "arm",
        "wrist",
        "head",
    )
    for row in rows:
        table.add_row(row.golfer.name, *(f"{100 * share:.0f}" for share in row.away))
    return table


def reach_table(rows: list[GolferRow], plant: PlantParameters) -> Table:
    """Return a row a golfer: speed, downswing and attack of golfer and robot, and what is out of reach."""
    table = _table(
        "What of a golfer the robot reaches",
        "Head speed of the golfer, of the model of his or her motion, of the robot, and what that is short "
        "by, m/s; golfer's and robot's downswing, s; the robot's attack angle, deg; how far the golfer goes "
        "beyond the robot's range: shoulder (rad), right arm (m), wrist (rad).",
        "m/s",
        "model",
        "robot",
        "short",
        "downswing",
        "attack",
        "beyond",
    )
    for row in rows:
        speed, attack = (row.swing.delivery.get(key) for key in ("head_speed_mps", "attack_angle_deg"))
        table.add_row(
            row.golfer.name,
            f"{row.golfer.head_speed:.1f}",
            f"{row.human.head_speed:.1f}",
            "" if speed is None else f"{speed:.1f}",
            "" if row.short < _SHORT else f"{row.short:.1f}",
            f"{row.human.time[-1]:.2f} {row.swing.downswing_time:.2f}",
            "" if attack is None else f"{round(attack, 1) + 0.0:+.1f}",  # no minus before nothing
            " ".join(f"{value:.2f}" for value in out_of_reach(plant, row.human)),
        )
    return table


def draw_golfers(rows: list[GolferRow], plant: PlantParameters, path: Path) -> None:
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
