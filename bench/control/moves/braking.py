"""The valve commands of BRAKE, PASSIVE and BLIND_BRAKE, and when a stop is over."""

from __future__ import annotations

from math import acos, pi
from typing import Any

import numpy as np

from bench.control.estimate.air import conductance_of_vents
from bench.control.moves.first_motion import centre_unanswered
from bench.control.states import enter_standstill, is_slow_now
from drivers.base.compiled import compiled
from sim.plant import PlantParameters

RIGHT_ARM = 1
"""Index of the right arm's joint in drivers.base.JOINTS."""

_ABOVE = 0.005
"""Clearance over the turf of a club that is thrown back (m)."""


def lifted_angle(plant: PlantParameters) -> float:
    """Return the angle of the right arm's joint, rad, at which a straight club passes above the ground."""
    robot, site = plant.robot, plant.site
    reach, below = -(site.ground + site.sole_depth) - _ABOVE, robot.l23 + robot.club.length_to_face
    cosine = (reach**2 - robot.l12**2 - below**2) / (2 * robot.l12 * below)
    return 2 * pi - acos(min(max(cosine, -1.0), 1.0))


@compiled
def brake_opening(gain: float, damping: float, fade: float, velocity: float, acceleration: float) -> float:
    """Return the valve command that brakes a joint: air against the motion, eased off as it slows down.

    The same law brakes the planned follow-through, with or without a ball, and every stop.
    """
    # Eased off towards rest, where the air's spring would make a stiff law swing for ever.
    share = min(abs(velocity) / fade, 1.0)
    return -share * (gain * velocity + damping * acceleration)


@compiled
def brake_openings(s: Any, p: Any, e: Any) -> None:
    """Set the desired valve commands (3,) of the braking law."""
    for i in range(3):
        s.desired[i] = brake_opening(
            p.brake_gain[i], p.brake_damping[i], p.brake_fade_speed[i], e.velocity[i], e.acceleration[i]
        )


@compiled
def lift(s: Any, p: Any, e: Any) -> None:
    """Pull the right arm in as far as lets a straight club pass above the turf, on top of the braking law.

    The air that brakes a follow-through is a spring: should the bench fall silent, it throws the club back
    along the arc of arms and club stretched out, which on turf lies below the ground.
    """
    if p.lift_gain > 0.0:
        s.desired[RIGHT_ARM] -= p.lift_gain * max(e.angle[RIGHT_ARM] - p.lift_angle, 0.0)


@compiled
def _rest_or_wait(s: Any, parameters: Any, e: Any, trusted: bool, time: float) -> None:
    """End a stop once all joints have rested for long enough, or its time is up."""
    p = parameters.control[0]
    if not (trusted and is_slow_now(p, e)):
        s.still_since = time
    if time - s.still_since >= p.rest_time or time - s.reaction_start >= p.brake_timeout:
        enter_standstill(s, parameters, time)


@compiled
def brake(state: Any, parameters: Any, readings: Any, trusted: bool, time: float) -> None:
    """Set the desired valve commands of BRAKE: air against the motion, until all joints rest.

    Behind an open safety relay it ends when the vents open: spools would drop arms into an empty manifold.
    Where both vents report shut, as on a machine without that relay, it continues.
    """
    s, e = state.control[0], state.estimator[0]
    brake_openings(s, parameters.control[0], e)
    centre_unanswered(s)
    for i in range(3):
        s.reference[i], s.reference_velocity[i], s.feed_forward[i] = e.angle[i], 0.0, 0.0
    if conductance_of_vents(parameters.plant[0], readings[0], s.venting.timer) > 0.0:
        enter_standstill(s, parameters, time)
    else:
        _rest_or_wait(s, parameters, e, trusted, time)


@compiled
def wait_passive(state: Any, parameters: Any, trusted: bool, time: float) -> None:
    """Wait in PASSIVE until all joints rest: spools centred, supply shut, vents opening by their timer."""
    s, e = state.control[0], state.estimator[0]
    for i in range(3):
        s.desired[i] = s.feed_forward[i] = s.reference_velocity[i] = 0.0
        s.reference[i] = e.angle[i]
    _rest_or_wait(s, parameters, e, trusted, time)


@compiled
def _note_unseen(s: Any, encoder_timeout: float, e: Any) -> None:
    """Note the joints whose encoder gives nothing to brake by; one that comes back stays doubtful."""
    for i in range(3):
        seen = e.without_sample[i] < encoder_timeout and np.isfinite(e.velocity[i] + e.acceleration[i])
        if not seen:
            s.open_loop_joints[i] = 1


@compiled
def brake_blind(state: Any, parameters: Any, time: float) -> None:
    """Set BLIND_BRAKE's valve commands: the profile's pattern by time, or BRAKE's where an encoder works."""
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    since = time - s.reaction_start
    longest = 0.0
    _note_unseen(s, parameters.envelope[0].encoder_timeout, e)
    for i in range(3):
        s.desired[i] = s.feed_forward[i] = 0.0
        if s.open_loop_joints[i] == 0:
            s.reference[i], s.reference_velocity[i] = e.angle[i], 0.0
            s.desired[i] = brake_opening(
                p.brake_gain[i], p.brake_damping[i], p.brake_fade_speed[i], e.velocity[i], e.acceleration[i]
            )
            if not abs(e.velocity[i]) <= p.rest_speed[i]:
                s.still_since = time
        elif s.blind_row >= 0:
            duration = parameters.blind_brake[s.blind_row, 3 + i]
            longest = max(longest, duration)
            if since < duration:
                s.desired[i] = parameters.blind_brake[s.blind_row, i]
    centre_unanswered(s)
    rests = time - s.still_since >= p.rest_time or since >= p.brake_timeout
    if since >= longest + p.open_loop_settling_time and rests:
        enter_standstill(s, parameters, time)
