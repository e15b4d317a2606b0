"""Refusals before any motion, and acceptance of a possible swing."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.control.settings import EnvelopeSettings
from bench.design.static_checks import (
    beyond_range,
    check_profile,
    force_bounds,
    needed_force,
    other_rate,
    profile_faults,
    require_possible,
    steady_speed,
    stop_forces,
)
from bench.swing.actuator_motion import Motion, phase_times
from bench.swing.profile import Profile
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.kinematics import theta2_from_right_arm
from sim.plant import PlantParameters, advance, build_plant, initial_state
from sim.robot import Club


def changed(profile: Profile, table: str, rows: slice | int, column: int, value: float) -> Profile:
    """Return `profile` with `value` added to a column of one of its tables."""
    array = getattr(profile, table).copy()
    array[rows, column] += value
    return replace(profile, **{table: array})


def faster(profile: Profile, factor: int) -> Profile:
    """Return the same path `factor` times as fast."""
    n = len(profile.angle) // factor
    return replace(
        profile,
        angle=profile.angle[::factor],
        velocity=factor * profile.velocity[::factor],
        valve=profile.valve[::factor],
        begins=(0, 1, 2, 3, n // 2 - 4, n // 2 - 3, n // 2 + 4),
        impact_time=profile.impact_time / factor,
    )


def test_check_profile_possible_swing_passes(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    checks = check_profile(slow_swing, plant, envelope)
    assert [str(fault) for check in checks for fault in check.faults] == []
    names = "made for", "tables agree", "end stops", "joint speeds", "clearance", "wrist lever |sin beta|"
    assert [check.name for check in checks] == [*names, "valve openings", "ball", "air"]
    require_possible(slow_swing, plant, envelope)


def test_other_rate_reports_profile_and_tick_periods(slow_swing: Profile, plant: PlantParameters) -> None:
    assert other_rate(slow_swing, plant) == ""
    note = other_rate(slow_swing, replace(plant, tick=0.00025))
    assert "a sample every 1 ms, the loop a tick every 0.25 ms" in note


def _machine(**changes: Any) -> Any:
    return lambda profile, plant: (profile, replace(plant, **changes))


def _profile(**changes: Any) -> Any:
    return lambda profile, plant: (replace(profile, **changes), plant)


def _table(table: str, rows: slice | int, column: int, value: float) -> Any:
    return lambda profile, plant: (changed(profile, table, rows, column, value), plant)


def _part(name: str, **changes: Any) -> Any:
    return lambda profile, plant: (
        profile,
        replace(plant, **{name: replace(getattr(plant, name), **changes)}),
    )


@pytest.mark.parametrize(
    ("change", "location", "found", "expected"),
    [
        (_profile(club="putter"), "club", '"putter"', '"driver"'),
        (_machine(tick=0.002), "period_s", "0.001 s", "0.002 s"),
        (_profile(limits={}), "limits.supply_pressure_pa", "not given", "8e+05 Pa"),
        (_profile(limits={"supply_pressure_pa": 7e5}), "limits.supply_pressure_pa", "7e+05 Pa", "8e+05 Pa"),
        (_table("velocity", slice(500, 600), 1, 3.0), "velocity_rad_per_s[500][1] (0.5", "3.000", "slope"),
        (_table("angle", slice(500, None), 0, 0.2), "angle_rad[499][0]", "a step no", "at most 0.05 rad"),
        (_table("velocity", slice(None), 2, 0.2), "velocity_rad_per_s[0][2]", "0.200 rad/s", "0.1 rad/s"),
        (_part("shoulder", upper=0.3), "angle_rad[1999][0]", "hits an end stop", "plant.shoulder"),
        (_part("right_arm", upper=0.15), "angle_rad[0][1]", "m: the swing hits", "to 0.1625 m"),
        (_part("wrist", lower=6.9, upper=7.0), "angle_rad[0][2]", "hits an end stop", "plant.wrist"),
        (_part("site", ground=-1.59), "angle_rad[", "over ground", "at least 5 mm"),
        (_table("valve", 77, 1, 1.5), "valve[77][1] (0.077 s, arm)", "1.5", "at most 1, envelope"),
        (_part("site", ball_x=0.26), "ball_m", "10.0 mm off", "plant.site"),
        (_profile(impact_time=0.5), "impact_time_s", "behind the ball", "within 0.08 and 0.02 m"),
    ],
)
def test_profile_faults_names_each_reason(
    change: Any,
    location: str,
    found: str,
    expected: str,
    slow_swing: Profile,
    plant: PlantParameters,
    envelope: EnvelopeSettings,
) -> None:
    profile, machine = change(slow_swing, plant)
    faults = profile_faults(profile, machine, envelope, "slow.toml")
    texts = [str(fault) for fault in faults]
    fault = next((fault for fault in faults if fault.location.startswith(f"slow.toml: {location}")), None)
    assert fault is not None, texts
    assert found in fault.found
    assert expected in fault.expected
    assert fault.action


def test_profile_faults_other_club_hides_missed_ball(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    missed = replace(slow_swing, club="putter", impact_time=0.5)
    faults = profile_faults(missed, plant, envelope, "slow.toml")
    assert not any("impact_time_s" in fault.location for fault in faults)
    assert any("golfbench profile list" in fault.action for fault in faults)


@pytest.mark.parametrize(
    ("limits", "location", "expected"),
    [
        ({"max_speed": (0.1, 6.0, 48.0)}, "velocity_rad_per_s[1000][0]", "at most 0.1 rad/s"),
        ({"min_frame_distance": 1.0}, "angle_rad[", "at least 1 m"),
        ({"min_lever": 1.0}, "angle_rad[0][2]", "at least 1"),
        ({"ball_window": 0.01, "clearance": 0.1}, "angle_rad[", "at least 100 mm"),
    ],
)
def test_profile_faults_reports_exceeded_envelope_limit(
    limits: dict[str, Any], location: str, expected: str, slow_swing: Profile, plant: PlantParameters
) -> None:
    (fault,) = profile_faults(slow_swing, plant, EnvelopeSettings(**limits))
    assert fault.location.startswith(f"slow: {location}")
    assert expected in fault.expected


def test_require_possible_raises_all_faults_together(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    with pytest.raises(ExceptionGroup) as raised:
        require_possible(replace(slow_swing, club="x", limits={}), plant, envelope, "slow.toml")
    assert all(isinstance(fault, BenchError) for fault in raised.value.exceptions)
    assert len(raised.value.exceptions) == 2


def test_beyond_range_names_joint_and_time(slow_swing: Profile, plant: PlantParameters) -> None:
    envelope = EnvelopeSettings()
    assert beyond_range(slow_swing, plant, envelope) == ""
    found = beyond_range(changed(slow_swing, "angle", 40, 2, 3.0), plant, envelope)
    assert "wrist" in found
    assert f"{40 * slow_swing.period:.3f} s" in found


def test_profile_faults_excess_end_stop_energy_reported(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    fast = faster(slow_swing, 20)
    middle = float(fast.angle[:, 0].mean())
    stop = replace(plant.shoulder.stop, energy=0.1, travel=0.3)
    weak = replace(plant.shoulder, upper=middle + 0.05, stop=stop)
    faults = profile_faults(fast, replace(plant, shoulder=weak), envelope)
    assert any(" J into an end stop" in fault.found for fault in faults)


# Air -------------------------------------------------------------------------------------------------


def test_profile_faults_excess_air_demand_names_actuator(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    faults = profile_faults(faster(slow_swing, 40), plant, envelope)
    shoulder = next(fault for fault in faults if "shoulder" in fault.location)
    assert "N m of air needed at" in shoulder.found
    assert "7.9e-08 m3/(s Pa)" in shoulder.expected
    assert "plant.shoulder" in shoulder.action


def test_profile_faults_undersized_valve_names_actuator(
    slow_swing: Profile, plant: PlantParameters, envelope: EnvelopeSettings
) -> None:
    n = 300  # the rod goes out from 20 to 200 mm in 0.3 s: nine times the chamber's volume
    part = np.arange(n) / n
    rod = 0.02 + 0.18 * part**3 * (10 - 15 * part + 6 * part**2)
    angle = slow_swing.angle[:n].copy()
    angle[:, 0] = slow_swing.angle[0, 0]
    angle[:, 1] = theta2_from_right_arm(plant.robot, plant.robot.l56 + rod)
    velocity = np.gradient(angle, plant.tick, axis=0)
    reach = replace(
        slow_swing, angle=angle, velocity=velocity, valve=slow_swing.valve[:n], begins=(0, 1, 2, 3, 4, 5, 6)
    )

    def air_faults(conductance: float) -> list[BenchError]:
        valve = replace(plant.right_arm.valve, conductance=conductance)
        machine = replace(plant, right_arm=replace(plant.right_arm, valve=valve))
        return [fault for fault in profile_faults(reach, machine, envelope) if "of air needed" in fault.found]

    assert air_faults(plant.right_arm.valve.conductance) == []
    (fault,) = air_faults(1e-9)
    assert "arm" in fault.location
    assert "plant.right_arm" in fault.action


@pytest.fixture(scope="module")
def free_play(plant: PlantParameters) -> tuple[Motion, np.ndarray]:
    """Motion and actuator forces of the plant under random openings, 0.25 s."""
    built = build_plant(replace(plant, robot=replace(plant.robot, club=Club.driver())))
    state, command = initial_state(built, np.array([0.3, 3.9, 5.4]), pressurised=True), new_record(COMMAND)
    command["supply_enable"] = command["exhaust_closed"] = command["guard_lock"] = True
    random = np.random.default_rng(5)
    n = 250
    angle, velocity, force = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n):
        if k % 25 == 0:
            command["valve"] = random.uniform(-1, 1, 3)
        angle[k], velocity[k] = state["angle"][0], state["speed"][0]
        pressure = state["pressure"][0] - plant.supply.atmosphere
        for i, actuator in enumerate(plant.actuators):
            force[k, i] = pressure[2 * i] * actuator.area_a - pressure[2 * i + 1] * actuator.area_b
        advance(*built.records, state, command)
    begins = (0, 1, 2, 3, 4, 5, 6)
    blind, ball = np.zeros((1, 6)), (0.25, -1.56)
    profile = Profile(
        "free", "", "", "driver", plant.tick, begins, angle, velocity, 0 * angle, n, blind, ball, 0.1
    )
    return Motion(profile, plant), force


def test_force_bounds_contain_plant_forces(free_play: tuple[Motion, np.ndarray]) -> None:
    motion, force = free_play
    bounds = force_bounds(motion)
    assert np.abs(motion.profile.velocity).max() > 5.0
    assert np.all(force <= bounds[..., 1] + 1e-6 * np.abs(force))
    assert np.all(force >= bounds[..., 0] - 1e-6 * np.abs(force))
    # And they say more than the supply's full force does where a chamber changes its volume.
    full = 2 * 7e5 * np.array([actuator.area_a for actuator in motion.plant.actuators])
    width = (bounds[..., 1] - bounds[..., 0]).min(axis=0)
    assert np.all(width[1:] < 0.95 * full[1:])


def test_needed_force_matches_plant_force(free_play: tuple[Motion, np.ndarray]) -> None:
    motion, force = free_play
    middle = (force[1:] + force[:-1]) / 2
    moving = np.abs(motion.speed[1:]) > 0.3
    full = 7e5 * np.array([actuator.area_a for actuator in motion.plant.actuators])
    error = np.abs(needed_force(motion) - middle) / full
    assert np.median(error[moving]) < 0.02


def test_steady_speed_scales_with_conductance_over_area(plant: PlantParameters) -> None:
    vane, supply = plant.shoulder, plant.supply
    speed = steady_speed(vane, supply)
    # Far down the line the exhaust is sonic: C rho0 R T0 / D.
    assert speed == pytest.approx(7.9e-8 * 1.185 * 287.05 * 293.15 / 4e-4, rel=1e-3)
    wide = replace(vane, valve=replace(vane.valve, conductance=2 * vane.valve.conductance))
    assert steady_speed(wide, supply) == pytest.approx(2 * speed, rel=1e-6)
    large = replace(vane, area_a=2 * vane.area_a, area_b=2 * vane.area_b)
    assert steady_speed(large, supply) == pytest.approx(speed / 2, rel=1e-6)


def test_stop_forces_act_inwards_beyond_end_stops_only(plant: PlantParameters) -> None:
    vane = plant.shoulder
    position = np.array([vane.lower - 0.05, vane.lower, 0.0, vane.upper, vane.upper + 0.05])
    force = stop_forces(vane, position, np.zeros(5))
    assert force == pytest.approx(vane.stop.stiffness * 0.05 * np.array([1, 0, 0, 0, -1]))


# Motion ----------------------------------------------------------------------------------------------


def test_motion_speeds_match_actuator_positions(slow_swing: Profile, plant: PlantParameters) -> None:
    motion = Motion(slow_swing, plant)
    rate = np.gradient(motion.position, slow_swing.period, axis=0)
    np.testing.assert_allclose(rate[5:-5], motion.speed[5:-5], atol=1e-4)
    radius = np.hypot(plant.site.ball_x - plant.ball.radius, plant.site.ball_y)
    np.testing.assert_allclose(motion.head_speed, radius * slow_swing.velocity[:, 0], atol=1e-12)


def test_phase_times_cover_swing(slow_swing: Profile) -> None:
    times = phase_times(slow_swing)
    assert times[0][:2] == (Phase.HOLD, 0.0)
    assert times[-1][2] == pytest.approx(slow_swing.duration)
    assert all(end == begin for (_, _, end), (_, begin, _) in pairwise(times))
