"""The thesis' own simulation, run again: its reference, its PID, ideal actuators that saturate.

Source: Meymi, "Modeling and control of parallel arm golfing robot", KTH 2009, section 3 and Appendix B.
Taken from there: the tables, P = 1000, I = 0.92, D = 1 on each joint angle with the derivative on the
measured angular velocity, one saturation per output, joint friction proportional to velocity and found by
experiment, its club and the bodies of Appendix B, no end stops, no anti-windup.

Left open there, and chosen here (each is a parameter; `variants` shows what each one does):
- The output for theta2 is the right arm's force in N ("forces and torques" leave the controller and
  the prismatic joint is driven): arm_output = "force".
- Saturation: constant limits, as a saturation block has them, of the default plant's actuators: vane
  4e-4 m3/rad, cylinders of 50 mm bore, wrist lever 0.06 m, 8 bar absolute against the atmosphere. That
  the lever loses authority with |sin beta| (thesis figure 11) is a variant.
- Friction: one coefficient for the three joints, as it uses one PID for the three: the smallest one
  with which the swing is stable and every oscillation of the loop decays to a quarter in a period or
  faster (`find_friction`). A quarter is the classical rule for loops tuned by experiment (Ziegler and
  Nichols 1942).
- Where the tables count from: `Address`. After the last sample they are held.
- The solver: continuous PID, fixed steps of fourth order, far below the step at which results move.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import log, pi, sin
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.swing.tables import TOP, Address, ThesisSwing, joint_reference, thesis_swing
from drivers.base.compiled import compiled
from sim.kane import inverse_dynamics, kane_terms, solve_symmetric
from sim.kinematics import forward_kinematics, head_motion, right_arm_length
from sim.robot import Body, RobotParameters, thesis_robot

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

QUARTER_DECAY = log(4.0) / (4.0 * pi**2 + log(4.0) ** 2) ** 0.5
"""Damping ratio at which an oscillation decays to a quarter in a period: 0.215."""

_GAUGE_PRESSURE = 8.0e5 - 101_325.0
_CYLINDER_FORCE = pi / 4.0 * 0.05**2 * _GAUGE_PRESSURE


@dataclass(frozen=True)
class ThesisParameters:
    """The experiment's settings, in joint order; ValueError for a value that makes no sense."""

    proportional: Triple = (1000.0, 1000.0, 1000.0)
    """Per rad of error: N m, N, N m."""
    integral: Triple = (0.92, 0.92, 0.92)
    derivative: Triple = (1.0, 1.0, 1.0)
    limit: Triple = (4e-4 * _GAUGE_PRESSURE, _CYLINDER_FORCE, 0.06 * _CYLINDER_FORCE)
    """Largest actuator output: 279 N m, 1372 N, 82 N m (ASSUMPTION)."""
    friction: Triple | None = None
    """Viscous joint friction, N m s/rad; None: found by `find_friction` (ASSUMPTION)."""
    arm_output: Literal["force", "torque"] = "force"
    """What the controller of theta2 puts out: the right arm's force, or the torque about R2."""
    wrist_lever: bool = False
    """Whether the wrist's limit falls with |sin beta|, beta = theta3 - 3 pi / 2."""
    address: Address = field(default_factory=Address)
    extrapolate: bool = False
    """Whether the tables go on with their last slope after their last sample."""
    duration: float = 1.0
    """s; the tables end at 0.846 s"""
    time_step: float = 2e-4
    """s; integration step: a tenth of it moves the height at the ball by 4 um"""

    def __post_init__(self) -> None:
        friction = (0.0, 0.0, 0.0) if self.friction is None else self.friction
        for name, values, least in (
            ("proportional", self.proportional, 1e-9),
            ("integral", self.integral, 0.0),
            ("derivative", self.derivative, 0.0),
            ("limit", self.limit, 1e-9),
            ("friction", friction, 0.0),
        ):
            greatest = np.inf if name == "limit" else np.finfo(float).max  # no limit is a useful case
            if np.shape(values) != (3,) or not all(least <= value <= greatest for value in values):
                raise ValueError(f"{name}: found {values}; expected three numbers of at least {least:g}")
        if self.arm_output not in ("force", "torque"):
            raise ValueError(f"arm_output: found {self.arm_output!r}; expected 'force' or 'torque'")
        if not 0.85 <= self.duration <= 60.0:
            raise ValueError(f"duration: found {self.duration} s; expected 0.85 to 60 s")
        if not 1e-6 <= self.time_step <= 1e-3:
            raise ValueError(f"time_step: found {self.time_step} s; expected 1e-6 to 1e-3 s")


@dataclass(frozen=True)
class ExperimentSummary:
    """The experiment in figures. Errors and saturation count from the start to the ball (or tables' end)."""

    stable: bool
    """Finite, and theta2 stayed between the two stretched positions of the parallel arm."""
    top_time: float
    """s; the instant at which theta1 turns round"""
    contact_time: float | None
    """s; the instant at which the head passes the ball's x, None when it does not"""
    height_error: float | None
    """m; y of the head above the ball at that instant"""
    club_speed: float | None
    """m/s; speed of the head at that instant"""
    largest_error: Triple
    """rad; largest |reference - angle| of each joint"""
    rms_error: Triple
    """rad"""
    saturated: Triple
    """Share of the time in saturation, 0 to 1, of each actuator"""
    peak_demand: Triple
    """Largest controller output before saturation, in limits"""
    rod_range: tuple[float, float]
    """m; reached without end stops"""
    wrist_range: tuple[float, float]
    """rad; theta3 reached without end stops"""


class FrictionTrial(NamedTuple):
    """One step of the search for the friction."""

    friction: float
    """N m s/rad, each joint"""
    damping: float
    """Smallest damping ratio of the linearised loop at any pose of the reference"""
    summary: ExperimentSummary

    @property
    def accepted(self) -> bool:
        """Whether this friction makes the swing stable and well damped."""
        return self.summary.stable and self.damping >= QUARTER_DECAY


@dataclass(frozen=True)
class ThesisExperiment:
    """What a run recorded. N = duration / time step + 1; joint and actuator order as everywhere."""

    parameters: ThesisParameters
    """As used: friction is a number here."""
    robot: RobotParameters
    swing: ThesisSwing
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
    effort: Array
    """(N, 3) after saturation"""
    limit: Array
    """(N, 3) largest effort at that instant"""
    head: Array
    """(N, 2) x, y of the club head, m"""
    reference_head: Array
    """(N, 2)"""
    ball: tuple[float, float]
    """m; where the head stands at the first sample"""
    search: tuple[FrictionTrial, ...] = ()
    """How the friction was found; empty when it was given"""

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """True where the demand exceeds the limit, (N, 3)."""
        return np.abs(self.demand) > self.limit

    @cached_property
    def summary(self) -> ExperimentSummary:
        """The experiment in figures."""
        robot, angle, time = self.robot, self.angle, self.time
        contact = _contact(time, self.head, self.ball)
        contact_time = height_error = club_speed = None
        if contact is not None:
            i, share = contact

            def between(values: Array) -> Array:
                return np.asarray(values[i] + share * (values[i + 1] - values[i]))

            contact_time = float(between(time))
            height_error = float(between(self.head)[1]) - self.ball[1]
            motion = head_motion(robot.record[0], *between(angle), *between(self.velocity))
            club_speed = float(np.hypot(motion[3], motion[4]))
        window = time <= (self.swing.end if contact_time is None else contact_time)
        error = (self.reference - angle)[window]
        with np.errstate(invalid="ignore"):
            overload = np.abs(self.demand[window]) / self.limit[window]
        rod = right_arm_length(robot, angle[window, 1]) - robot.l56
        least, most = angle[:, 1].min(), angle[:, 1].max()
        return ExperimentSummary(
            stable=bool(np.all(np.isfinite(angle)) and least > pi and most < 2.0 * pi),
            top_time=float(time[window][angle[window, 0].argmin()]),
            contact_time=contact_time,
            height_error=height_error,
            club_speed=club_speed,
            largest_error=_triple(np.abs(error).max(axis=0)),
            rms_error=_triple(np.sqrt((error**2).mean(axis=0))),
            saturated=_triple((overload > 1.0).mean(axis=0)),
            peak_demand=_triple(overload.max(axis=0)),
            rod_range=(float(rod.min()), float(rod.max())),
            wrist_range=(float(angle[window, 2].min()), float(angle[window, 2].max())),
        )


def appendix_b_robot() -> RobotParameters:
    """Return the robot the thesis simulated: Appendix B's rod (l45 = 0.22 m, inertia of a cylinder)."""
    return replace(thesis_robot(), rod=Body(0.6, 0.11, 0.6 * (3.0 * 0.05**2 + 0.2**2) / 12.0))


def run_thesis_experiment(parameters: ThesisParameters | None = None) -> ThesisExperiment:
    """Run the experiment; 20 ms of work once compiled, plus the friction search when it is not given.

    Raises:
        ValueError: a parameter or the address is outside its range; nothing was run.
    """
    parameters = parameters or ThesisParameters()
    search = find_friction(parameters) if parameters.friction is None else ()
    if search:
        parameters = replace(parameters, friction=(search[-1].friction,) * 3)
    return replace(_run(parameters, appendix_b_robot(), thesis_swing()), search=search)


def find_friction(
    parameters: ThesisParameters | None = None, step: float = 0.5, most: float = 40.0
) -> tuple[FrictionTrial, ...]:
    """Raise the friction from zero until swing and loop are quiet; return all trials, the last accepted.

    Raises:
        ValueError: no value up to `most` N m s/rad is accepted, or a parameter is out of range.
    """
    parameters = parameters or ThesisParameters()
    robot, swing = appendix_b_robot(), thesis_swing()
    trials: list[FrictionTrial] = []
    for friction in step * np.arange(int(most / step) + 1):
        trial = replace(parameters, friction=(float(friction),) * 3)
        trials.append(
            FrictionTrial(
                float(friction), least_damping(trial, robot, swing), _run(trial, robot, swing).summary
            )
        )
        if trials[-1].accepted:
            return tuple(trials)
    raise ValueError(
        f"no joint friction up to {most} N m s/rad makes the swing stable with damping {QUARTER_DECAY:.3f}; "
        f"the last trial has damping {trials[-1].damping:.3f}: lower the gains, raise the limits or "
        "give the friction"
    )


def least_damping(parameters: ThesisParameters, robot: RobotParameters, swing: ThesisSwing) -> float:
    """Return the smallest damping ratio of the unsaturated loop, linearised at rest at each sample's pose.

    Negative when a mode grows. `parameters.friction` must be given.
    """
    settings = _settings(replace(parameters, limit=(np.inf,) * 3))
    smallest = 1.0
    poses = joint_reference(swing, robot, swing.shoulder.time, parameters.address)
    for pose, hold in zip(poses, inverse_dynamics(robot, poses, np.zeros(3), np.zeros(3)), strict=True):
        matrix = np.empty((9, 9))
        _linearise(robot.record, pose, hold, *settings, matrix)
        poles = np.linalg.eigvals(matrix)
        oscillating = poles[np.abs(poles) > 1e-9]
        smallest = min(smallest, float((-oscillating.real / np.abs(oscillating)).min()))
    return smallest


def variants(parameters: ThesisParameters) -> dict[str, ExperimentSummary]:
    """Return the outcome when one choice that the thesis leaves open is made otherwise, the rest equal.

    `parameters.friction` must be given.
    """
    lever_wrist = replace(parameters, wrist_lever=not parameters.wrist_lever)
    other: Literal["force", "torque"] = "torque" if parameters.arm_output == "force" else "force"
    cases = {
        "as run": parameters,
        "wrist limit falls with |sin β|" if lever_wrist.wrist_lever else "wrist limit constant": lever_wrist,
        f"θ2 controller puts out a {other}": replace(parameters, arm_output=other),
        "θ1 = 0 at address": replace(parameters, address=replace(parameters.address, theta1=0.0)),
        "rod 0.204 m at address": replace(parameters, address=replace(parameters.address, rod=0.204)),
        "tables go on with their last slope": replace(parameters, extrapolate=True),
        "actuators without limits": replace(parameters, limit=(np.inf,) * 3),
        "no friction": replace(parameters, friction=(0.0, 0.0, 0.0)),
    }
    robot, swing = appendix_b_robot(), thesis_swing()
    return {name: _run(case, robot, swing).summary for name, case in cases.items()}


def _settings(parameters: ThesisParameters) -> tuple[Array, Array, Array, bool, bool]:
    if parameters.friction is None:
        raise ValueError("friction: found None; give three numbers (find_friction finds them)")
    return (
        np.array([parameters.proportional, parameters.integral, parameters.derivative]),
        np.array(parameters.limit),
        np.array(parameters.friction),
        parameters.arm_output == "torque",
        parameters.wrist_lever,
    )


def _run(parameters: ThesisParameters, robot: RobotParameters, swing: ThesisSwing) -> ThesisExperiment:
    steps = round(parameters.duration / parameters.time_step)
    half_steps = 0.5 * parameters.time_step * np.arange(2 * steps + 1, dtype=np.float64)
    reference = joint_reference(swing, robot, half_steps, parameters.address, parameters.extrapolate)
    state, demand, limit = np.zeros((steps + 1, 9)), np.empty((steps + 1, 3)), np.empty((steps + 1, 3))
    state[0, :3] = reference[0]
    _simulate(robot.record, reference, parameters.time_step, *_settings(parameters), state, demand, limit)
    angle, reference = state[:, :3].copy(), reference[::2].copy()
    head, reference_head = (forward_kinematics(robot, q)[:, :2] for q in (angle, reference))
    return ThesisExperiment(
        parameters=parameters,
        robot=robot,
        swing=swing,
        time=half_steps[::2].copy(),
        reference=reference,
        angle=angle,
        velocity=state[:, 3:6].copy(),
        demand=demand,
        effort=np.clip(demand, -limit, limit),
        limit=limit,
        head=head,
        reference_head=reference_head,
        ball=(float(reference_head[0, 0]), float(reference_head[0, 1])),
    )


def _triple(values: Array) -> Triple:
    return float(values[0]), float(values[1]), float(values[2])


def _contact(time: Array, head: Array, ball: tuple[float, float]) -> tuple[int, float] | None:
    """Return the step (index, share of it) in which the head passes the ball's x below the shoulder."""
    before = head[:, 0] - ball[0]
    passing = (before[:-1] < 0.0) & (before[1:] >= 0.0) & (head[1:, 1] < 0.0) & (time[:-1] > TOP)
    where = np.flatnonzero(passing)
    if not len(where):
        return None
    i = int(where[0])
    return i, float(before[i] / (before[i] - before[i + 1]))


@compiled
def _rates(
    r: Any,
    x: Array,
    reference: Array,
    gains: Array,
    limits: Array,
    friction: Array,
    arm_torque: bool,
    wrist_lever: bool,
    rate: Array,
    demand: Array,
    limit: Array,
) -> None:
    """Fill the rate of the closed loop's state x = (q, u, integral of the error), all (9,).

    Also fills the controller's `demand` and the actuators' `limit` at this state, both (3,). `gains` is
    (3, 3): P, I, D by joint; `r` is a ROBOT record.
    """
    m11, m12, m13, m22, m23, m33, h1, h2, h3, lever = kane_terms(r, x[0], x[1], x[2], x[3], x[4], x[5])
    for i in range(3):
        error = reference[i] - x[i]
        demand[i] = gains[0, i] * error + gains[1, i] * x[6 + i] - gains[2, i] * x[3 + i]
        limit[i] = limits[i]
        rate[i] = x[3 + i]
        rate[6 + i] = error
    if arm_torque:
        demand[1] /= lever
    if wrist_lever:
        limit[2] *= abs(sin(x[2] - 1.5 * pi))
    torque_a = min(max(demand[0], -limit[0]), limit[0]) - friction[0] * x[3]
    torque_b = lever * min(max(demand[1], -limit[1]), limit[1]) - friction[1] * x[4]
    torque_c = min(max(demand[2], -limit[2]), limit[2]) - friction[2] * x[5]
    rate[3], rate[4], rate[5] = solve_symmetric(
        m11, m12, m13, m22, m23, m33, torque_a - h1, torque_b - h2, torque_c - h3
    )


@compiled
def _simulate(
    robot: np.ndarray[Any, Any],
    reference: Array,
    step: float,
    gains: Array,
    limits: Array,
    friction: Array,
    arm_torque: bool,
    wrist_lever: bool,
    state: Array,
    demand: Array,
    limit: Array,
) -> None:
    """Integrate the loop from state[0] by the classical Runge-Kutta method.

    `reference` (2 N - 1, 3) comes every half step; `state` (N, 9), `demand` and `limit` (N, 3) are filled.
    """
    r = robot[0]
    rate = np.empty((4, 9))
    x = np.empty(9)
    spare_demand, spare_limit = np.empty(3), np.empty(3)
    last = state.shape[0] - 1
    for n in range(last + 1):
        _rates(
            r,
            state[n],
            reference[2 * n],
            gains,
            limits,
            friction,
            arm_torque,
            wrist_lever,
            rate[0],
            demand[n],
            limit[n],
        )
        if n == last:
            break
        for stage in range(1, 4):
            ahead = 2 if stage == 3 else 1  # half steps
            for i in range(9):
                x[i] = state[n, i] + 0.5 * ahead * step * rate[stage - 1, i]
            _rates(
                r,
                x,
                reference[2 * n + ahead],
                gains,
                limits,
                friction,
                arm_torque,
                wrist_lever,
                rate[stage],
                spare_demand,
                spare_limit,
            )
        for i in range(9):
            mean = (rate[0, i] + 2.0 * rate[1, i] + 2.0 * rate[2, i] + rate[3, i]) / 6.0
            state[n + 1, i] = state[n, i] + step * mean


@compiled
def _linearise(
    robot: np.ndarray[Any, Any],
    pose: Array,
    hold: Array,
    gains: Array,
    limits: Array,
    friction: Array,
    arm_torque: bool,
    wrist_lever: bool,
    matrix: Array,
) -> None:
    """Fill d rate/d x (9, 9) at rest at `pose`, where `hold` (3,) are the efforts that hold it there."""
    r = robot[0]
    x, above, below = np.zeros(9), np.empty(9), np.empty(9)
    reference, demand, limit = np.empty(3), np.empty(3), np.empty(3)
    x[:3] = pose
    lever = kane_terms(r, x[0], x[1], x[2], 0.0, 0.0, 0.0)[9]
    for i in range(3):
        output = hold[i] * lever if i == 1 and arm_torque else hold[i]
        reference[i] = pose[i] + output / gains[0, i]
    small = 1e-5
    for j in range(9):
        x[j] += small
        _rates(r, x, reference, gains, limits, friction, arm_torque, wrist_lever, above, demand, limit)
        x[j] -= 2.0 * small
        _rates(r, x, reference, gains, limits, friction, arm_torque, wrist_lever, below, demand, limit)
        x[j] += small
        for i in range(9):
            matrix[i, j] = (above[i] - below[i]) / (2.0 * small)
