"""The thesis' own simulation, run again: its reference, its PID, ideal actuators that saturate.

Source: Meymi, "Modeling and control of parallel arm golfing robot", KTH 2009, section 3 and Appendix B.
Taken from there: the tables, P = 1000, I = 0.92, D = 1 on each joint angle with the derivative on the
measured angular velocity, one saturation per output, joint friction proportional to velocity and found by
experiment, its club and the bodies of Appendix B, no end stops, no anti-windup.

Left open there, and chosen here:
- The output for theta2 is the right arm's force in N ("forces and torques" leave the controller and
  the prismatic joint is driven).
- Saturation: constant limits, as a saturation block has them, of the default plant's actuators, see `LIMIT`.
- Friction: one coefficient for the three joints, as it uses one PID for the three, see `FRICTION`.
- Where the tables count from, see `ADDRESS_ROD`. After the last sample they are held.

Its reference swing are the tables of Appendix B, sample by sample. Each axis has separate time and value
vectors; the values are tanh curves over an abscissa that is not time. Between samples the thesis' simulation
interpolates linearly. Three seams of the original are kept: the backswing ends at 0.68 s and the downswing
starts at 0.686 s; the wrist has two samples at 0.4 s; and each curve jumps a little where two pieces meet.

The thesis does not say where the right arm's displacement and the shoulder's offset count from: here both
follow from the geometry, see `ADDRESS_ROD` and `joint_reference`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import pi
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp

from sim.kane import bias_forces, mass_matrix
from sim.kinematics import forward_kinematics, head_motion, right_arm_length, theta2_from_right_arm
from sim.robot import Body, RobotParameters, thesis_robot

TOP = 0.686
"""Time of the downswing's first sample (s)."""
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


Array = NDArray[np.float64]
Triple = tuple[float, float, float]

PROPORTIONAL, INTEGRAL, DERIVATIVE = 1000.0, 0.92, 1.0
"""Gains of each joint, per rad of error: N m, N, N m."""
_GAUGE_PRESSURE = 8.0e5 - 101_325.0
_CYLINDER_FORCE = pi / 4.0 * 0.05**2 * _GAUGE_PRESSURE
LIMIT: Triple = (4e-4 * _GAUGE_PRESSURE, _CYLINDER_FORCE, 0.06 * _CYLINDER_FORCE)
"""Largest actuator output, 279 N m, 1372 N, 82 N m (ASSUMPTION): a vane of 4e-4 m3/rad, cylinders of 50 mm
bore, a wrist lever of 0.06 m, 8 bar absolute against the atmosphere."""
FRICTION = 10.0
"""Viscous friction of each joint, N m s/rad (ASSUMPTION): the smallest multiple of 0.5 with which the swing
is stable and every oscillation of the loop decays to a quarter in a period or faster, the classical rule
for loops tuned by experiment (Ziegler and Nichols 1942)."""
DURATION, TIME_STEP = 1.0, 2e-4
"""Duration and time step (s); the tables end at 0.846 s."""


@dataclass(frozen=True)
class ExperimentSummary:
    """The experiment in figures. Errors and saturation count from the start to the ball (or tables' end)."""

    stable: bool
    """All values are finite, and theta2 stayed between the two singular, stretched positions of the parallel
    arm."""
    top_time: float
    """Time at which theta1 turns round (s)."""
    contact_time: float | None
    """Time at which the head passes the ball's x (s), None when it does not."""
    height_error: float | None
    """Height y of the head above the ball at that time (m)."""
    club_speed: float | None
    """Head speed at that time (m/s)."""
    largest_error: Triple
    """Max |reference - angle| of each joint (rad)."""
    saturated: Triple
    """Share of the time in saturation, 0 to 1, of each actuator"""
    rod_range: tuple[float, float]
    """Range of the rod without end stops (m)."""


@dataclass(frozen=True)
class ThesisExperiment:
    """Recording of a run. N = duration / time step + 1; joint and actuator order as everywhere."""

    robot: RobotParameters
    friction: float
    limit: Array
    """(3,)"""
    time: Array
    """(N,) s"""
    reference: Array
    """(N, 3) rad"""
    angle: Array
    """(N, 3) rad"""
    velocity: Array
    """(N, 3) rad/s"""
    demand: Array
    """(N, 3) controller outputs before saturation: N m, N, N m"""
    head: Array
    """(N, 2) x, y of the club head, m"""
    reference_head: Array
    """(N, 2); it begins at the ball"""

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """True where the demand exceeds the limit, (N, 3)."""
        return np.abs(self.demand) > self.limit

    @cached_property
    def summary(self) -> ExperimentSummary:
        """The experiment in figures."""
        robot, angle, time, ball = self.robot, self.angle, self.time, self.reference_head[0]
        contact = _contact(time, self.head, ball)
        contact_time = height_error = club_speed = None
        if contact is not None:
            i, share = contact

            def between(values: Array) -> Array:
                return np.asarray(values[i] + share * (values[i + 1] - values[i]))

            contact_time = float(between(time))
            height_error = float(between(self.head)[1] - ball[1])
            motion = head_motion(robot.record[0], *between(angle), *between(self.velocity))
            club_speed = float(np.hypot(motion[3], motion[4]))
        window = time <= (thesis_swing().end if contact_time is None else contact_time)
        rod = right_arm_length(robot, angle[window, 1]) - robot.l56
        least, most = angle[:, 1].min(), angle[:, 1].max()
        return ExperimentSummary(
            stable=bool(np.all(np.isfinite(angle)) and least > pi and most < 2.0 * pi),
            top_time=float(time[window][angle[window, 0].argmin()]),
            contact_time=contact_time,
            height_error=height_error,
            club_speed=club_speed,
            largest_error=_triple(np.abs(self.reference - angle)[window].max(axis=0)),
            saturated=_triple(self.saturated[window].mean(axis=0)),
            rod_range=(float(rod.min()), float(rod.max())),
        )


def appendix_b_robot() -> RobotParameters:
    """Return the robot the thesis simulated: Appendix B's rod (l45 = 0.22 m, inertia of a cylinder)."""
    return replace(thesis_robot(), rod=Body(0.6, 0.11, 0.6 * (3.0 * 0.05**2 + 0.2**2) / 12.0))


def run_thesis_experiment(friction: float = FRICTION, limit: Triple = LIMIT) -> ThesisExperiment:
    """Run the experiment with the `friction` (N m s/rad) of each joint and the `limit` of each actuator."""
    robot, swing, most = appendix_b_robot(), thesis_swing(), np.array(limit)
    time = np.linspace(0.0, DURATION, round(DURATION / TIME_STEP) + 1)
    reference = joint_reference(swing, robot, time)

    def rates(t: float, state: Array) -> Array:
        return loop_rates(robot, joint_reference(swing, robot, t), state, friction, most)

    begin = np.concatenate([reference[0], np.zeros(6)])
    state = solve_ivp(rates, (0.0, DURATION), begin, t_eval=time, max_step=2e-3, rtol=1e-6, atol=1e-8).y.T
    angle = state[:, :3]
    return ThesisExperiment(
        robot,
        friction,
        most,
        time,
        reference,
        angle,
        velocity=state[:, 3:6],
        demand=_demand(reference, state),
        head=forward_kinematics(robot, angle)[:, :2],
        reference_head=forward_kinematics(robot, reference)[:, :2],
    )


def loop_rates(
    robot: RobotParameters, reference: Array, state: Array, friction: float, limit: Array
) -> Array:
    """Return the rate of the closed loop's `state` (q, u, integral of the error), (9,)."""
    angle, velocity = state[:3], state[3:6]
    effort = np.clip(_demand(reference, state), -limit, limit)
    lever = -robot.l62 * robot.l23 * np.sin(angle[1]) / right_arm_length(robot, angle[1])
    torque = effort * np.array([1.0, lever, 1.0]) - friction * velocity
    acceleration = np.linalg.solve(mass_matrix(robot, angle), torque - bias_forces(robot, angle, velocity))
    return np.concatenate([velocity, acceleration, reference - angle])


def _demand(reference: Array, state: Array) -> Array:
    """Return the controllers' outputs (..., 3) at `state` (..., 9)."""
    error = reference - state[..., :3]
    return PROPORTIONAL * error + INTEGRAL * state[..., 6:] - DERIVATIVE * state[..., 3:6]


def _triple(values: Array) -> Triple:
    return float(values[0]), float(values[1]), float(values[2])


def _contact(time: Array, head: Array, ball: Array) -> tuple[int, float] | None:
    """Return the step (index, share of it) in which the head passes the ball's x below the shoulder."""
    before = head[:, 0] - ball[0]
    passing = (before[:-1] < 0.0) & (before[1:] >= 0.0) & (head[1:, 1] < 0.0) & (time[:-1] > TOP)
    where = np.flatnonzero(passing)
    if not len(where):
        return None
    i = int(where[0])
    return i, float(before[i] / (before[i] - before[i + 1]))
