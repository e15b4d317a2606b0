"""Downswing on the plant itself: trials of valve commands, their refinement, the backswing's feed-forward.

A trial applies valve commands until after the ball, on the plant with pneumatics, end stops, valves, friction
and impact. No second model of the robot is needed. It gives the arrival of the head at the ball and the
absorber loads: ball struck, ball missed, and loss of communication before the ball.

Refinement of a planned downswing: least squares on the arrival at the ball. The collocation's model rounds
off friction, edges and stops. Played on the plant, its valve commands bring the head to the ball a little
early and low. Here a smooth correction of them, small by least squares, is found with which the plant passes
the ball as planned: strike point, shaft, velocity and turning, which together are the three joints' speeds.
The same input gives the same valve commands; a trial takes milliseconds.

Feed-forward of the backswing: iterative learning control in simulated iterations. The tracking error, mapped
through the inverse of the loop, corrects the valve commands of the next iteration. On the linear model of
`bench.control.law.gain_scheduling` an added command u changes the error e of its joint, the others held, by:

    e''' / b + (m + c / b) e'' + (d + k) e' + p e = -u

m is the PIDs' damping gain. p and d are their proportional and derivative gains. b, k and c are authority,
slowness and friction of the joint. Errors are smoothed over some periods of the dither, which moves the
joints to and fro and is not to be undone.

The closed loop: valve commands found in the open loop are played on the plant while the whole control step
listens. The estimates become the profile's reference, so that position and speed errors are zero. The
feed-forward is the valve command less the output of integral and damping. On the nominal plant the feedback
then has nothing to correct, whatever its gains; its whole range of valve commands is left for deviations.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.control.law.gain_scheduling import joint_chains
from bench.control.law.gain_table import DAMPING, DERIVATIVE, PROPORTIONAL, gains_along
from bench.control.moves.braking import brake_opening
from bench.control.settings import ControlSettings
from bench.simulation.safety import reset_peaks
from bench.simulation.simulated_bench import Bench, PoweredBench
from bench.swing.profile import Profile
from drivers.base import PASSIVE
from drivers.base.compiled import compiled, compiled_with_arrays, new_record
from drivers.base.records import pack_command
from sim.impact import in_plane_error
from sim.plant import PLANT_STATE, Plant, advance, build_plant

_AWAY = 0.4
"""Max difference of the reference's speed from its slope, rad/s; feed-forward compensates the rest."""


class LoopFailed(RuntimeError):
    """The swing does not run in closed loop."""


class Rehearsal:
    """A profile under closed loop on the nominal plant, just as `simulate_swing` does it, tick by tick."""

    def __init__(self, bench: Bench, *, ball: bool = True) -> None:
        """Arm the vented bench, hold, and begin the swing with the bench's profile.

        Raises:
            LoopFailed: the robot does not come to rest at address.
        """
        # References past the ball are still being found: do not check following errors.
        free = replace(bench, envelope=replace(bench.envelope, max_following_error={}))
        powered = PoweredBench(free)
        engine = powered.engine
        try:
            powered.arm()
            if not powered.begin(bench.plant.ball if ball else None):
                cause = CAUSE_TEXT[engine.cause] if engine.cause else "the robot does not come to rest"
                raise engine.refusal(cause)
        except Refused as refused:
            raise LoopFailed(f"{refused.location}: {refused.found}") from None
        self.bench, self._first = engine.stepper, engine.latest

    def advance(self, ticks: int) -> NDArray[Any]:
        """Return the CYCLE records of the next `ticks` ticks of the swing, its first one included.

        Raises:
            LoopFailed: the envelope stopped the swing.
        """
        first, self._first = self._first[:ticks], self._first[ticks:]
        cycles = self.bench.advance(ticks - len(first))
        self._require_running()
        return np.concatenate([first, cycles]) if len(first) else cycles

    def play(self, valve: Array) -> tuple[NDArray[Any], Array]:
        """Apply valve commands `valve` (n, 3), the loop listening; return records, estimated acceleration."""
        cycles, acceleration = self.bench.play(valve)
        self._require_running()
        return cycles, acceleration

    def _require_running(self) -> None:
        cause = Cause(int(self.bench.state.control["cause"][0]))
        if cause:
            raise LoopFailed(f"the rehearsal stopped: {CAUSE_TEXT[cause]}")


def imprint(bench: Bench, opening: Array) -> Profile:
    """Return the bench's profile with references and feed-forward that make the loop apply `opening` (n, 3).

    The valve commands `opening` begin where the phase DOWNSWING does and end where FOLLOW_THROUGH begins.

    Raises:
        LoopFailed: the swing does not run.
    """
    profile, control = bench.profile, bench.control
    top = profile.begins[3]
    rehearsal = Rehearsal(bench)
    rehearsal.advance(top)
    integral = rehearsal.bench.state.pid["integral"][0].copy()
    cycles, acceleration = rehearsal.play(opening)
    rows = slice(top, top + len(opening))
    angle, velocity, valve = profile.angle.copy(), profile.velocity.copy(), profile.valve.copy()
    angle[rows] = cycles["angle"]
    # From the window on the loop does not damp: the jump at impact is not a motion.
    window = profile.begins[5] - top
    state = rehearsal.bench.state.pid[0]
    gains = gains_along(rehearsal.bench.parameters.pid, cycles["angle"], float(state["supply_factor"]) or 1.0)
    damped = control.downswing_damping * gains[:, DAMPING]
    stiff = control.downswing_gain_factor * gains[:, DERIVATIVE]
    away = _silent_velocity(cycles["velocity"], acceleration, window, profile.period, stiff, damped)
    velocity[rows] = cycles["velocity"] + away
    derivative = stiff * away
    following = np.vstack([velocity[top + 1 : top + len(opening)], velocity[top + len(opening) - 1]])
    damping = damped * ((following - velocity[rows]) / profile.period - acceleration)
    damping[window:] = 0.0
    from_centre = opening - bench.plant.valve_centres
    valve[rows] = np.clip(from_centre - integral - derivative - damping, -1.0, 1.0)
    return replace(profile, angle=angle, velocity=velocity, valve=valve)


def _silent_velocity(
    velocity: Array, acceleration: Array, window: int, period: float, derivative: Array, damping: Array
) -> Array:
    """Return the offset on the estimated `velocity` (n, 3) with which derivative and damping cancel out.

    `derivative` and `damping` (n, 3) are the gains along the downswing.

    The first row's reference is at rest, as at the top: the previous tick looks ahead to it, and a velocity
    there would begin the downswing with a jump. The estimated acceleration lags; damping against the
    reference's would otherwise open the valves by a good part of the stroke, more than a feed-forward at full
    valve command can take back.
    """
    away = np.zeros_like(velocity)
    away[0] = -velocity[0]
    rate = np.divide(derivative, damping, out=np.zeros_like(damping), where=damping > 0)
    for k in range(min(window, len(velocity) - 1)):
        lag = (velocity[k + 1] - velocity[k]) / period - acceleration[k]
        shifted = away[k] - period * (rate[k] * away[k] + lag) * (damping[k] > 0)
        away[k + 1] = np.clip(shifted, -_AWAY, _AWAY)
    for k in range(window, len(velocity) - 1):
        away[k + 1] = away[k]
    return away


def with_follow_through(bench: Bench) -> tuple[Profile, NDArray[Any]]:
    """Return the bench's profile with the braking law's follow-through, and the plant's last state.

    Raises:
        LoopFailed: the swing does not run, or misses the ball.
    """
    profile, rehearsal = bench.profile, Rehearsal(bench)
    cycles = rehearsal.advance(len(profile.angle))
    angle, velocity, valve = profile.angle.copy(), profile.velocity.copy(), profile.valve.copy()
    follow = profile.begins[-1]
    angle[follow:], velocity[follow:] = cycles["plant_angle"][follow:], cycles["plant_velocity"][follow:]
    valve[follow:] = np.clip(cycles["applied_valve"][follow:] - bench.plant.valve_centres, -1.0, 1.0)
    state = rehearsal.bench.plant_state
    if not state["struck"][0]:
        raise LoopFailed("under closed loop the head misses the ball")
    start = float(state["time"][0]) - len(profile.angle) * profile.period
    found = replace(
        profile,
        angle=angle,
        velocity=velocity,
        valve=valve,
        impact_time=float(state["impact_time"][0]) - start,
    )
    return found, state


Array = NDArray[np.float64]

SHAFT_DOWN = 3.5 * np.pi
"""theta_t of a shaft straight down, in the range the joints have there (rad)."""
AFTER_CONTACT = 5
"""Ticks for which the valve commands continue after impact before the braking law takes over."""
_FOLLOWED = 0.25
_SILENT_FOR = 0.12
"""Simulated time after loss of communication (s): by then the absorbers have taken their load."""
_BELOW = -0.9
"""Height of the head (m) below which passing the ball's place counts."""

BRAKE_LAW = np.dtype([("gain", "f8", (3,)), ("damping", "f8", (3,)), ("fade", "f8", (3,))], align=True)
"""The braking law of the controller (`bench.control.moves.braking`)."""


class Arrival(NamedTuple):
    """The robot as the head passes the ball's place, with no ball there."""

    head: Array
    """x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s)."""
    error: float
    """Ball off the face's centre along the cut of swing plane and face, m."""


class ShootingTrial(NamedTuple):
    """Outcome of one trial."""

    contact: int
    """Tick in which the head passes the ball; the number of valve commands if it does not."""
    angle: Array
    """(contact, 3) rad at the start of each tick."""
    speed: Array
    """(contact, 3) rad/s."""
    struck_energy: Array
    """Energies (3, 2) in lower and upper absorbers (J)."""
    missed_energy: Array
    silent_energy: Array
    """(m, 3, 2) J."""


@compiled
def swing_down(robot: Any, plant: Any, impact: Any, states: Any, command: Any, valve: Any) -> int:
    """Play valve commands `valve` (n, 3) from `states[0]`; return the tick of the head at the ball, or n.

    `states` (n + 1,) gets the plant's state at the start of each tick.
    """
    for k in range(len(valve)):
        states[k + 1] = states[k]
        for i in range(3):
            command[0].valve[i] = valve[k, i]
        advance(robot, plant, impact, states[k + 1 : k + 2], command)
        before, after = states[k].head, states[k + 1].head
        if before[0] < plant[0].ball_x <= after[0] and after[1] < _BELOW:
            return k
    return len(valve)


@compiled
def follow_plan(
    robot: Any,
    plant: Any,
    impact: Any,
    state: Any,
    command: Any,
    valve: Any,
    angle: Any,
    speed: Any,
    gains: Any,
    highest: float,
) -> None:
    """Play valve commands `valve` (n, 3) with feedback on the joints of a plan, `angle` and `speed` (n, 3).

    `gains` (n, 5, 3) are those along it. `valve` is overwritten with the commands played, at most `highest`.
    """
    s = state[0]
    for k in range(len(valve)):
        for i in range(3):
            opening = valve[k, i] + gains[k, PROPORTIONAL, i] * (angle[k, i] - s.angle[i])
            opening += gains[k, DERIVATIVE, i] * (speed[k, i] - s.speed[i])
            valve[k, i] = min(max(opening, -highest), highest)
            command[0].valve[i] = valve[k, i]
        advance(robot, plant, impact, state, command)


@compiled_with_arrays
def brake(
    robot: Any, plant: Any, impact: Any, state: Any, command: Any, valve: Any, law: Any, ticks: int
) -> None:
    """Play valve commands `valve` (m, 3), then the braking `law` (BRAKE_LAW) for `ticks` ticks."""
    s, b, period, before = state[0], law[0], plant[0].tick, np.zeros(3)
    for k in range(len(valve) + ticks):
        for i in range(3):
            if k < len(valve):
                command[0].valve[i] = valve[k, i]
            else:
                rate = (s.speed[i] - before[i]) / period
                opening = brake_opening(b.gain[i], b.damping[i], b.fade[i], s.speed[i], rate)
                command[0].valve[i] = min(max(opening, -1.0), 1.0)
            before[i] = s.speed[i]
        advance(robot, plant, impact, state, command)


@compiled
def hold_command(robot: Any, plant: Any, impact: Any, state: Any, command: Any, ticks: int) -> None:
    """Let the plant run for `ticks` ticks with `command` as it is."""
    for _ in range(ticks):
        advance(robot, plant, impact, state, command)


class Shooter:
    """Plays downswings from one state of the plant; safe to use from several threads at once."""

    def __init__(
        self,
        plant: Plant,
        state: NDArray[Any],
        command: NDArray[Any],
        control: ControlSettings,
        silences: tuple[float, ...],
    ) -> None:
        """Start from `state` and `command` (one-element arrays); `silences` are s before the ball."""
        self.plant, self.command = plant, command.copy()
        self.state = without_history(state)
        self.silences = silences
        self.law = new_record(BRAKE_LAW)
        self.law["gain"], self.law["damping"] = control.brake_gain, control.brake_damping
        self.law["fade"] = control.brake_fade_speed
        self.passive = command.copy()
        pack_command(PASSIVE, self.passive)

    def _down(self, valve: Array) -> tuple[NDArray[Any], NDArray[Any], int]:
        states = new_record(PLANT_STATE, len(valve) + 1)
        states[0] = self.state[0]
        states["ball_present"] = False
        command = self.command.copy()
        return states, command, int(swing_down(*self.plant.records, states, command, valve))

    def follow(self, valve: Array, angle: Array, speed: Array, gains: Array, highest: float) -> Array:
        """Return valve commands (n, 3), at most `highest`, with which the plant keeps near a plan.

        `valve`, `angle`, `speed` (n, 3) are the plan's, one row a tick, `gains` (n, 5, 3) along it.
        """
        state, played = self.state.copy(), valve.copy()
        state["ball_present"] = False
        follow_plan(*self.plant.records, state, self.command.copy(), played, angle, speed, gains, highest)
        return played

    def arrive(self, valve: Array) -> Arrival:
        """Play valve commands `valve` (n, 3), one row per tick, to the ball's position."""
        states, command, contact = self._down(valve)
        last = min(contact, len(valve) - 1)
        # The plant itself finds where the face meets the ball; where the head misses it, `_passing` does.
        hit = states[last : last + 1].copy()
        hit["ball_present"] = contact < len(valve)
        hold_command(*self.plant.records, hit, command, 2)
        struck = bool(hit["struck"][0])
        before, after = states[last], states[last + 1]
        head = np.array(hit["impact_head"][0]) if struck else _passing(before, after, self.plant)
        site = self.plant.parameters.site
        error = in_plane_error(head[0], head[1], head[2], site.ball_x, site.ball_y, self.plant.impact)
        return Arrival(head, float(error))

    def shoot(self, valve: Array) -> ShootingTrial:
        """Apply the commands `valve` (n, 3); continue with each: struck, missed, communication lost."""
        records, period = self.plant.records, self.plant.parameters.tick
        states, command, contact = self._down(valve)
        followed, quiet = round(_FOLLOWED / period), round(_SILENT_FOR / period)
        last = min(contact, len(valve) - 1)
        rest = np.ascontiguousarray(valve[last : last + AFTER_CONTACT])

        hit = states[last : last + 1].copy()
        hit["ball_present"] = contact < len(valve)
        brake(*records, hit, command.copy(), rest, self.law, followed)
        missed = states[last : last + 1].copy()
        brake(*records, missed, command.copy(), rest, self.law, followed)
        silent = np.zeros((len(self.silences), 3, 2))
        for row, silence in enumerate(self.silences):
            begin = max(last - round(silence / period), 0)
            left = states[begin : begin + 1].copy()
            hold_command(*records, left, self.passive.copy(), quiet)
            silent[row] = left["stop_energy"][0]

        return ShootingTrial(
            contact,
            np.array(states["angle"][: last + 1]),
            np.array(states["speed"][: last + 1]),
            np.array(hit["stop_energy"][0]),
            np.array(missed["stop_energy"][0]),
            silent,
        )


def without_history(state: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of `state` without earlier loads and impact."""
    fresh = state.copy()
    reset_peaks(fresh)
    fresh["struck"] = False
    return fresh


def _passing(before: Any, after: Any, plant: Plant) -> Array:
    """Return the head as it passes the ball's place between two ticks: cubic path, straight lines else."""
    one, two = np.array(before["head"]), np.array(after["head"])
    span = two[0] - one[0]
    part = float(np.clip((plant.parameters.site.ball_x - one[0]) / span, 0.0, 1.0)) if span else 0.0
    period = plant.parameters.tick
    head = one + part * (two - one)
    chord = (two[:2] - one[:2]) / period
    head[:2] += period * part * (1 - part) * ((1 - part) * (one[3:5] - chord) - part * (two[3:5] - chord))
    return np.asarray(head)


KNOT = 0.02
"""Time between knots of the correction, s."""
_DIFFERENCE = 1e-4
_THREADS = 2
UNITS = np.array([1e-4, 5e-4, 0.01, 0.01, 0.3])
"""Errors of strike (m), shaft (rad), head velocity (m/s) and turning (rad/s) that count as one."""
_MET = 4
"""Number of errors that must be below one: shaft rotation is not required, absorbers are checked later."""
NEAR = 10.0
"""Remaining error that is still accepted: the closed loop corrects the aim later."""
_STAY = 0.3
"""Weight of the correction's size (fraction of the stroke) relative to those errors."""
_PASSES = 3
"""Number of passes; each starts from the previous one's valve commands and may go as far again."""
_ROUNDS = 30
"""Max number of rounds of a pass."""


class NotReached(RuntimeError):
    """The plant does not arrive at the ball as planned."""


def correction(knots: Array, ticks: int, period: float) -> Array:
    """Return the correction (ticks, 3) of straight lines from zero through `knots` (m, 3)."""
    corners = np.vstack([np.zeros(3), knots])
    at, times = np.arange(ticks) * period, np.arange(len(corners)) * KNOT
    return np.column_stack([np.interp(at, times, corners[:, i]) for i in range(3)])


def arrival_errors(arrival: Arrival, wanted: Array) -> Array:
    """Return the difference of `arrival` from `wanted`: strike m, theta_t rad, vx, vy m/s, omega rad/s."""
    return np.asarray(np.concatenate([[arrival.error], arrival.head[2:6]]) - wanted)


def refine(shooter: Shooter, plan: Array, wanted: Array, opening: float) -> Array:
    """Return valve commands (n, 3), one row per tick, that make the plant arrive as `wanted`.

    `plan` (n, 3) are the planned valve commands, `opening` the max one; `wanted` is as in `arrival_errors`.

    Raises:
        NotReached: no such valve commands near the plan.
    """
    left = np.full(len(wanted), np.inf)
    for _ in range(_PASSES):
        plan, left = _corrected(shooter, plan, wanted, opening)
        if np.abs(left[:_MET]).max() < 1.0:
            return plan
    if np.abs(left[:_MET]).max() < NEAR:
        return plan
    raise NotReached(
        f"the plant stays {np.array2string(left, precision=1)} tolerances off the planned arrival"
        " (strike, shaft, velocity in x and y, turning)"
    )


def _corrected(shooter: Shooter, plan: Array, wanted: Array, opening: float) -> tuple[Array, Array]:
    """Return valve commands, by least squares around `plan`, and the remaining errors in UNITS."""
    period, ticks = shooter.plant.parameters.tick, len(plan)
    shape = (int(np.ceil(ticks * period / KNOT)), 3)

    def openings(point: Array) -> Array:
        return np.clip(plan + correction(point.reshape(shape), ticks, period), -opening, opening)

    def errors(point: Array) -> Array:
        return np.asarray(arrival_errors(shooter.arrive(openings(point)), wanted) / UNITS)

    def residuals(point: Array) -> Array:
        return np.concatenate([errors(point), _STAY * point])

    with ThreadPoolExecutor(_THREADS) as pool:

        def slopes(point: Array) -> Array:
            def column(i: int) -> Array:
                shift = np.zeros(len(point))
                shift[i] = _DIFFERENCE
                return (residuals(point + shift) - residuals(point - shift)) / (2 * _DIFFERENCE)

            return np.stack(list(pool.map(column, range(len(point)))), axis=1)

        def note(intermediate_result: Any) -> None:
            if np.abs(intermediate_result.fun[:_MET]).max() < 1.0:
                raise StopIteration

        found = least_squares(
            residuals,
            np.zeros(shape[0] * 3),
            jac=slopes,
            bounds=(-0.5, 0.5),
            max_nfev=_ROUNDS,
            callback=note,
            xtol=1e-8,
            ftol=1e-6,
            x_scale=0.05,
        )
    return openings(found.x), errors(found.x)


_REHEARSALS = 12
_SHARE = 0.4
"""Fraction of the inverse that is applied: with friction the error does not follow its linear model."""
_NEAR = 0.03
"""Max error that is not worth another rehearsal, as a fraction of its limit."""
_SMOOTHED = 4
"""Periods of the dither over which an error is smoothed."""
_APART = 50
"""Rows between two poses at which the linear model is made."""


class Backswing(NamedTuple):
    """A rehearsed way to the top."""

    profile: Profile
    """Profile with the learned valve commands."""
    rehearsal: Rehearsal
    """The bench at the top."""
    cycles: NDArray[Any]
    """CYCLE records of the way."""
    error: float
    """Max error in following it, as a fraction of its limit."""


def learned_backswing(bench: Bench, pid: NDArray[Any], ticks: int, highest: float) -> Backswing:
    """Return the way up in the first `ticks` of the bench's profile, as closely followed as is learned.

    `pid` is the PIDs' record, `highest` the max planned valve command.

    Raises:
        LoopFailed: the envelope stops the first rehearsal, or the robot does not come to its address.
    """
    terms = _terms(bench, pid, bench.profile.angle[:ticks])
    best = latest = _rehearsed(bench, ticks)
    for _ in range(_REHEARSALS - 1):
        if best.error < _NEAR:
            break
        opening = latest.profile.valve.copy()
        opening[1:ticks] += _SHARE * _missing(bench, terms, latest.cycles)[1:]
        np.clip(opening, -highest, highest, out=opening)
        bench = replace(bench, profile=replace(bench.profile, valve=opening))
        try:
            latest = _rehearsed(bench, ticks)
        except LoopFailed:
            break
        if latest.error < best.error:
            best = latest
    return best


def _rehearsed(bench: Bench, ticks: int) -> Backswing:
    # A wrist that lags folds beyond the lever's limit: the learned swing is to keep it, not each rehearsal.
    free = replace(bench, envelope=replace(bench.envelope, min_lever=0.0))
    rehearsal = Rehearsal(free)
    cycles = rehearsal.advance(ticks)
    error = (
        np.abs(cycles["reference_angle"] - cycles["angle"]) / bench.envelope.max_following_error["backswing"]
    )
    return Backswing(bench.profile, rehearsal, cycles, float(error.max()))


def _terms(bench: Bench, pid: NDArray[Any], angle: Array) -> Array:
    """Return valve commands (4, n, 3) per rad, rad/s, rad/s2, rad/s3 of error, along `angle` (n, 3) rad."""
    plant, gains = build_plant(bench.plant), gains_along(pid, angle)
    at = np.arange(len(angle))
    rows = np.append(at[::_APART], at[-1])
    poses = [joint_chains(plant, angle[row]) for row in rows]

    def along(values: list[Array]) -> Array:
        return np.column_stack([np.interp(at, rows, joint) for joint in np.array(values).T])

    return np.array(
        [
            gains[:, PROPORTIONAL],
            gains[:, DERIVATIVE] + along([pose.slowness for pose in poses]),
            gains[:, DAMPING] + along([pose.friction / pose.authority for pose in poses]),
            along([1.0 / pose.authority for pose in poses]),
        ]
    )


def _missing(bench: Bench, terms: Array, cycles: NDArray[Any]) -> Array:
    """Return the valve commands (n, 3) that would have undone the errors in `cycles`."""
    from scipy.signal import savgol_filter  # here, for it takes long to import

    period = bench.profile.period
    window = 2 * round(_SMOOTHED * bench.control.dither_period / period / 2) + 1
    error = cycles["reference_angle"] - cycles["angle"]
    missing: Array = np.zeros(error.shape)
    for order, term in enumerate(terms):
        missing += term * savgol_filter(error, window, 3, deriv=order, delta=period, axis=0, mode="nearest")
    return missing
