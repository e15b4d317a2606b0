"""Observer of the chamber pressures: a bench without pressure sensors needs them to invert its valves.

The applied valve commands, the estimated motion and the supply pressure drive the chamber model of the plant.
Its drift is corrected: by the chamber's sensor where one is fitted, otherwise by Kane's equations, since the
chamber pressures must give the force that the motion needs. A joint at rest or in its absorber gives no
information, as friction or absorber may carry any part of its load.

All pure, time is an argument.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any

import numpy as np

from bench.control.envelope import joint_coordinates
from drivers.base.compiled import compiled, fields
from sim.dynamics import chambers, wrist_cylinder
from sim.kane import kane_terms

AIR_STATE = np.dtype(
    [
        ("started", "?"),
        *fields("f8", "spool spool_speed", (3,)),
        *fields("f8", "pressure rate", (13,)),
        *fields("f8", "shown since", (6,)),
        ("given", "f8", (3,)),
    ],
    align=True,
)
"""Spools; pressures and rates as `sim.dynamics.chambers` takes them (chambers from 6 on, then supply, Pa);
what each sensor showed last and for how long (s); the force of each actuator as late as the estimated
acceleration is (N, shoulder N m)."""

SENSOR_MEMORY = 0.010
"""Time constant with which the observer follows a pressure sensor (s)."""
MOTION_MEMORY = 0.100
"""Time constant with which it follows the force that the motion needs (s): long against the noise of an
estimated acceleration, short against a swing."""
_LAG = 0.003
"""Delay of the estimated acceleration (s)."""
_MOVING = 0.3
"""Speed from which friction is that of sliding (rad/s)."""
_CLOSE = 1e-4
_MAX_STEP = 0.02
"""Max time that one tick makes up for after a stall (s)."""


@compiled
def actuator_motion(robot: Any, p: Any, angle: Any, velocity: Any, i: int) -> tuple[float, float]:
    """Return position and speed of actuator `i` in its own coordinate (rad, rod m, wrist's stroke m)."""
    if i == 2:
        stroke, lever = wrist_cylinder(p, sin(angle[2]), cos(angle[2]))
        return stroke, lever * velocity[2]
    return joint_coordinates(robot, angle, velocity, i)


@compiled
def conductance_of_vents(p: Any, r: Any, unpowered: float) -> float:
    """Return the conductance of a chamber's vents (m3/(s Pa)), `unpowered` s after power loss of their coils.

    Vents that both report shut are shut: a machine may have no safety relay, or an output sticks.
    """
    shut = r.vent_open[0] == 0.0 and r.vent_open[1] == 0.0
    passed: float = p.vent_conductance if unpowered > p.vent_delay and not shut else 0.0
    return passed


@compiled
def actuator_force(p: Any, pressure: Any, i: int) -> float:
    """Return the force of actuator `i` (N, shoulder N m) from `pressure` (13,) as in AIR_STATE."""
    in_a, in_b = pressure[6 + 2 * i] - p.atmosphere, pressure[7 + 2 * i] - p.atmosphere
    force: float = in_a * p.area_a[i] - in_b * p.area_b[i]
    return force


@compiled
def load_force(robot: Any, p: Any, angle: Any, i: int) -> tuple[float, float]:
    """Return force (N, shoulder N m) and lever (m, shoulder 1) of actuator `i`, which alone holds `angle`."""
    _, _, _, _, _, _, h1, h2, h3, lever = kane_terms(robot[0], angle[0], angle[1], angle[2], 0.0, 0.0, 0.0)
    if i == 0:
        return h1, 1.0
    if i == 1:
        return h2 / lever, lever
    _, wrist_lever = wrist_cylinder(p, sin(angle[2]), cos(angle[2]))
    return h3 / wrist_lever, wrist_lever


@compiled
def needed_torques(robot: Any, e: Any) -> tuple[tuple[float, float, float], float]:
    """Return the torques (N m) of the estimated motion by Kane's equations, and the right arm's lever (m)."""
    m11, m12, m13, m22, m23, m33, h1, h2, h3, lever = kane_terms(
        robot[0], e.angle[0], e.angle[1], e.angle[2], e.velocity[0], e.velocity[1], e.velocity[2]
    )
    a1, a2, a3 = e.acceleration[0], e.acceleration[1], e.acceleration[2]
    first = m11 * a1 + m12 * a2 + m13 * a3 + h1
    second = m12 * a1 + m22 * a2 + m23 * a3 + h2
    return (first, second, m13 * a1 + m23 * a2 + m33 * a3 + h3), lever


@compiled
def move_spool(m: Any, p: Any, wanted: float, i: int, halves: int) -> None:
    """Advance spool `i` of `m` by `halves` half substeps; exact for a constant valve command `wanted`."""
    for _ in range(halves):
        offset, rate = m.spool[i] - wanted, m.spool_speed[i]
        m.spool[i] = wanted + p.spool[i, 0] * offset + p.spool[i, 1] * rate
        m.spool_speed[i] = p.spool[i, 2] * offset + p.spool[i, 3] * rate


@compiled
def observe_air(
    a: Any,
    robot: Any,
    plant: Any,
    estimator: Any,
    readings: Any,
    applied: Any,
    exhaust_closed: bool,
    vent: float,
    step: float,
    free: bool,
) -> None:
    """Advance the observer `a` by `step` s under the valve commands `applied` since the last tick.

    `estimator` and `readings` are this tick's; `plant` is the machine's PLANT_PARAMETERS. `exhaust_closed`
    was commanded in the last tick; `vent` is the conductance of a chamber's vents (m3/(s Pa)). `free`: only
    chamber pressures, friction and weight act on the joints.
    """
    p, e, r = plant[0], estimator[0], readings[0]
    if not a.started:
        for k in range(6):
            a.pressure[6 + k] = p.atmosphere
            a.shown[k] = np.nan
        a.started = True
    if not (step > 0.0 and np.isfinite(e.angle.sum() + e.velocity.sum())):
        return
    supply = r.supply_pressure
    if not np.isfinite(supply):
        supply = p.regulated if exhaust_closed else p.atmosphere
    a.pressure[12] = supply
    part = p.tick / p.substeps
    count = int(min(step, _MAX_STEP) / part + 0.5)
    for i in range(3):
        position, speed = actuator_motion(robot, p, e.angle, e.velocity, i)
        wanted = applied[i] - p.centre[i]
        x, y = 6 + 2 * i, 7 + 2 * i
        for n in range(count):
            move_spool(a, p, wanted, i, 2)
            back = position - (count - n - 0.5) * part * speed
            chambers(p, i, a.pressure, a.rate, a.spool[i], back, speed, vent)
            a.pressure[x] = max(a.pressure[x] + part * a.rate[x], 0.1 * p.atmosphere)
            a.pressure[y] = max(a.pressure[y] + part * a.rate[y], 0.1 * p.atmosphere)
    _take_sensors(a, r, step)
    _take_motion(a, robot, p, e, r, step, free)


@compiled
def _take_sensors(a: Any, r: Any, step: float) -> None:
    """Draw chambers to what their sensors show; one that is read less often counts when it is read."""
    for k in range(6):
        a.since[k] += step
        pressure = r.chamber_pressure[k]
        if np.isfinite(pressure) and pressure != a.shown[k]:
            a.pressure[6 + k] += a.since[k] / (a.since[k] + SENSOR_MEMORY) * (pressure - a.pressure[6 + k])
            a.shown[k], a.since[k] = pressure, 0.0


@compiled
def _take_motion(a: Any, robot: Any, p: Any, e: Any, r: Any, step: float, free: bool) -> None:
    """Draw chambers without a sensor to the force that the estimated motion needs."""
    for i in range(3):
        x, y = 6 + 2 * i, 7 + 2 * i
        a.given[i] += step / (step + _LAG) * (actuator_force(p, a.pressure, i) - a.given[i])
        if np.isfinite(r.chamber_pressure[x - 6]) and np.isfinite(r.chamber_pressure[y - 6]):
            continue
        position, speed = actuator_motion(robot, p, e.angle, e.velocity, i)
        stop = position if i != 2 else e.angle[2]
        inside = p.lower[i] + _CLOSE < stop < p.upper[i] - _CLOSE
        if not (free and inside and abs(e.velocity[i]) > _MOVING):
            continue
        needed, lever = needed_torques(robot, e)
        _, wrist_lever = wrist_cylinder(p, sin(e.angle[2]), cos(e.angle[2]))
        to_joint = 1.0 if i == 0 else lever if i == 1 else wrist_lever
        friction = p.viscous[i] * speed + (p.coulomb[i] if speed > 0.0 else -p.coulomb[i])
        missing = needed[i] / to_joint + friction - a.given[i]
        if np.isfinite(missing):
            shift = 0.5 * min(step / MOTION_MEMORY, 1.0) * missing
            a.given[i] += 2.0 * shift
            a.pressure[x] = max(a.pressure[x] + shift / p.area_a[i], 0.1 * p.atmosphere)
            a.pressure[y] = max(a.pressure[y] - shift / p.area_b[i], 0.1 * p.atmosphere)
