"""Pressure control at the address: chambers reach the planned pressures before a swing may start.

With the spool centred a chamber holds its pressure, and dry friction holds the joint over a range of
pressures: neither sum nor difference of an actuator's pressures follows from its pose. A closed-centre spool
controls both chambers by two quantities:

sum         dithered around its centre, the spool admits as much air to each chamber as it releases. Both
            pressures approach the balance of inflow and outflow, about three quarters of the supply. The
            longer the dither, the less the earlier pressures matter. The planned pressures therefore lie on
            this balance (`bench.control.moves.pressure_plan`); leakage of the centred spool leads near it.
difference  an offset of the dither fills one chamber and empties the other.

The PID first moves each joint into its band around the address. The spool is dithered, so that neither dead
band nor friction keeps the joint away. From then on the valve controls pressure only: friction holds the
joint as long as the planned force is near its load. Once both chambers are as planned the spool rests at its
centre. If leakage prevents all three spools from resting together, the dither continues instead.
With dry friction large compared with the pneumatic stiffness, a joint sticks off its address, breaks away and
overshoots. After some time the controller raises its force beyond its friction, and stops it as it slips. The
hold takes over a move that ends in this way.

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
"""Time in which friction stops a released joint (s): a slipping one is stopped this long ahead."""
_LOOSENING = 2.0
"""Times the dry friction that a force beyond the load comes to until a joint breaks away; static is less."""
_SLIPS = 2.0
"""Multiple of `rest_speed` above which a joint slips; less may be a single count of its encoder."""
_CAUGHT = 8.0
"""Times `rest_speed` at which a joint may be caught."""
_FIRM = 0.5
"""Fraction of the dry friction by which a stuck joint's force may be off: beyond friction it slides."""
_NEARER = 0.5
"""Fraction of the tolerance within which the dither of a spool ends."""
_RATE = 6.0
"""Rate at which a missing difference is made up for, 1/s."""
_CHARGING_RATE = 30.0
"""The same while charging, 1/s."""
_SOFT = 0.3
"""Fraction of the dither beyond the dead band until a joint has answered: less air, which would drive a joint
whose valve is reversed."""
_TRIM_RATE = 1.0
"""Rate at which the offset that keeps the difference, or loosens a late joint, is learned, 1/s."""
_MAX_TRIM = 0.1
"""Max offset of a spool from its centre, as a valve command: beyond it the valve is faulty."""
_MISSED = 1.5
"""Time after a move's end with a joint off its address (s): it alternately sticks and overshoots."""
_REACH = 0.5
"""Fraction of the hold's max following error within which such a joint is left to the hold."""
_SETTLING = 0.1
"""Time for which pressures must be as planned with all spools at rest (s)."""
_TIMEOUT = 6.0
"""Time without all pressures as planned at rest, after which a joint counts as late (s)."""
_PASSED = 0.5
"""Time after which a joint that slips through its band is caught there (s): its PID's integral would drive it
past repeatedly, as far as the ball."""
HELD, LATE, SLIPPED = 1, 2, 4
"""Bits of `held`. Friction holds a joint. A late one is pushed free and caught, its chambers may leak.
One that slipped past its address is only caught."""
_LEAKING = 1.5
"""Times the tolerance within which the pressures of late joints are as planned: spools hold them."""
_OFFSET = 0.8
"""Max offset as a fraction of the dither beyond the dead band: the rest still controls the sum."""


@compiled
def leave_address_air(s: Any, time: float) -> None:
    """Reset flags and times of the pressure control at the address, for the next hold."""
    for i in range(3):
        s.address_air.held[i] = s.address_air.swung[i] = 0
    s.address_air.ready, s.address_air.good, s.address_air.since = False, time, time


@compiled
def _has_missed(s: Any, time: float) -> bool:
    """Return whether a move ended so long ago that a joint must be passing its address again and again."""
    return bool(time - s.move.start - s.move.duration >= _MISSED)


@compiled
def take_over_unsettled_move(s: Any, parameters: Any, estimator: Any, time: float) -> bool:
    """Return whether the hold takes over a move that ended off its address; mark its unsettled joints.

    With a PID alone a joint with high friction hunts there; the hold stops an unsettled one as it slips.
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
        if not away <= most:  # also NaN
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
def _dither_part(s: Any, i: int) -> float:
    """Return the fraction of the dither beyond the dead band that spool `i` is moved with."""
    return _SOFT if s.first_motion.answered[i] == 0 else 1.0


@compiled
def _amplitude(parameters: Any, i: int, part: float) -> float:
    """Return the dither's amplitude of spool `i`, its part beyond the dead band times `part`."""
    whole: float = parameters.profile[0].dither_amplitude[i]
    return whole - (1.0 - part) * (whole - float(parameters.plant[0].dead_band[i]))


@compiled
def _bounded(parameters: Any, i: int, offset: float, part: float = 1.0) -> float:
    """Return the `offset` of spool `i`, bounded so that its dither still controls the sum."""
    most = _OFFSET * (_amplitude(parameters, i, part) - parameters.plant[0].dead_band[i])
    return float(min(max(offset, -most), most))


@compiled
def _offset_for(state: Any, parameters: Any, i: int, missing: float, rate: float) -> float:
    """Return the dither offset that corrects a `missing` force (N, N m) at `rate` (1/s)."""
    e, air, plant = state.estimator[0], state.air[0], parameters.plant[0]
    position, _ = actuator_motion(parameters.robot, plant, e.angle, e.velocity, i)
    _, up, down = force_rates(plant, i, air.pressure, position, 0.0)
    slope = 0.5 * (up - down)
    offset = rate * missing / slope if slope > 0.0 else 0.0
    return float(offset) if np.isfinite(offset) else 0.0


@compiled
def _balancing(state: Any, parameters: Any, i: int, part: float = 1.0) -> float:
    """Return the dither offset that keeps the force constant, by the model.

    The inflow of one chamber differs from the outflow of the other, and chambers leak.
    """
    e, air, plant = state.estimator[0], state.air[0], parameters.plant[0]
    position, _ = actuator_motion(parameters.robot, plant, e.angle, e.velocity, i)
    still, up, down = force_rates(plant, i, air.pressure, position, 0.0)
    drift = still + part * parameters.profile[0].dither_duty[i] * (up + down)
    offset = -2.0 * (1.0 - plant.dead_band[i]) * drift / (up - down) if up > down else 0.0
    return float(offset) if np.isfinite(offset) else 0.0


@compiled
def _push(state: Any, parameters: Any, i: int) -> float:
    """Return the force (N, N m) that actuator `i` lacks to break its joint away, at rest off the address.

    It is 0 if the PID already pushes more, as the PID also corrects errors of the model.
    """
    e, plant = state.estimator[0], parameters.plant[0]
    load, lever = load_force(parameters.robot, plant, e.angle, i)
    way = lever * (parameters.angle[0, i] - e.angle[i])
    pushes = actuator_force(plant, state.air[0].pressure, i) - load
    enough = _LOOSENING * plant.coulomb[i]
    return float(max(enough - pushes, 0.0) if way > 0.0 else min(-enough - pushes, 0.0))


@compiled
def regulate_address_pressure(state: Any, parameters: Any, time: float) -> None:
    """Set the desired valve commands (3,) of the hold: the PID's to the address, then those for the air.

    At first `desired` holds the PID's valve commands.
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
            # The swing starts with an empty integral.
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
            if late or not held:  # a soft PID cannot compensate the dither's force drift
                offset = _bounded(parameters, i, offset + _balancing(state, parameters, i))
            s.desired[i] += side * profile.dither_amplitude[i] + offset
    if not settled:
        s.address_air.good = time
    s.address_air.ready = time - s.address_air.good >= _SETTLING
    if s.address_air.ready:
        s.address_air.since = time


@compiled
def precharge(state: Any, parameters: Any, time: float) -> None:
    """Set valve commands (3,) that precharge the chambers and bring forces to the joints' loads.

    The chambers of an actuator are unequal: filled alike, the smaller one would push the joint away until the
    other has as much. And a vented robot rests by friction alone: near the ground it would slide onto it.
    """
    s, air, plant, profile = state.control[0], state.air[0], parameters.plant[0], parameters.profile[0]
    for i in range(3):
        side = square_wave((time - s.move.start) / profile.dither_period[i])
        s.address_air.trim[i] = 0.0
        if time >= s.air_from:
            load, _ = load_force(parameters.robot, plant, state.estimator[0].angle, i)
            missing = load - actuator_force(plant, air.pressure, i)
            offset = _offset_for(state, parameters, i, missing, _CHARGING_RATE)
            part = _dither_part(s, i)
            if part < 1.0:  # its PID is bounded: it cannot hold a joint that drifts
                offset += _balancing(state, parameters, i, part)
            s.desired[i] += side * _amplitude(parameters, i, part) + _bounded(parameters, i, offset, part)


@compiled
def dither_move(state: Any, parameters: Any, time: float) -> None:
    """Dither the spools of a slow move, so that dead band and friction hold no joint behind the others.

    Near the ground all joints together lift the head, and on the way the chambers approach their planned
    pressures. From _MISSED after the move's end a slipping joint loses its integral, which would drive it as
    far beyond the address and make it hunt for ever. An offset then also compensates the dither's force
    drift, which a soft PID cannot.
    """
    s, p, e, profile = state.control[0], parameters.control[0], state.estimator[0], parameters.profile[0]
    missed = _has_missed(s, time)
    for i in range(3):
        if missed and abs(e.velocity[i]) > _SLIPS * p.rest_speed[i]:
            state.pid[0].integral[i] = 0.0
        side = square_wave((time - s.move.start) / profile.dither_period[i])
        part = _dither_part(s, i)
        s.desired[i] += side * _amplitude(parameters, i, part)
        if missed:
            s.desired[i] += _bounded(parameters, i, _balancing(state, parameters, i, part), part)


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
