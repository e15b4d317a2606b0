"""The robot's own reference swing: the tables of the thesis' Appendix B, sample by sample.

Source: Meymi, "Modeling and control of parallel arm golfing robot", KTH 2009, Appendix B. Each axis has
a time vector and a value vector of its own; the values are tanh curves over an abscissa that is not
time. Between samples the thesis' simulation interpolates linearly. Three seams of the original
are kept: the backswing ends at 0.68 s and the downswing starts at 0.686 s, the wrist has two samples at
0.4 s, and each curve jumps a little where two pieces meet.

The thesis does not say where the right arm's displacement and the shoulder's offset count from: here both
follow from the geometry, see `ADDRESS_ROD` and `joint_reference`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.kinematics import theta2_from_right_arm
from sim.robot import RobotParameters

TOP = 0.686
"""s; the downswing's first sample"""
ADDRESS_ROD = 0.22
"""Rod stroke at zero displacement, m (ASSUMPTION). At the full stroke of Appendix B the right arm is
0.34 + 0.22 = 0.56 m = l23: both arms are equally long and the hands hang below the middle of the
shoulders, as a golfer stands; and the 0.2030 m of travel stay inside the stroke."""


class Table(NamedTuple):
    """One axis: sample times (s, not decreasing) and values, both (N,)."""

    time: NDArray[np.float64]
    value: NDArray[np.float64]

    def at(self, t: ArrayLike) -> NDArray[np.float64]:
        """Return the values at `t` s by linear interpolation; after the last sample the last value."""
        return np.asarray(np.interp(np.asarray(t, dtype=float), self.time, self.value))


@dataclass(frozen=True)
class ThesisSwing:
    """The three tables of Appendix B."""

    shoulder: Table
    """theta1 from its value at address, rad; 69 + 17 samples"""
    right_arm: Table
    """Right arm's displacement, m, negative is shorter; 69 + 17 samples"""
    wrist: Table
    """theta3, rad; 41 + 29 + 17 samples"""

    @property
    def end(self) -> float:
        """Time of the last sample, s."""
        return float(self.shoulder.time[-1])


def thesis_swing() -> ThesisSwing:
    """Return the tables of Appendix B, computed as its MATLAB statements do."""
    back = colon(0.0, 0.01, 0.686)
    down = colon(TOP, 0.01, TOP + 0.1667)

    shoulder_back = -2.639 * back
    shoulder_down = 11.80 * (down - back[-1]) + shoulder_back[-1]

    arm_back = -(np.tanh(colon(back[0] - 3.0, 0.088, 3.0)) + 1.0) * 0.10175
    arm_down = (np.tanh(colon(down[0] - 3.0, 0.33, 3.0)) - 1.0) * 0.1025

    first, second = colon(0.0, 0.01, 0.4), colon(0.4, 0.01, 0.686)
    wrist_first = -(np.tanh(colon(first[0] - 3.0, 0.15, 3.0)) - 35.0) * 0.3491 / 2.0
    wrist_second = -(np.tanh(colon(second[0] - 3.0, 0.2, 3.0)) - 10.233) * 1.058 / 2.0
    wrist_down = (7.976 + np.tanh(colon(down[0] - 3.0, 0.33, 3.0))) * 1.4 / 2.0

    return ThesisSwing(
        shoulder=_joined((back, shoulder_back), (down, shoulder_down)),
        right_arm=_joined((back, arm_back), (down, arm_down)),
        wrist=_joined((first, wrist_first), (second, wrist_second), (down, wrist_down)),
    )


def joint_reference(swing: ThesisSwing, robot: RobotParameters, t: ArrayLike) -> NDArray[np.float64]:
    """Return the joint angles (theta1, theta2, theta3) in rad at the times `t` (...,) s; shape (..., 3).

    theta2 is the third-quadrant angle that gives the right arm its length l56 + rod + displacement. theta1 is
    such that the shaft points straight down the swing plane (theta_T = 3 pi / 2) at the first sample
    (ASSUMPTION): it turns the whole swing, changes no speed, and of the efforts gravity's part only.
    """
    arm = robot.l56 + ADDRESS_ROD
    theta2 = theta2_from_right_arm(robot, arm + swing.right_arm.at(t))
    begin = theta2_from_right_arm(robot, arm + swing.right_arm.value[0])
    shaft_down = 1.5 * np.pi - float(begin) - swing.wrist.value[0]
    theta1 = float(np.remainder(shaft_down + np.pi, 2.0 * np.pi) - np.pi) + swing.shoulder.at(t)
    return np.stack([theta1, theta2, swing.wrist.at(t)], axis=-1)


def colon(start: float, step: float, stop: float) -> NDArray[np.float64]:
    """Return start, start + step, … up to stop, as MATLAB's `start:step:stop` counts its samples."""
    count = int(np.floor((stop - start) / step * (1.0 + 1e-12))) + 1
    return start + step * np.arange(count, dtype=np.float64)


def _joined(*pieces: tuple[NDArray[np.float64], NDArray[np.float64]]) -> Table:
    times, values = zip(*pieces, strict=True)
    return Table(np.concatenate(times), np.concatenate(values))
