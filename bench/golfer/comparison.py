"""Deviation of a swing from another: of a robot's or a golfer's from a golfer's.

Defined as the root mean square of the difference over the reference's downswing, as far as both have a
motion, clocks aligned at the ball; in per cent of the reference's range of each angle in its whole downswing,
for the head of the longest distance across its path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, isnan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.golfer.capture import Array
from bench.golfer.golfer_file import SUFFIX, GolferSwing, load_golfer
from bench.swing.golfers import Golfer, find_golfer, human_downswing
from bench.swing.profile import FollowedGolfer, Profile
from sim.kinematics import forward_kinematics
from sim.plant import PlantParameters

DEFINITION = (
    "Root mean square over the reference's downswing as far as both have a motion, clocks aligned at the "
    "ball, in per cent of the reference's range (head: of the longest distance across its path, measured "
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
    error: tuple[float, float, float, float]
    """Root mean square of shoulder, arm, wrist (rad) and head (m), NaN where not measured."""
    share: tuple[float, float, float, float]
    """The same as a fraction of the reference's ranges."""
    time: Array
    """Instants (n,) of the reference's downswing at which `other` has a motion (s)."""
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
        cure = "Put the golfer first: NAME.golfer.toml, or model:NAME of a built-in one."
        raise BenchError(f"reference {reference.name}", "a robot's swing", "a golfer's swing", cure)
    whole, whole_head = reference.angle[rows], reference.head[rows]
    rows &= reference.time >= other.time[0] - 1e-9  # a model has no backswing
    time, angle, head = reference.time[rows], reference.angle[rows], reference.head[rows]
    beside = _at(time, other.time, other.angle)
    turns = np.round((beside[-1] - angle[-1]) / (2 * np.pi))
    beside -= 2 * np.pi * np.nan_to_num(turns)
    head_beside = _at(time, other.time, other.head)
    joints = np.sqrt(np.mean((beside - angle) ** 2, axis=0))
    away = float(np.sqrt(np.mean(np.sum((head_beside - head) ** 2, axis=1))))
    some = whole_head[:: max(len(whole_head) // 50, 1)]
    across = float(np.linalg.norm(some[:, None] - whole_head[None], axis=2).max())
    ranges = np.ptp(whole, axis=0)
    shares = joints / np.where(ranges > _NO_RANGE, ranges, np.nan)
    return MotionDeviation(
        reference,
        other,
        (float(joints[0]), float(joints[1]), float(joints[2]), away),
        (
            float(shares[0]),
            float(shares[1]),
            float(shares[2]),
            away / across if across > _NO_RANGE else np.nan,
        ),
        time,
        beside,
        head_beside,
    )


def followed_golfer(golfer: GolferSwing, row: MotionDeviation) -> FollowedGolfer:
    """Return the record, for a profile, of `golfer` and of the deviation `row` of the profile's motion."""
    return {
        "sha256": golfer.digest,
        "follow": golfer.follow,
        "head_speed_mps": round(golfer.head_speed, 3),
        "deviation": [round(share, 5) for share in row.share],
        "rms_rad": [round(error, 5) for error in row.error[:3]],
        "rms_head_m": round(row.error[3], 5),
        "definition": DEFINITION,
    }


def deviation_texts(shares: Sequence[float], errors: Sequence[float]) -> list[str]:
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
