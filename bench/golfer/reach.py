"""Reach of a machine: excess of a motion beyond its ranges, and the angles that hold the club as a golfer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.golfer.golfer_file import GolferSwing
from sim.kinematics import inverse_kinematics, right_arm_length
from sim.plant import PlantParameters

_FAR = 0.02
"""Distance (m) by which the arm may miss the wrist of the club: it then goes as near as it can."""


def beyond_ranges(plant: PlantParameters, angle: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the excess of `angle` (n, 3; rad) beyond shoulder (rad), right arm (m) and wrist (rad).

    A joint that was not measured (NaN) has excess NaN.
    """
    extension = right_arm_length(plant.robot, angle[:, 1]) - plant.robot.l56
    places = (angle[:, 0], extension, angle[:, 2])
    shoulder, arm, wrist = (
        float(np.max([actuator.lower - np.min(place), np.max(place) - actuator.upper, 0.0]))
        for actuator, place in zip(plant.actuators, places, strict=True)
    )
    return shoulder, arm, wrist


def require_club(golfer: GolferSwing) -> None:
    """Refuse a `golfer` whose shaft or head were not measured from the top on.

    Raises:
        BenchError: they were not.
    """
    down = slice(golfer.top_row, None)
    if not np.isfinite(np.column_stack([golfer.angle, golfer.head])[down]).all():
        cure = "Import a recording with grip and head of the club."
        raise BenchError(str(golfer.path), "a body without a club", "a measured club", cure)


def with_club_held(plant: PlantParameters, golfer: GolferSwing) -> GolferSwing:
    """Return `golfer` with the angles, from the top on, at which the robot of `plant` holds its club alike.

    The face is where the measured head is, as seen from the ball, and the shafts are parallel.

    Raises:
        BenchError: shaft and head were not measured, or the arm does not reach the club.
    """
    require_club(golfer)
    robot, site, down = plant.robot, plant.site, slice(golfer.top_row, None)
    theta_t, head = golfer.angle.sum(axis=1)[down], golfer.head[down] + (site.ball_x, site.ball_y)
    shaft = robot.club.length_to_face * np.stack([np.cos(theta_t), np.sin(theta_t)], axis=1)
    wrist = head - shaft
    distance = np.linalg.norm(wrist, axis=1)
    nearest, farthest = abs(robot.l12 - robot.l23), robot.l12 + robot.l23
    reached = np.clip(distance, nearest, farthest)
    row = int(np.argmax(np.abs(distance - reached)))
    if abs(distance[row] - reached[row]) > _FAR:
        raise BenchError(
            f"{golfer.path}, {-1e3 * golfer.time[down][row]:.0f} ms before the ball",
            f"the wrist {distance[row]:.3f} m from the shoulder's axis, to hold this club so",
            f"{nearest:.3f} to {farthest:.3f} m, where the arm reaches",
            "Use --follow body, mount a club of the golfer's length, or size a machine with golfbench size.",
        )
    wrist *= (reached / distance)[:, None]
    held = inverse_kinematics(robot, np.column_stack([wrist + shaft, theta_t]))
    held[:, 0] = np.unwrap(held[::-1, 0])[::-1]  # continuous up to the ball: the top may be beyond -pi
    held[:, 2] = theta_t - held[:, 0] - held[:, 1]
    held[:, 2] += 2 * np.pi * np.round((golfer.angle[down, 2] - held[:, 2]) / (2 * np.pi))
    angle = np.full_like(golfer.angle, np.nan)
    angle[down] = held
    return replace(golfer, follow="club", angle=angle)
