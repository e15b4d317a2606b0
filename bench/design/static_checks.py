"""Whether a swing is possible on this machine: all checks that need no motion.

Each check is a pure function of the plan and returns its findings and limits, so that a user sees all checks
and not only the failed ones.

Limits of the air (golf.md 8; ISO 6358) are a strict bound: with the motion given, a chamber that takes all
the air of its fully open valve and loses none has the max pressure that any command could give; one that only
loses air has the min pressure. A motion that needs more force than these pressures give is beyond valves and
supply. One that passes may still be hard to follow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache
from math import hypot
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.control.moves.pressure_plan import falling_root
from bench.control.settings import EnvelopeSettings
from bench.swing.actuator_motion import Motion
from bench.swing.profile import BALL_TOLERANCE, PHASES, Profile
from drivers.base import JOINTS
from drivers.base.compiled import compiled
from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, joint_positions
from sim.plant import ACTUATOR_KEYS, PlantParameters
from sim.pneumatics import FLOW_TO_PRESSURE, Actuator, Supply, flow, stop_force

Array = NDArray[np.float64]

PRESSURE_TOLERANCE = 0.01
"""Fraction by which the supply may differ from the one the swing was designed for."""
SLOPE_TOLERANCE = 0.5
SLOPE_TIME = 0.010
"""Velocities may differ from the angles' slope by this (rad/s), and by more for this long (s)."""
STEP_SHARE = 0.25
"""Fraction of the envelope's max following error that a step of the reference may use up."""
CONTACT_TOLERANCE = (0.08, 0.02)
"""Max distance along the path and in height between face and ball at the planned contact (m): it moves 4 cm
in a tick."""
EXCESS_SHARE = 0.05
EXCESS_TIME = 0.005
"""Force may exceed the air's bound by this fraction of the actuator's max force, and by more for this long
(s): the tables are rounded, and differentiated here."""
_SUBSTEPS = 4
"""Integration steps of the chamber pressures between two samples."""
_PARTS = 10
"""Parts of the time between two samples where cushions are checked."""

_POSITION, _SPEED, _FORCE = ("rad", "m", "rad"), ("rad/s", "m/s", "rad/s"), ("N m", "N", "N")


class Check(NamedTuple):
    """One check of a swing."""

    name: str
    found: str
    allowed: str
    faults: list[BenchError]


class MachineSwing(NamedTuple):
    """A swing on a machine."""

    profile: Profile
    plant: PlantParameters
    envelope: EnvelopeSettings
    motion: Motion
    location: str
    """The profile's file, for messages."""
    tee: str
    """Source of the ball's position, for messages."""

    def key(self, name: str, found: str, expected: str, action: str) -> BenchError:
        """Return a fault of one key of the profile."""
        return BenchError(f"{self.location}: {name}", found, expected, action)

    def row(self, where: tuple[str, int, int | None], found: str, expected: str, action: str) -> BenchError:
        """Return the error of one row or value of a table: table, sample, joint."""
        table, sample, joint = where
        column, name = ("", "") if joint is None else (f"[{joint}]", f", {JOINTS[joint]}")
        at = f"{table}[{sample}]{column} ({sample * self.profile.period:.3f} s{name})"
        return self.key(at, found, expected, action)


def check_profile(
    profile: Profile,
    plant: PlantParameters,
    envelope: EnvelopeSettings,
    location: str | None = None,
    tee: str = "plant.site",
) -> list[Check]:
    """Return every check of `profile` on the machine but that of its rate; `location` names its file.

    `tee` names the source of the ball's position.
    A running bench swings with values between the samples, see `other_rate`.
    """
    plan = MachineSwing(profile, plant, envelope, Motion(profile, plant), location or profile.name, tee)
    done = [check(plan) for check in _CHECKS]
    # The force that the air must give follows from the tables' slopes.
    return done if _tables(plan).faults else [*done, _air(plan)]


def profile_faults(
    profile: Profile, plant: PlantParameters, envelope: EnvelopeSettings, location: str | None = None
) -> list[BenchError]:
    """Return every reason why `profile` may not be swung on the machine with a sample a tick."""
    checks = check_profile(profile, plant, envelope, location)
    return [*rate_faults(profile, plant, location), *(fault for check in checks for fault in check.faults)]


def rate_faults(profile: Profile, plant: PlantParameters, location: str | None = None) -> list[BenchError]:
    """Return the fault of a profile that has no sample for each of the loop's ticks, if it is so."""
    if not other_rate(profile, plant):
        return []
    found, wanted = f"{profile.period:g} s", f"{plant.tick:g} s, the loop's tick"
    action = "Set loop.rate_hz to its inverse."
    return [BenchError(f"{location or profile.name}: period_s", found, wanted, action)]


def require_possible(
    profile: Profile, plant: PlantParameters, envelope: EnvelopeSettings, location: str | None = None
) -> None:
    """Refuse a swing that is impossible; raises ExceptionGroup: one BenchError per reason."""
    if faults := profile_faults(profile, plant, envelope, location):
        raise ExceptionGroup(f"{location or profile.name} cannot be swung here", faults)


def _peak(values: Array) -> tuple[int, int]:
    """Return sample and joint of the max of `values` (n, 3)."""
    sample, joint = np.unravel_index(int(values.argmax()), values.shape)
    return int(sample), int(joint)


def _lasting(values: Array, time: float, period: float) -> Array:
    """Return the level that `values` (n, 3) exceed without a break for `time` s from each sample on."""
    samples = min(round(time / period), len(values) - 1) + 1
    return np.asarray(np.lib.stride_tricks.sliding_window_view(values, samples, axis=0).min(axis=-1))


def _impact(plan: MachineSwing) -> slice:
    """Return the ticks from before the impact window to after it."""
    return slice(max(plan.profile.begins[5] - 1, 0), plan.profile.begins[6] + 1)


def _machine(plan: MachineSwing) -> Check:
    """Compare the conditions that the profile was made for with the machine: club, supply."""
    profile, plant, faults = plan.profile, plan.plant, []
    club, supply = plant.robot.club.name, plant.supply.pressure
    designed = profile.limits.get("supply_pressure_pa", 0.0)
    if profile.club != club:
        action = "Set swing.profile to one for this club (golfbench profile list), or swing.club = "
        action += f'"{profile.club}".'
        faults.append(plan.key("club", f'"{profile.club}"', f'"{club}", the mounted one', action))
    if abs(designed - supply) > PRESSURE_TOLERANCE * supply:
        found = f"{designed:.4g} Pa" if designed else "not given"
        wanted = f"{supply:.4g} Pa absolute, plant.supply.pressure, within 1 %"
        action = "Choose another profile, or design one for this supply."
        faults.append(plan.key("limits.supply_pressure_pa", found, wanted, action))
    found = f"{profile.club}, {designed / 1e5:.2f} bar"
    return Check("made for", found, f"{club}, {supply / 1e5:.2f} bar", faults)


def _tables(plan: MachineSwing) -> Check:
    """Check that the tables agree: velocity is the angle's slope, and the swing begins at rest."""
    angle, velocity, faults = plan.profile.angle, plan.profile.velocity, []
    slope = np.diff(angle, axis=0) / plan.profile.period
    # A tick in which the speed jumps may have any slope between; at the ball there is no reference at all.
    jump = np.abs(np.diff(velocity, axis=0)) / 2
    error = np.maximum(np.abs(slope - (velocity[1:] + velocity[:-1]) / 2) - jump, 0.0)
    error[_impact(plan)] = 0.0
    lasting = _lasting(error, SLOPE_TIME, plan.profile.period)
    k, joint = _peak(lasting)
    if lasting[k, joint] > SLOPE_TOLERANCE:
        found = f"{velocity[k, joint]:.3f} rad/s, where angle_rad rises by {slope[k, joint]:.3f} rad/s"
        wanted = f"the angle's slope within {SLOPE_TOLERANCE:g} rad/s"
        action = "Correct the table; angles are in rad, one row a period."
        faults.append(plan.row(("velocity_rad_per_s", k, joint), found, wanted, action))
    following = plan.envelope.max_following_error
    limits = {int(phase): following.get(phase.name.lower(), (np.inf,) * 3) for phase in PHASES}
    step = error * plan.profile.period
    allowed = STEP_SHARE * np.array([limits[int(phase)] for phase in plan.profile.phases[1:]])
    j, i = _peak(step / allowed)
    if step[j, i] > allowed[j, i]:
        found = f"{angle[j, i]:.4f}, then {angle[j + 1, i]:.4f} rad: a step no robot can follow"
        wanted = f"a step of at most {allowed[j, i]:.3g} rad, {STEP_SHARE:g} of envelope.max_following_error"
        faults.append(plan.row(("angle_rad", j, i), found, wanted, "Smooth the table there."))
    _, joint = _peak(np.abs(velocity[:1]))
    if abs(velocity[0, joint]) > 0.1:
        found, action = f"{velocity[0, joint]:.3f} rad/s", "Begin the swing at rest at address."
        faults.append(plan.row(("velocity_rad_per_s", 0, joint), found, "at most 0.1 rad/s", action))
    text = f"slope {lasting.max():.2f} rad/s off · step {step[j, i]:.3f} rad"
    return Check("tables agree", text, f"{SLOPE_TOLERANCE:g} rad/s · {allowed[j, i]:.3g} rad", faults)


def other_rate(profile: Profile, plant: PlantParameters) -> str:
    """Return the mismatch of the swing's sample period and the loop's tick; empty without one."""
    if abs(profile.period - plant.tick) <= 1e-9:
        return ""
    return (
        f"swing {profile.name} has a sample every {1e3 * profile.period:g} ms, the loop a tick every "
        f"{1e3 * plant.tick:g} ms: values between the samples are interpolated, but profile check, "
        "campaigns, learning and faults need a sample per tick: set loop.rate_hz, or design one for this rate"
    )


def beyond_range(profile: Profile, plant: PlantParameters, envelope: EnvelopeSettings) -> str:
    """Return where the swing leaves the working range of a joint; empty if it does not."""
    motion, share = Motion(profile, plant), envelope.absorber_travel_fraction
    for i, actuator in enumerate(plant.actuators):
        beyond = _beyond(actuator, motion.position[:, i])
        k = int(beyond.argmax())
        if beyond[k] > share * actuator.stop.travel:
            location = f"{motion.position[k, i]:.4f} {_POSITION[i]}"
            return f"the {JOINTS[i]} is led to {location} after {k * profile.period:.3f} s, beyond its range"
    return ""


def _beyond(actuator: Actuator, position: Array) -> Array:
    """Return how far each of `position` (n,) lies beyond the ends of the travel."""
    return np.asarray(np.maximum(actuator.lower - position, position - actuator.upper))


def _range(plan: MachineSwing) -> Check:
    """Check the end stops: travel and energy within the envelope's limits for the absorber."""
    share, faults, texts, ratings = plan.envelope.absorber_travel_fraction, [], [], []
    for i, actuator in enumerate(plan.plant.actuators):
        position, unit, stop = plan.motion.position[:, i], _POSITION[i], actuator.stop
        beyond = _beyond(actuator, position)
        k = int(beyond.argmax())
        location, speed = _between_samples(position, plan.motion.speed[:, i], plan.profile.period)
        force = stop_forces(actuator, location, speed)
        energy = _greatest_visit(-force * speed * plan.profile.period / _PARTS)
        if beyond[k] > share * stop.travel:
            low, high = actuator.lower - share * stop.travel, actuator.upper + share * stop.travel
            found = f"{position[k]:.4f} {unit}: the swing hits an end stop"
            key = ACTUATOR_KEYS[i]
            wanted = f"{low:.4f} to {high:.4f} {unit}, plant.{key} with {share:.0%} of its absorbers"
            action = "Choose a profile made for these stops, or correct the range."
            faults.append(plan.row(("angle_rad", k, i), found, wanted, action))
        elif energy > stop.rating:
            found, wanted = f"{energy:.0f} J into an end stop", f"at most {stop.rating:g} J"
            action = f"Arrive more slowly; plant.{ACTUATOR_KEYS[i]}.stop has the absorber's rating."
            faults.append(plan.row(("angle_rad", k, i), found, wanted, action))
        texts.append(f"{energy:.0f}")
        ratings.append(f"{stop.rating:g}")
    return Check("end stops", " · ".join(texts) + " J", " · ".join(ratings) + " J", faults)


def _between_samples(position: Array, speed: Array, period: float) -> tuple[Array, Array]:
    """Return position and speed `_PARTS` times as often: a cushion may stop a rod within two samples.

    Between two samples, which are finite, the position is the cubic through both with their speeds (Hermite).
    """
    part = np.arange((len(position) - 1) * _PARTS + 1)
    k = np.minimum(part // _PARTS, len(position) - 2)
    time = (part / _PARTS - k) * period
    first, last = speed[:-1][k], speed[1:][k]
    slope = np.diff(position)[k] / period
    bend = (3 * slope - 2 * first - last) / period
    twist = (first + last - 2 * slope) / period**2
    location = position[:-1][k] + time * (first + time * (bend + time * twist))
    return location, first + time * (2 * bend + time * 3 * twist)


def _greatest_visit(work: Array) -> float:
    """Return the largest sum of positive `work` (n,) in one visit, that is between samples without force."""
    most = energy = 0.0
    for part in work.tolist():
        energy = energy + max(part, 0.0) if part else 0.0
        most = max(most, energy)
    return most


def _speed(plan: MachineSwing) -> Check:
    """Compare the speeds with the envelope's limits."""
    limits, faults = plan.envelope.max_speed, []
    speed = np.abs(plan.motion.speed)
    for i, limit in enumerate(limits):
        k = int(speed[:, i].argmax())
        if speed[k, i] > limit:
            found, wanted = f"{speed[k, i]:.2f} {_SPEED[i]}", f"at most {limit:g} {_SPEED[i]}"
            action = "Slow the swing; envelope.max_speed is the limit."
            faults.append(plan.row(("velocity_rad_per_s", k, i), found, wanted, action))
    return Check("joint speeds", _joined(speed.max(axis=0), "{:.1f}"), _joined(limits, "{:g}"), faults)


def _joined(values: Iterable[float], form: str) -> str:
    """Return speeds of the three joint coordinates with their units."""
    return " · ".join(f"{form.format(value)} {unit}" for value, unit in zip(values, _SPEED, strict=True))


def _clearance(plan: MachineSwing) -> Check:
    """Check the club's clearance from ground and frame, as the envelope does."""
    robot, site, envelope, faults = plan.plant.robot, plan.plant.site, plan.envelope, []
    head = forward_kinematics(robot, plan.profile.angle)
    height = head[:, 1] - site.sole_depth - site.ground
    by_ball = np.abs(head[:, 0] - plan.profile.ball[0]) <= envelope.ball_window
    needed = np.where(by_ball, envelope.clearance_by_ball(site), envelope.clearance)
    k = int((height - needed).argmin())
    if height[k] < needed[k]:
        found, wanted = f"sole {1e3 * height[k]:.1f} mm over ground", f"at least {1e3 * needed[k]:g} mm"
        action = "Raise the path, or correct plant.site.ground."
        faults.append(plan.row(("angle_rad", k, None), found, wanted, action))
    points = joint_positions(robot, plan.profile.angle)
    wrist, along = points[:, 2], (points[:, 4] - points[:, 2]) / robot.club.length_to_face
    nearest = np.clip(-(wrist * along).sum(axis=1), 0.0, robot.club.length_to_face)
    distance = np.linalg.norm(wrist + nearest[:, None] * along, axis=1)
    j = int(distance.argmin())
    if distance[j] < envelope.min_frame_distance:
        found, wanted = f"club {distance[j]:.3f} m from R1", f"at least {envelope.min_frame_distance:g} m"
        faults.append(plan.row(("angle_rad", j, None), found, wanted, "Keep the club off the frame."))
    found = f"ground {1e3 * height[k]:.0f} mm · frame {1e3 * distance[j]:.0f} mm"
    allowed = f"{1e3 * needed[k]:g} · {1e3 * envelope.min_frame_distance:g} mm"
    return Check("clearance", found, allowed, faults)


def _lever(plan: MachineSwing) -> Check:
    """Check that the wrist's cylinder has a lever (thesis figure 11)."""
    authority = plan.plant.wrist_authority(plan.profile.angle[:, 2])
    k, least, faults = int(authority.argmin()), plan.envelope.min_lever, []
    if authority[k] < least:
        action = "Fold the wrist less; envelope.min_lever is the limit."
        found = f"|sin beta| = {authority[k]:.3f}"
        faults.append(plan.row(("angle_rad", k, 2), found, f"at least {least:g}", action))
    return Check("wrist lever |sin beta|", f"{authority[k]:.2f}", f"at least {least:g}", faults)


def _valves(plan: MachineSwing) -> Check:
    """Compare the feed-forward with the envelope's limit."""
    opening, limit, faults = np.abs(plan.profile.valve), plan.envelope.max_opening, []
    k, joint = _peak(opening)
    if opening[k, joint] > limit:
        found, wanted = f"{opening[k, joint]:.3g}", f"at most {limit:g}, envelope.max_opening"
        faults.append(plan.row(("valve", k, joint), found, wanted, "Reduce the valve command."))
    return Check("valve openings", f"{opening.max():.2f}", f"at most {limit:g}", faults)


def _ball(plan: MachineSwing) -> Check:
    """Compare the position of the ball, and check that the head is there at the planned contact."""
    profile, site, faults = plan.profile, plan.plant.site, []
    x, y = profile.ball
    off = hypot(x - site.ball_x, y - site.ball_y)
    if off > BALL_TOLERANCE:
        found = f"({x:.4f}, {y:.4f}) m, {1e3 * off:.1f} mm off"
        wanted = f"({site.ball_x:.4f}, {site.ball_y:.4f}) m, {plan.tee}, within {1e3 * BALL_TOLERANCE:g} mm"
        action = "Move the tee to where the swing is aimed, then golfbench calibrate ball."
        faults.append(plan.key("ball_m", found, wanted, action))
    head = forward_kinematics(plan.plant.robot, profile.angle_at_impact)
    behind, above = x - float(head[0]), float(head[1]) - y
    far = abs(behind) > CONTACT_TOLERANCE[0] or abs(above) > CONTACT_TOLERANCE[1]
    if far and profile.club == plan.plant.robot.club.name:  # another club is a fault of its own
        found = f"the face {behind:.3f} m behind the ball and {above:.3f} m above it"
        wanted = "within {:g} and {:g} m".format(*CONTACT_TOLERANCE)
        action = "Compare the calibrations of club and ball with the machine; else correct impact_time_s."
        faults.append(plan.key("impact_time_s", found, wanted, action))
    found = f"tee {1e3 * off:.1f} mm off · face {1e3 * above:+.1f} mm in height"
    allowed = f"{1e3 * BALL_TOLERANCE:g} · {1e3 * CONTACT_TOLERANCE[1]:g} mm"
    return Check("ball", found, allowed, faults)


def _air(plan: MachineSwing) -> Check:
    """Compare the force that the motion needs with the force that valves and supply give at its speed."""
    plant, faults, shares = plan.plant, [], []
    need = needed_force(plan.motion)
    bounds = force_bounds(plan.motion)[:-1]
    excess = np.maximum(need - bounds[..., 1], bounds[..., 0] - need)
    # At the ball the speeds jump, which no actuator does.
    excess[_impact(plan)] = 0.0
    steady = _lasting(excess, EXCESS_TIME, plan.profile.period)
    for i, actuator in enumerate(plant.actuators):
        max_force = (plant.supply.pressure - plant.supply.atmosphere) * actuator.area_a
        k = int(steady[:, i].argmax())
        if steady[k, i] > EXCESS_SHARE * max_force:
            side = int(need[k, i] > bounds[k, i, 1])
            at = f"{plan.motion.speed[k, i]:.2f} {_SPEED[i]}"
            found = f"{need[k, i]:.0f} {_FORCE[i]} of air needed at {at}"
            limit = f"{('at least', 'at most')[side]} {bounds[k, i, side]:.0f} {_FORCE[i]}, the limit of"
            valve = f"{actuator.valve.conductance:g} m3/(s Pa) of the valve"
            wanted = f"{limit} {valve} at {plant.supply.pressure:g} Pa"
            action = f"Slow the swing, or fit a larger valve or actuator: plant.{ACTUATOR_KEYS[i]}."
            faults.append(plan.row(("velocity_rad_per_s", k, i), found, wanted, action))
        lever = plant.wrist_lever if i == 2 else 1.0
        shares.append(np.abs(plan.motion.speed[:, i]).max() * lever / steady_speed(actuator, plant.supply))
    found = " · ".join(f"{100 * share:.0f}" for share in shares) + " % of the valves' steady speed"
    return Check("air", found, "the force that valves and supply give", faults)


_CHECKS: tuple[Callable[[MachineSwing], Check], ...] = (
    _machine,
    _tables,
    _range,
    _speed,
    _clearance,
    _lever,
    _valves,
    _ball,
)


def needed_force(motion: Motion) -> Array:
    """Return the actuator forces (n - 1, 3) that the motion needs between samples: N m, N, N.

    Inverse dynamics of the robot, with viscous and dry friction, minus the forces of the end stops.
    """
    plant, profile = motion.plant, motion.profile
    angle, velocity = _middle(profile.angle), _middle(profile.velocity)
    acceleration = np.diff(profile.velocity, axis=0) / profile.period
    effort = np.asarray(inverse_dynamics(plant.robot, angle, velocity, acceleration))
    position, speed = _middle(motion.position), _middle(motion.speed)
    wrist_lever = plant.wrist_slope(angle[:, 2])
    force = np.empty_like(effort)
    for i, actuator in enumerate(plant.actuators):
        own = effort[:, i] - stop_forces(actuator, position[:, i], speed[:, i])
        stroke_speed = speed[:, i]
        if i == 2:
            own, stroke_speed = own / wrist_lever, wrist_lever * stroke_speed
        friction = actuator.friction
        dry = friction.coulomb * np.tanh(stroke_speed / friction.stribeck_speed)
        force[:, i] = own + friction.viscous * stroke_speed + dry
    return force


def _middle(values: Array) -> Array:
    return (values[1:] + values[:-1]) / 2


def stop_forces(actuator: Actuator, position: Array, speed: Array) -> Array:
    """Return the force (n,) of the end stops on the joint coordinate, positive upwards: N m, N, N m."""
    stop, force = actuator.stop, np.zeros(len(position))
    for sign, end in ((-1.0, actuator.upper), (1.0, actuator.lower)):
        depth = sign * (end - position)
        for k in np.flatnonzero(depth > 0):
            force[k] = sign * stop_force(
                stop.stiffness, stop.travel, stop.damping_speed, depth[k], -sign * speed[k]
            )
    return force


def force_bounds(motion: Motion) -> Array:
    """Return the min and max force (n, 3, 2) that any command can give along the motion: N m, N, N."""
    plant = motion.plant
    atmosphere = plant.supply.atmosphere
    bounds = np.empty((len(motion.position), 3, 2))
    for i, actuator in enumerate(plant.actuators):
        stroke, ends = motion.position[:, i], np.array(actuator.chamber_ends)
        if i == 2:
            stroke, ends = plant.wrist_stroke(stroke), plant.wrist_stroke(ends)
        volume_a = actuator.dead_volume + actuator.area_a * (stroke - ends[0])
        volume_b = actuator.dead_volume + actuator.area_b * (ends[1] - stroke)
        low_a, high_a = _extreme_pressures(volume_a, motion.profile.period, actuator, plant.supply)
        low_b, high_b = _extreme_pressures(volume_b, motion.profile.period, actuator, plant.supply)
        for side, (a, b) in enumerate(((low_a, high_b), (high_a, low_b))):
            bounds[:, i, side] = (a - atmosphere) * actuator.area_a - (b - atmosphere) * actuator.area_b
    return bounds


def _extreme_pressures(
    volume: Array, period: float, actuator: Actuator, supply: Supply
) -> tuple[Array, Array]:
    """Return the lowest and highest pressure (n,) Pa a chamber of `volume` (n,) m3 can have."""
    low, high = np.full(len(volume), supply.atmosphere), np.full(len(volume), supply.pressure)
    passage = actuator.valve.conductance + actuator.cross_leakage, actuator.valve.critical_ratio
    air = supply.pressure, supply.atmosphere, supply.polytropic_exponent
    _fill_and_empty(np.maximum(volume, 0.2 * actuator.dead_volume), period, *passage, *air, low, high)
    return low, np.minimum(high, actuator.pressure_rating)


@compiled
def _fill_and_empty(
    volume: Any,
    period: float,
    conductance: float,
    ratio: float,
    supply: float,
    atmosphere: float,
    exponent: float,
    low: Any,
    high: Any,
) -> None:
    """Write pressures of a chamber that only loses (`low`) and only takes (`high`) air, from the first on."""
    step = period / _SUBSTEPS
    for k in range(1, len(volume)):
        emptied, filled = low[k - 1], high[k - 1]
        swept = (volume[k] - volume[k - 1]) / period
        for j in range(_SUBSTEPS):
            gain = exponent * step / (volume[k - 1] + swept * step * (j + 0.5))
            # Implicit in the chamber's own pressure: stable for small chambers too.
            out = max(flow(conductance, emptied, atmosphere, ratio), 0.0)
            emptied /= 1.0 + gain * (swept + out / emptied)
            into = max(flow(conductance, supply, filled, ratio), 0.0)
            filled = (filled + gain * into) / (1.0 + gain * swept)
        low[k], high[k] = emptied, filled


@lru_cache(64)  # thousands of trials, and a plant is checked before each arming
def steady_speed(actuator: Actuator, supply: Supply) -> float:
    """Return the speed (m/s, vane rad/s) at which a fully open valve leaves the actuator no force.

    At rest in the actuator's frame the air that comes in is p A v, the air that leaves too. The faster
    direction counts. A swing may be faster for a short way, on air that is already in the chamber.
    """
    forwards = _steady(actuator, supply, actuator.area_a, actuator.area_b)
    return max(forwards, _steady(actuator, supply, actuator.area_b, actuator.area_a))


def _steady(actuator: Actuator, supply: Supply, driving: float, driven: float) -> float:
    c, ratio = actuator.valve.conductance, actuator.valve.critical_ratio

    def force(speed: float) -> float:
        p = falling_root(
            lambda p: flow(c, supply.pressure, p, ratio) - p * driving * speed, 1e3, supply.pressure
        )
        q = falling_root(
            lambda q: q * driven * speed - flow(c, q, supply.atmosphere, ratio), supply.atmosphere, 1e9
        )
        return (p - supply.atmosphere) * driving - (q - supply.atmosphere) * driven

    # The driven chamber cannot be emptied faster than at the speed of sound, whatever its pressure.
    sonic = c * FLOW_TO_PRESSURE / driven
    return falling_root(force, 1e-6 * sonic, sonic)
