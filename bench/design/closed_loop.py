"""Puts a downswing into a profile so that the closed loop on the nominal plant does exactly that downswing.

Openings found in the open loop are played on the plant while the whole control step listens. The estimates
become the profile's reference, so that position and speed errors are zero, and the feed-forward is the
opening less the output of integral and damping. On the nominal plant the feedback then has nothing to
correct, whatever its gains; its whole share of the valves is left for deviations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.control.law.gain_table import DAMPING, DERIVATIVE, gains_along
from bench.simulation.simulated_bench import PoweredBench, SimulatedBench
from bench.swing.profile import Profile

Array = NDArray[np.float64]

_AWAY = 0.4
"""Max difference of the reference's speed from its slope, rad/s; feed-forward compensates the rest."""


class LoopFailed(RuntimeError):
    """The swing does not run in closed loop."""


class Rehearsal:
    """A profile under closed loop on the nominal plant, just as `simulate_swing` does it, tick by tick."""

    def __init__(self, bench: SimulatedBench, *, ball: bool = True) -> None:
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
        """Apply openings `valve` (n, 3) while the loop listens; return records and estimated acceleration."""
        cycles, acceleration = self.bench.play(valve)
        self._require_running()
        return cycles, acceleration

    def _require_running(self) -> None:
        cause = Cause(int(self.bench.state.control["cause"][0]))
        if cause:
            raise LoopFailed(f"the rehearsal stopped: {CAUSE_TEXT[cause]}")


def imprint(bench: SimulatedBench, opening: Array) -> Profile:
    """Return the bench's profile with references and feed-forward that make the loop apply `opening` (n, 3).

    `opening` begins where the phase DOWNSWING does and ends where FOLLOW_THROUGH begins.

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
    opening can take back.
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


def with_follow_through(bench: SimulatedBench) -> tuple[Profile, NDArray[Any]]:
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
