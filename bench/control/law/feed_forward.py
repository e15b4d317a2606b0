"""Feed-forward valve commands: planned by the profile, or computed from the robot's model.

planned         the profile's openings, found for this very loop on the nominal plant
kane            a spool meters flow, and flow changes the force: the rate of the force that Kane's equations
                demand and the speed of the motion, each with a constant gain, that of half a stroke and of
                chambers evenly charged
kane+pneumatic  the opening whose air flow changes the force as demanded: chamber equations and the valve's
                flow (ISO 6358) solved for the spool, dead band and leakage included, at the pressures that
                `bench.control.estimate.air` observes

All pure. Demanded forces and their rates are tables: Kane's inverse dynamics of the reference, beforehand.
Positions are tables, so velocities and accelerations are their slopes, smoothed by parabolas over some
samples; not across the instants at which a reference may jump: where the downswing takes over from the top,
and where the impact window begins. From there on, as the impact's forces are not the actuators', the last
force is held.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.estimate.air import actuator_force, actuator_motion
from bench.swing.profile import Profile
from drivers.base.compiled import compiled
from sim.kane import inverse_dynamics
from sim.kinematics import right_arm_length
from sim.plant import PlantParameters
from sim.pneumatics import flow

Array = NDArray[np.float64]
FeedForward = Literal["none", "planned", "kane", "kane+pneumatic"]
CODES: tuple[FeedForward, ...] = ("none", "planned", "kane", "kane+pneumatic")
"""Feed-forwards in the order of their codes in the control record."""
NONE, PLANNED, KANE, PNEUMATIC = range(4)

_CHARGED = 0.75
"""Share of the supply's pressure that charging leaves in the chambers."""
_EASED = 0.01
"""Share of the stroke over which the jump across the dead band is spread: no chatter around zero."""


@compiled
def force_rates(p: Any, i: int, pressure: Any, position: float, speed: float) -> tuple[float, float, float]:
    """Return the force rates of actuator `i` (N/s, shoulder N m/s): spool centred; added by full openings.

    `pressure` (13,) Pa as in AIR_STATE. The first is that of motion and leakage; the second is added by the
    opening 1, the third by -1 (negative), both beyond the dead band and in proportion.
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
    """Return the opening with which the force of actuator `i` changes at `wanted`; `rates` of `force_rates`.

    Within -1 to 1 of the stroke.
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
    """Return the opening of actuator `i` for a demanded `force` and its `rate` at the observed pressures.

    `angle`, `velocity` (3,) are the reference's; the force error is corrected at the rate `gain` (1/s).
    """
    position, speed = actuator_motion(robot, p, angle, velocity, i)
    rates = force_rates(p, i, air.pressure, position, speed)
    return opening_for(p, i, rates, rate + gain * (force - actuator_force(p, air.pressure, i)))


def kane_gains(plant: Any) -> tuple[Array, Array]:
    """Return openings (3,) per N/s of force rate and per m/s of actuator speed; the shoulder's in N m, rad.

    `plant` is the machine's PLANT_PARAMETERS record.
    """
    p, air = plant[0], np.full(13, _CHARGED * plant["regulated"][0])
    air[12] = p["regulated"]
    by_rate, by_speed = np.zeros(3), np.zeros(3)
    for i in range(3):
        middle = 0.5 * (p["volume_lower"][i] + p["volume_upper"][i])
        still, up, down = _nominal_rates(plant, i, air, middle, 0.0)
        moving = _nominal_rates(plant, i, air, middle, 1.0)[0]
        by_rate[i] = 2.0 / (up - down)
        by_speed[i] = (still - moving) * by_rate[i]
    return by_rate, by_speed


@compiled
def _nominal_rates(
    plant: Any, i: int, pressure: Any, position: float, speed: float
) -> tuple[float, float, float]:
    return force_rates(plant[0], i, pressure, position, speed)


_SPAN = 0.014
"""Time over which a slope is smoothed (s)."""
_TURNING = 0.05
"""Speed over which friction changes sides (rad/s)."""


class ForceDemand(NamedTuple):
    """Forces of the three actuators at the profile's samples, (n, 3), and their rates."""

    force: Array
    """N, of the shoulder N m: positive from chamber A; the wrist's along its cylinder."""
    rate: Array
    """N/s, N m/s"""


def demand_for(feed_forward: FeedForward, plant: PlantParameters, profile: Profile) -> ForceDemand:
    """Return the forces for a controller with `feed_forward`: `demand_of`, or zeros if it uses none."""
    if CODES.index(feed_forward) >= KANE:
        return demand_of(plant, profile)
    return ForceDemand(np.zeros(profile.angle.shape), np.zeros(profile.angle.shape))


def demand_of(plant: PlantParameters, profile: Profile) -> ForceDemand:
    """Return the actuator forces that `profile` requires of `plant`, friction included.

    The tables lead by the lag of each spool and half a tick.
    """
    period, n = profile.period, len(profile.angle)
    force, rate = np.zeros((n, 3)), np.zeros((n, 3))
    window = profile.begins[5]
    for first, last in ((0, profile.begins[3]), (profile.begins[3], window)):
        if last <= first:
            continue
        rows = slice(first, last)
        angle = profile.angle[rows]
        velocity, acceleration = _slope(angle, period, 1), _slope(angle, period, 2)
        force[rows] = actuator_forces(plant, angle, velocity, acceleration)
        rate[rows] = _slope(force[rows], period, 1)
    force[window:] = force[max(window - 1, 0)]
    return ForceDemand(*(_earlier(table, plant, profile) for table in (force, rate)))


def actuator_forces(plant: PlantParameters, angle: Array, velocity: Array, acceleration: Array) -> Array:
    """Return the actuators' forces (n, 3) (N, shoulder N m) that move the robot so; joints (n, 3)."""
    robot = plant.robot
    force = inverse_dynamics(robot, angle, velocity, acceleration)
    lever = plant.wrist_slope(angle[:, 2])
    force[:, 2] /= lever
    arm = right_arm_length(robot, angle[:, 1])
    slope = -robot.l62 * robot.l23 * np.sin(angle[:, 1]) / arm
    speed = np.column_stack([velocity[:, 0], slope * velocity[:, 1], lever * velocity[:, 2]])
    frictions = [actuator.friction for actuator in plant.actuators]
    viscous, coulomb = (np.array([getattr(f, name) for f in frictions]) for name in ("viscous", "coulomb"))
    # Levers are positive in the working range: joint and actuator move the same way.
    return np.asarray(force + viscous * speed + coulomb * np.tanh(velocity / _TURNING))


def _slope(table: Array, period: float, order: int) -> Array:
    """Return the derivative of `order` 0, 1 or 2 of `table` (n, 3) by s."""
    from scipy.signal import savgol_filter  # here, for it takes long to import and few controllers need it

    samples = min(2 * round(_SPAN / period / 2) + 1, len(table) - 1 + len(table) % 2)
    if samples < 3:
        return np.zeros_like(table)
    return np.asarray(
        savgol_filter(table, samples, 2, deriv=order, delta=period, axis=0, mode="interp"), dtype=float
    )


def _earlier(table: Array, plant: PlantParameters, profile: Profile) -> Array:
    """Return `table` (n, 3) read ahead by the lag of each actuator's spool and half a tick."""
    at = np.arange(len(table)) * profile.period
    lag = [2 * a.valve.damping_ratio / a.valve.natural_frequency + plant.tick / 2 for a in plant.actuators]
    return np.column_stack([np.interp(at + lag[i], at, table[:, i]) for i in range(3)])
