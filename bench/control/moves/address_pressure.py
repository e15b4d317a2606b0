"""The air at the address: brought to the pressures that the profile plans, before a swing may begin.

With its spool centred a chamber keeps what came into it, and dry friction holds the joint wherever its air
leaves it: neither sum nor difference of an actuator's pressures follows from its pose. A closed-centre spool
moves air in both chambers, with two handles:

sum         swung around its centre, the spool lets as much air into each chamber as out of it, and both go to
            where inflow and outflow are equal: about three quarters of the supply. The longer it is swung,
            the less is left of what was there. That is why the planned pressures lie on this balance
            (`bench.control.moves.pressure_plan`); leakage past the centred spool leads nearly there, too.
difference  an offset of the swing fills one chamber and empties the other.

A joint is first brought into its band around the address by its PID, the spool swung, so that neither dead
band nor friction keeps it away. From then on its valve serves the air: friction holds the joint as long as
the planned force is near its load. Once both chambers are as planned the spool rests at its centre. On a
robot whose air leaks away faster than all three come to rest together, the spools go on swinging instead.
Where dry friction is large beside the pneumatic stiffness a joint sticks beside its address, breaks away and
slips past it: after some time of that its force is brought beyond its friction, and it is caught as it slips.
A move that ends in that is taken over by the hold.

The pressures are those of `bench.control.estimate.air`: sensors, or the observer where none are fitted.
Planned pressures are in proportion to the supply.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from bench.control.estimate.air import actuator_force, actuator_motion, load_force
from bench.control.law.feed_forward import force_rates
from bench.control.moves.references import square_wave
from drivers.base.compiled import compiled

_BAND = 2.0
"""Times the band around the address that a joint may leave it while its valve serves the air."""
_STOPPING = 0.04
"""s in which friction stops a joint that is let go: a slipping one is caught before it is at the address."""
_LOOSENING = 2.0
"""Times the dry friction that a force beyond the load comes to until a joint breaks away; static is less."""
_SLIPS = 2.0
"""Multiple of `rest_speed` above which a joint slips; less may be a single count of its encoder."""
_CAUGHT = 8.0
"""Times `rest_speed` at which a joint may be caught."""
_FIRM = 0.5
"""Share of the dry friction by which a stuck joint's force may be off: beyond friction it slides."""
_NEARER = 0.5
"""Share of the tolerance within which a swung spool comes to rest."""
_RATE = 6.0
"""Rate at which a missing difference is made up for, 1/s."""
_CHARGING_RATE = 30.0
"""The same while charging, 1/s."""
_TRIM_RATE = 1.0
"""Rate at which the offset that keeps the difference, or loosens a late joint, is learned, 1/s."""
_MAX_TRIM = 0.1
"""Opening; a spool farther off its centre is out of order."""
_MISSED = 1.5
"""s after a move's end without all joints at the address: one sticks beside it and slips past it."""
_REACH = 0.5
"""Share of the hold's following limit within which such a joint is left to the hold."""
_SETTLING = 0.1
"""s for which pressures must be as planned with all spools at rest."""
_TIMEOUT = 6.0
"""s without all pressures as planned at rest, after which a joint counts as late."""
_PASSED = 0.5
"""s after which a joint that slips through its band is caught there: its PID's integral would drive it past
again and again, as far as the ball."""
HELD, LATE, SLIPPED = 1, 2, 4
"""Bits of `held`. Friction holds a joint. A late one is pushed free and caught, its chambers may leak.
One that slipped past its address is only caught."""
_LEAKING = 1.5
"""Times the tolerance within which the pressures of late joints are as planned: spools hold them."""
_OFFSET = 0.8
"""Share of the swing to either side that an offset may take: the rest goes on moving the sum."""


@compiled
def leave_address_air(s: Any, time: float) -> None:
    """Forget what was brought about at the address; the next hold begins from what it finds."""
    for i in range(3):
        s.address_air.held[i] = s.address_air.swung[i] = 0
    s.address_air.ready, s.address_air.good, s.address_air.since = False, time, time


@compiled
def _has_missed(s: Any, time: float) -> bool:
    """Return whether a move ended so long ago that a joint must be passing its address again and again."""
    return bool(time - s.move.start - s.move.duration >= _MISSED)


@compiled
def take_over_unsettled_move(s: Any, parameters: Any, estimator: Any, time: float) -> bool:
    """Return whether the hold takes over a robot whose move ended beside its address; note its late joints.

    A PID alone lets a joint with much friction hunt there; the hold catches a late one as it slips.
    """
    p, following = parameters.control[0], parameters.envelope[0].max_following_error
    if not (parameters.profile[0].air_planned and _has_missed(s, time)):
        return False
    for i in range(3):
        away, speed = abs(parameters.angle[0, i] - estimator.angle[i]), abs(estimator.velocity[i])
        if not (away <= _REACH * following[Phase.HOLD, i] and speed <= 2.0 * p.rest_speed[i]):
            return False
    for i in range(3):
        if not abs(parameters.angle[0, i] - estimator.angle[i]) <= p.address_tolerance[i]:
            s.address_air.held[i] = LATE
    return True


@compiled
def planned_pressure(profile: Any, air: Any, chamber: int) -> float:
    """Return the planned pressure (Pa) of `chamber` (0 to 5) at the supply's present pressure."""
    pressure: float = profile.air[chamber] * air.pressure[12] / profile.air_supply
    return pressure


@compiled
def worst_chamber(profile: Any, air: Any) -> tuple[int, float]:
    """Return the chamber (0 to 5) whose pressure is farthest from the planned one, and by how much (Pa)."""
    worst, most = 0, 0.0
    for k in range(6):
        away = abs(air.pressure[6 + k] - planned_pressure(profile, air, k))
        if not away <= most:  # NaN, too
            worst, most = k, away
    return worst, most


@compiled
def _missing(profile: Any, air: Any, i: int) -> float:
    """Return the larger deviation (Pa) of the two chambers of actuator `i`."""
    a = abs(air.pressure[6 + 2 * i] - planned_pressure(profile, air, 2 * i))
    b = abs(air.pressure[7 + 2 * i] - planned_pressure(profile, air, 2 * i + 1))
    return float(max(a, b))


@compiled
def _planned_force(plant: Any, profile: Any, air: Any, i: int) -> float:
    """Return the force (N, shoulder N m) of actuator `i` at the planned pressures."""
    in_a = planned_pressure(profile, air, 2 * i) - plant.atmosphere
    in_b = planned_pressure(profile, air, 2 * i + 1) - plant.atmosphere
    force: float = in_a * plant.area_a[i] - in_b * plant.area_b[i]
    return force


@compiled
def _bounded(parameters: Any, i: int, offset: float) -> float:
    """Return the `offset` of spool `i` that leaves enough of its swing to go on moving the sum."""
    most = _OFFSET * (parameters.profile[0].dither_amplitude[i] - parameters.plant[0].dead_band[i])
    return float(min(max(offset, -most), most))


@compiled
def _offset_for(state: Any, parameters: Any, i: int, missing: float, rate: float) -> float:
    """Return the offset of a spool that swings that makes up for a `missing` force (N, N m) at `rate` 1/s."""
    e, air, plant = state.estimator[0], state.air[0], parameters.plant[0]
    position, _ = actuator_motion(parameters.robot, plant, e.angle, e.velocity, i)
    _, up, down = force_rates(plant, i, air.pressure, position, 0.0)
    slope = 0.5 * (up - down)
    offset = rate * missing / slope if slope > 0.0 else 0.0
    return float(offset) if np.isfinite(offset) else 0.0


@compiled
def _balancing(state: Any, parameters: Any, i: int) -> float:
    """Return the offset with which a swung spool leaves the force where it is, by the model.

    One side lets in more than the other lets out, and chambers leak.
    """
    e, air, plant = state.estimator[0], state.air[0], parameters.plant[0]
    position, _ = actuator_motion(parameters.robot, plant, e.angle, e.velocity, i)
    still, up, down = force_rates(plant, i, air.pressure, position, 0.0)
    drift = still + parameters.profile[0].dither_duty[i] * (up + down)
    offset = -2.0 * (1.0 - plant.dead_band[i]) * drift / (up - down) if up > down else 0.0
    return float(offset) if np.isfinite(offset) else 0.0


@compiled
def _push(state: Any, parameters: Any, i: int) -> float:
    """Return what the force (N, N m) of actuator `i` misses to loosen its joint, at rest beside the address.

    Not against a PID that pushes more: it knows what the model does not.
    """
    e, plant = state.estimator[0], parameters.plant[0]
    towards = parameters.angle[0] - e.angle
    _, way = actuator_motion(parameters.robot, plant, e.angle, towards, i)
    pushes = actuator_force(plant, state.air[0].pressure, i) - load_force(parameters.robot, plant, e.angle, i)
    enough = _LOOSENING * plant.coulomb[i]
    return float(max(enough - pushes, 0.0) if way > 0.0 else min(-enough - pushes, 0.0))


@compiled
def regulate_address_pressure(state: Any, parameters: Any, time: float) -> None:
    """Set the desired openings (3,) of the hold: the PID's to the address, then those for the air.

    `desired` holds the PID's openings.
    """
    s, p, e = state.control[0], parameters.control[0], state.estimator[0]
    air, profile, plant = state.air[0], parameters.profile[0], parameters.plant[0]
    settled = True
    for i in range(3):
        side = square_wave((time - s.address_air.since) / profile.dither_period[i])
        away, speed = parameters.angle[0, i] - e.angle[i], abs(e.velocity[i])
        slips = speed > _SLIPS * p.rest_speed[i]
        if time - s.address_air.since >= _TIMEOUT:
            s.address_air.held[i] |= LATE
        if time - s.address_air.since >= _PASSED and slips and abs(away) <= p.address_deadband[i]:
            s.address_air.held[i] |= SLIPPED
        late, held = s.address_air.held[i] & LATE != 0, s.address_air.held[i] & HELD != 0
        stopped = s.address_air.held[i] & (LATE | SLIPPED) != 0
        ahead = away - _STOPPING * e.velocity[i] if slips and stopped else away
        caught = (_CAUGHT if stopped else 1.0) * p.rest_speed[i]
        if not held and abs(ahead) <= p.address_deadband[i] and speed <= caught:
            held = True
        elif not min(abs(away), abs(ahead)) <= min(_BAND * p.address_deadband[i], p.address_tolerance[i]):
            held = False
        s.address_air.held[i] = (s.address_air.held[i] & (LATE | SLIPPED)) | (HELD if held else 0)
        missing = _missing(profile, air, i)
        force = _planned_force(plant, profile, air, i) - actuator_force(plant, air.pressure, i)
        firm = _FIRM * plant.coulomb[i] if late else np.inf
        if not (missing <= p.pressure_tolerance and abs(force) <= firm and held):
            s.address_air.swung[i] = 1
        elif missing <= _NEARER * p.pressure_tolerance and abs(force) <= _NEARER * firm:
            s.address_air.swung[i] = 0
        enough = _LEAKING * p.pressure_tolerance if late else 0.0
        settled = settled and held and (s.address_air.swung[i] == 0 or missing <= enough)
        rate = _CHARGING_RATE if slips and stopped else _RATE
        if held:
            # The swing begins as if nothing had been before it.
            state.pid[0].integral[i], s.desired[i] = 0.0, s.address_air.trim[i]
        elif slips and stopped:
            state.pid[0].integral[i], force = 0.0, 0.0
            s.desired[i] += s.address_air.trim[i]
        elif late:
            force = _push(state, parameters, i)
            s.desired[i] += s.address_air.trim[i]
        else:
            force = 0.0
        if s.address_air.swung[i] != 0:
            offset = _bounded(parameters, i, _offset_for(state, parameters, i, force, rate))
            if held or (late and not slips):
                trim = s.address_air.trim[i] + _TRIM_RATE * s.measured_step * offset
                s.address_air.trim[i] = min(max(trim, -_MAX_TRIM), _MAX_TRIM)
            if late or not held:  # a PID as soft as its air cannot make up for what the swing does
                offset = _bounded(parameters, i, offset + _balancing(state, parameters, i))
            s.desired[i] += side * profile.dither_amplitude[i] + offset
    if not settled:
        s.address_air.good = time
    s.address_air.ready = time - s.address_air.good >= _SETTLING
    if s.address_air.ready:
        s.address_air.since = time


@compiled
def precharge(state: Any, parameters: Any, time: float) -> None:
    """Add the openings (3,) that charge the chambers, and bring the joints' forces to their loads meanwhile.

    The chambers of an actuator are unequal: filled alike, the smaller one would push the joint away until the
    other has as much. And a vented robot rests by friction alone: near the ground it would slide onto it.
    """
    s, air, plant, profile = state.control[0], state.air[0], parameters.plant[0], parameters.profile[0]
    for i in range(3):
        side = square_wave((time - s.move.start) / profile.dither_period[i])
        s.address_air.trim[i] = 0.0
        if time >= s.air_from:
            load = load_force(parameters.robot, plant, state.estimator[0].angle, i)
            missing = load - actuator_force(plant, air.pressure, i)
            offset = _offset_for(state, parameters, i, missing, _CHARGING_RATE)
            s.desired[i] += side * profile.dither_amplitude[i] + _bounded(parameters, i, offset)


@compiled
def dither_move(state: Any, parameters: Any, time: float) -> None:
    """Swing the spools of a slow move, so that dead band and friction hold no joint behind the others.

    Near the ground all of them together lift the head; and on the way the chambers come near to the plan. A
    joint that slips past the address where the move ended forgets the integral that it slipped with: it would
    be as far beyond, and hunt there for ever. From then on what the swing does to the forces by itself is
    made up for: a soft PID cannot.
    """
    s, p, e, profile = state.control[0], parameters.control[0], state.estimator[0], parameters.profile[0]
    missed = _has_missed(s, time)
    for i in range(3):
        if missed and abs(e.velocity[i]) > _SLIPS * p.rest_speed[i]:
            state.pid[0].integral[i] = 0.0
        side = square_wave((time - s.move.start) / profile.dither_period[i])
        s.desired[i] += side * profile.dither_amplitude[i]
        if missed:
            s.desired[i] += _bounded(parameters, i, _balancing(state, parameters, i))


@compiled
def address_air_cause(state: Any, parameters: Any, time: float) -> int:
    """Return the cause that names the chamber whose air is not as planned in time, or 0."""
    s, p, profile = state.control[0], parameters.control[0], parameters.profile[0]
    holding = s.phase == Phase.HOLD and not s.swinging
    if not (profile.air_planned and holding and time - s.address_air.since > p.pressure_timeout):
        return 0
    chamber, away = worst_chamber(profile, state.air[0])
    if away <= p.pressure_tolerance:
        return Cause.ADDRESS_TIMEOUT.value  # a joint never came into its band
    return int(Cause.SHOULDER_A_AIR + chamber)
