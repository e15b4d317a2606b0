"""Feed-forward valve commands: planned by the profile, or computed from the robot's model.

planned         the profile's valve commands, found for this very loop on the nominal plant;
kane+pneumatic  the valve command whose air flow changes the force as demanded: chamber equations and the
                valve's flow (ISO 6358) solved for the spool, dead band and leakage included, at the pressures
                that `bench.control.estimate.air` observes.

All pure; the demanded forces, by Kane's equations, and their rates are tables
(`bench.control.law.force_reference`).
"""

from __future__ import annotations

from typing import Any, Literal

from bench.control.estimate.air import actuator_force, actuator_motion
from drivers.base.compiled import compiled
from sim.pneumatics import flow

FeedForward = Literal["none", "planned", "kane+pneumatic"]
CODES: tuple[FeedForward, ...] = ("none", "planned", "kane+pneumatic")
"""Feed-forwards in the order of their codes in the control record."""
NONE, PLANNED, PNEUMATIC = range(3)

_EASED = 0.01
"""Fraction of the stroke over which the jump across the dead band is spread: no chatter around zero."""


@compiled
def force_rates(p: Any, i: int, pressure: Any, position: float, speed: float) -> tuple[float, float, float]:
    """Return three force rates of actuator `i` (N/s, shoulder N m/s): spool centred; added by commands 1, -1.

    `pressure` (13,) Pa as in AIR_STATE. The first rate is that of motion and leakage. The valve command 1
    adds the second, -1 the third (negative); commands beyond the dead band add in proportion.
    """
    pa, pb, supply, atmosphere = pressure[6 + 2 * i], pressure[7 + 2 * i], pressure[12], p.atmosphere
    edge, ratio, leak = p.conductance[i], p.critical_ratio[i], p.leakage[i]
    in_a, out_a = flow(edge, supply, pa, ratio), flow(edge, pa, atmosphere, ratio)
    in_b, out_b = flow(edge, supply, pb, ratio), flow(edge, pb, atmosphere, ratio)
    across = flow(p.cross_leakage[i], pa, pb, ratio)
    area_a, area_b, dead = p.area_a[i], p.area_b[i], p.dead_volume[i]
    gain_a = p.exponent * area_a / max(dead + area_a * (position - p.volume_lower[i]), 0.2 * dead)
    gain_b = p.exponent * area_b / max(dead + area_b * (p.volume_upper[i] - position), 0.2 * dead)
    still = gain_a * (leak * (in_a - out_a) - across - pa * area_a * speed)
    still -= gain_b * (leak * (in_b - out_b) + across + pb * area_b * speed)
    return still, gain_a * in_a + gain_b * out_b, -gain_a * out_a - gain_b * in_b


@compiled
def opening_for(p: Any, i: int, rates: tuple[float, float, float], wanted: float) -> float:
    """Return the valve command, -1 to 1, with which the force of actuator `i` changes at the rate `wanted`.

    `rates` are those of `force_rates`.
    """
    still, up, down = rates
    missing = wanted - still
    full = up if missing > 0.0 else -down
    if not full > 0.0:
        return 0.0
    share = min(max(missing / full, -1.0), 1.0)
    band = p.dead_band[i] * min(abs(share) / _EASED, 1.0)
    opening = band + (1.0 - p.dead_band[i]) * abs(share)
    return float(opening if share > 0.0 else -opening)


@compiled
def pneumatic_opening(
    p: Any, robot: Any, i: int, air: Any, angle: Any, velocity: Any, force: float, rate: float, gain: float
) -> float:
    """Return the valve command of actuator `i` for a `force` and its `rate` at the observed pressures.

    `angle`, `velocity` (3,) are the reference's; the force error is corrected at the rate `gain` (1/s).
    """
    position, speed = actuator_motion(robot, p, angle, velocity, i)
    rates = force_rates(p, i, air.pressure, position, speed)
    return opening_for(p, i, rates, rate + gain * (force - actuator_force(p, air.pressure, i)))
