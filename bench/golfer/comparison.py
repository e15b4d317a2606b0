"""Deviation of a robot's or golfer's swing from a golfer's swing.

Defined as the root mean square of the difference over the reference's downswing, as far as both have a
motion, clocks aligned at the ball; in per cent of the reference's range of each angle in its whole downswing,
for the head of the longest distance across its path.

The reach of a machine: excess of a motion beyond its ranges, and the angles that hold the club as a golfer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import degrees, isnan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.golfer.golfer_file import SUFFIX, GolferSwing, load_golfer
from bench.golfer.roles import Array
from bench.swing.golfers import Golfer, find_golfer, human_downswing
from bench.swing.profile import FollowedGolfer, Profile
from sim.kinematics import forward_kinematics, inverse_kinematics, right_arm_length
from sim.plant import PlantParameters

DEFINITION = (
    "Root mean square over the reference's downswing as far as both have a motion, clocks aligned at the "
    "ball, in per cent of the reference's range (for the head: longest distance across its path, measured "
    "from the ball)"
)
HUNT_WIENS = 0.096
"""Deviation that Hunt and Wiens (2003) report, without a definition."""

_NO_RANGE = 1e-3
"""Range (rad, m) below which the reference does not move, and a fraction of it means nothing."""


@dataclass(frozen=True)
class SwingMotion:
    """A swing up to the ball, as any source gives it."""

    name: str
    source: str
    """Kind of source: measured, model or robot."""
    time: Array
    """Time (n,), 0 at the ball (s)."""
    angle: Array
    """theta1, theta2, theta3 (n, 3), NaN where not measured (rad)."""
    head: Array
    """Head path (n, 2) from the ball, NaN where not measured (m)."""
    downswing: float
    """Duration of the downswing (s)."""
    head_speed: float
    """Head speed at the ball, NaN where not measured (m/s)."""

    @property
    def in_downswing(self) -> NDArray[np.bool_]:
        """Whether each row belongs to the downswing (n,)."""
        return self.time >= -self.downswing - 1e-9


@dataclass(frozen=True)
class MotionDeviation:
    """Deviation of `other` from `reference`."""

    reference: SwingMotion
    other: SwingMotion
    error: Array
    """Root mean square (4,) of shoulder, arm, wrist (rad) and head (m), NaN where not measured."""
    share: Array
    """RMS errors (4,) as fractions of the reference's ranges."""
    time: Array
    """Times (n,) of the reference's downswing for which `other` has data (s)."""
    beside: Array
    """Angles (n, 3) of `other` at these instants (rad)."""
    head_beside: Array
    """Head (n, 2) of `other` at these instants (m)."""


def golfer_named(name: str) -> Golfer | GolferSwing:
    """Return the measured golfer in the file `name`, or the built-in one of that name.

    Raises:
        BenchError: no golfer has that name, or the file cannot be read.
    """
    return load_golfer(Path(name)) if name.endswith(SUFFIX) else find_golfer(name)


def golfer_motion(plant: PlantParameters, golfer: Golfer | GolferSwing) -> SwingMotion:
    """Return the motion of a measured golfer, or of a built-in one's model on the site of `plant`."""
    if not isinstance(golfer, Golfer):
        g = golfer
        return SwingMotion(g.name, "measured", g.time, g.angle, g.head, g.downswing_time, g.head_speed)
    human = human_downswing(plant, golfer)
    time, lasting = human.time - human.time[-1], float(human.time[-1])
    head = human.head - [plant.site.ball_x, plant.site.ball_y]
    return SwingMotion(golfer.name, "model", time, human.angle, head, lasting, human.head_speed)


def robot_motion(plant: PlantParameters, profile: Profile) -> SwingMotion:
    """Return the motion of a robot's profile up to its planned impact."""
    rows = int(profile.impact_time / profile.period) + 2
    time: Array = np.arange(min(rows, len(profile.angle)), dtype=float) * profile.period
    time -= profile.impact_time
    angle = np.asarray(profile.angle[: len(time)], dtype=float)
    head = forward_kinematics(plant.robot, angle)[:, :2] - [plant.site.ball_x, plant.site.ball_y]
    speed = float(profile.delivery.get("head_speed_mps", np.nan))
    return SwingMotion(profile.name, "robot", time, angle, head, profile.downswing_time, speed)


def compare_motions(reference: SwingMotion, other: SwingMotion) -> MotionDeviation:
    """Return the deviation of `other` from `reference`.

    Raises:
        BenchError: the reference is a robot's swing, or has less than 3 rows of a downswing.
    """
    rows = reference.in_downswing
    if reference.source == "robot" or np.count_nonzero(rows) < 3:
        action = "Put the golfer first: NAME.golfer.toml, or model:NAME of a built-in one."
        raise BenchError(f"reference {reference.name}", "a robot's swing", "a golfer's swing", action)
    whole, whole_head = reference.angle[rows], reference.head[rows]
    rows &= reference.time >= other.time[0] - 1e-9  # a model has no backswing
    time, angle, head = reference.time[rows], reference.angle[rows], reference.head[rows]
    beside = _at(time, other.time, other.angle)
    turns = np.round((beside[-1] - angle[-1]) / (2 * np.pi))
    beside -= 2 * np.pi * np.nan_to_num(turns)
    head_beside = _at(time, other.time, other.head)
    away = np.sqrt(np.mean(np.sum((head_beside - head) ** 2, axis=1)))
    error = np.append(np.sqrt(np.mean((beside - angle) ** 2, axis=0)), away)
    some = whole_head[:: max(len(whole_head) // 50, 1)]
    across = np.linalg.norm(some[:, None] - whole_head[None], axis=2).max()
    ranges = np.append(np.ptp(whole, axis=0), across)
    share = error / np.where(ranges > _NO_RANGE, ranges, np.nan)
    return MotionDeviation(reference, other, error, share, time, beside, head_beside)


def followed_golfer(golfer: GolferSwing, row: MotionDeviation) -> FollowedGolfer:
    """Return the record, for a profile, of `golfer` and of the deviation `row` of the profile's motion."""
    return {
        "sha256": golfer.digest,
        "follow": golfer.follow,
        "head_speed_mps": round(golfer.head_speed, 3),
        "deviation": row.share.round(5).tolist(),
        "rms_rad": row.error[:3].round(5).tolist(),
        "rms_head_m": round(float(row.error[3]), 5),
        "definition": DEFINITION,
    }


def deviation_texts(shares: Sequence[float] | Array, errors: Sequence[float] | Array) -> list[str]:
    """Return the deviations of shoulder, arm, wrist (errors in rad) and head (m): per cent with ° and mm."""
    sizes = [f"{degrees(error):.1f}°" for error in errors[:3]] + [f"{1e3 * errors[3]:.0f} mm"]
    pairs = zip(shares, sizes, strict=True)
    return ["not measured" if isnan(share) else f"{100 * share:.1f} % {size}" for share, size in pairs]


def followed_texts(followed: FollowedGolfer) -> list[str]:
    """Return the deviations that a profile states, as `deviation_texts`."""
    return deviation_texts(followed["deviation"], [*followed["rms_rad"], followed["rms_head_m"]])


def _at(time: Array, own: Array, values: Array) -> Array:
    """Return the columns of `values` (n, k) at `time` (s), linear between the instants `own` (s)."""
    return np.column_stack([np.interp(time, own, column) for column in values.T])


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
        action = "Import a recording with grip and head of the club."
        raise BenchError(str(golfer.path), "a body without a club", "a measured club", action)


def with_club_held(plant: PlantParameters, golfer: GolferSwing) -> GolferSwing:
    """Return `golfer` with angles, from the top on, at which the robot of `plant` holds the club as measured.

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
