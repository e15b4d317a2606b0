"""Feed-forward by the model: forces demanded, valves inverted, chambers observed; off, nothing of it acts."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.lifecycle import Cause, Phase
from bench.config import load_configuration, shipped_configuration
from bench.control.estimate.air import actuator_force
from bench.control.law.feed_forward import FeedForward, force_rates, opening_for
from bench.control.law.force_reference import actuator_forces, demand_of
from bench.control.settings import ControlSettings
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import WORN
from bench.simulation.simulated_bench import Bench, Series
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.dynamics import chambers
from sim.kane import inverse_dynamics
from sim.plant import PlantParameters, build_plant
from tests.bench.control.puppet import ADDRESS, SAMPLES, STILL, Puppet
from tests.compiled_only import needs_speed

Array = np.ndarray[Any, Any]

PLANT = PlantParameters()
MACHINE = build_plant(PLANT).plant


def plant_force_rate(i: int, pressure: Array, opening: float, position: float, speed: float) -> float:
    """Return the plant's own force rate of actuator `i` with its spool at `opening`."""
    rate = np.zeros(13)
    chambers(MACHINE[0], i, pressure, rate, opening, position, speed, 0.0)
    p = MACHINE[0]
    return float(rate[6 + 2 * i] * p["area_a"][i] - rate[7 + 2 * i] * p["area_b"][i])


bars = st.floats(1.1e5, 7.9e5)


@given(
    i=st.integers(0, 2),
    pa=bars,
    pb=bars,
    share=st.floats(0.02, 0.98),
    side=st.sampled_from([-1.0, 1.0]),
    part=st.floats(0.1, 0.9),
    speed=st.floats(-1.0, 1.0),
)
def test_opening_for_gives_wanted_force_rate(
    i: int, pa: float, pb: float, share: float, side: float, part: float, speed: float
) -> None:
    p, pressure = MACHINE[0], np.zeros(13)
    pressure[6 + 2 * i], pressure[7 + 2 * i], pressure[12] = pa, pb, 8e5
    low, high = p["volume_lower"][i], p["volume_upper"][i]
    position = low + part * (high - low)
    rates = force_rates(p, i, pressure, position, speed)
    assert rates[0] == pytest.approx(plant_force_rate(i, pressure, 0.0, position, speed), rel=1e-9)
    wanted = rates[0] + share * (rates[1] if side > 0 else -rates[2]) * side
    opening = opening_for(p, i, rates, wanted)
    assert opening * side > 0
    assert plant_force_rate(i, pressure, opening, position, speed) == pytest.approx(wanted, rel=1e-6)
    assert opening_for(p, i, rates, wanted + side * 1e7) == side
    assert abs(opening_for(p, i, rates, rates[0])) < 1e-9


def swung(period: float = 1e-3) -> tuple[Profile, Array, Array]:
    """Return a smooth swing with its velocities and accelerations."""
    time = np.arange(SAMPLES)[:, None] * period
    rate, size = 2 * pi / 0.5, np.array([-0.3, 0.05, -0.2])
    angle = ADDRESS + size * (1 - np.cos(rate * time)) / 2
    velocity, acceleration = size * rate / 2 * np.sin(rate * time), size * rate**2 / 2 * np.cos(rate * time)
    return replace(STILL, angle=angle, velocity=velocity), velocity, acceleration


def test_demand_of_leads_inverse_dynamics_by_spool_lag() -> None:
    profile, velocity, acceleration = swung()
    demand = demand_of(PLANT, profile)
    exact = actuator_forces(PLANT, profile.angle, velocity, acceleration)
    lag = 2 * 0.8 / (2 * pi * 100.0) + 0.0005
    at = np.arange(SAMPLES) * 1e-3
    for rows in (slice(20, 270), slice(310, 470)):  # not across the ends of the smoothed parts
        for i in range(3):
            early = np.interp(at + lag, at, exact[:, i])[rows]
            # Friction that changes sides is smoothed, too.
            assert np.median(np.abs(demand.force[rows, i] - early)) < 0.01 * np.ptp(exact[:, i])
            rate = np.gradient(np.interp(at + lag, at, exact[:, i]), 1e-3)[rows]
            assert np.median(np.abs(demand.rate[rows, i] - rate)) < 0.05 * np.ptp(rate)
    assert np.ptp(demand.force[510:], axis=0).max() == 0.0  # the impact's forces are not the actuators'
    assert not demand.rate[510:].any()


def test_actuator_forces_include_levers_and_friction() -> None:
    angle = np.array([[0.3, 4.2, 5.6]])
    still = np.zeros((1, 3))
    force = actuator_forces(PLANT, angle, still, still)[0]
    torque = inverse_dynamics(PLANT.robot, angle[0], still[0], still[0])
    assert force == pytest.approx([torque[0], torque[1], torque[2] / (0.06 * np.cos(5.6))])
    fast = np.array([[2.0, 0.0, 0.0]])
    more = actuator_forces(PLANT, angle, fast, still)[0, 0]
    less = actuator_forces(PLANT, angle, -fast, still)[0, 0]
    assert more - less == pytest.approx(2 * (6.0 + 0.3 * 2.0))


def test_observer_starts_only_with_pneumatic_feed_forward() -> None:
    puppet = Puppet().swing(50)
    assert not puppet.state.air["started"][0]
    puppet = Puppet(control=QUICK_PNEUMATIC).swing(50)
    assert puppet.state.air["started"][0]


QUICK_PNEUMATIC = ControlSettings(
    precharge_time=0.02, move_timeout=0.2, open_loop_settling_time=0.1, feed_forward="kane+pneumatic"
)


def test_feed_forward_without_pressures_stays_finite() -> None:
    puppet = Puppet(swung()[0], QUICK_PNEUMATIC).swing(150)
    openings = puppet.run(100)
    assert np.isfinite(openings).all()
    assert np.abs(openings).max() <= 1.0
    assert np.abs(puppet.control["feed_forward"]).max() > 0.01
    assert puppet.cause is Cause.NONE
    puppet.give(supply_pressure=np.nan)
    assert np.isfinite(puppet.run(20)).all()


def test_observer_stall_keeps_pressures_finite() -> None:
    puppet = Puppet(control=QUICK_PNEUMATIC).hold()
    puppet.time += 3.0
    puppet.run(3)
    assert np.isfinite(puppet.state.air["pressure"][0]).all()
    # The manifold stays full: chambers behind an empty one would leak into it.
    puppet.give(chamber_pressure=5e5, supply_pressure=8e5).run(100)
    assert puppet.state.air["pressure"][0, 6:12] == pytest.approx(5e5, rel=0.01)


# Whole swings -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shipped() -> Bench:
    """Return the shipped configuration with its swing."""
    c = load_configuration(shipped_configuration())
    return Bench(load_profile(find_profile(c.swing.profile)), c.plant, c.control)


def bench_with(bench: Bench, feed_forward: FeedForward) -> Bench:
    return replace(bench, control=replace(bench.control, feed_forward=feed_forward))


def rms(cycles: Array, first: int, last: int) -> Array:
    """Return the following error (3,) rad of a part of a swing."""
    rows = cycles[first:last]
    return np.asarray(np.sqrt(np.mean((rows["reference_angle"] - rows["plant_angle"]) ** 2, axis=0)))


@needs_speed
def test_pneumatic_feed_forward_without_sensors_halves_following_error(shipped: Bench) -> None:
    blind = replace(shipped.plant, pressure_sensors=False)
    begins, errors = shipped.profile.begins, {}
    for feed_forward in ("none", "kane+pneumatic"):
        swing = Series(bench_with(shipped, feed_forward), blind).swing(shipped.profile)
        assert np.isnan(swing.cycles["chamber_pressure"]).all()
        errors[feed_forward] = rms(swing.cycles, begins[1], begins[4])
    assert (errors["kane+pneumatic"] < 0.05).all()
    assert errors["kane+pneumatic"].max() < 0.5 * errors["none"].max()


@needs_speed
@pytest.mark.parametrize("worn", [False, True], ids=["nominal", "worn"])
def test_observer_force_error_is_small(shipped: Bench, worn: bool) -> None:
    plant = replace(shipped.plant, pressure_sensors=False)
    plant = WORN.applied_to(plant) if worn else plant
    bench = bench_with(shipped, "kane+pneumatic")
    stepper = Lockstep(build_plant(plant), bench.series_controller(), bench.profile.angle[0])
    engine = LockstepEngine(stepper)
    assert engine.arm()
    assert engine.start_swing(attempts=1, wait=1)
    off, size = [], []
    for _ in range(bench.profile.begins[5] - 1):
        stepper.advance(1)
        if stepper.state.control["phase"][0] in (Phase.DOWNSWING, Phase.COMMITTED):
            air = stepper.state.air["pressure"][0].copy()
            truth = np.concatenate([np.zeros(6), stepper.plant_state["pressure"][0], [0.0]])
            told, true = ([actuator_force(MACHINE[0], p, i) for i in range(3)] for p in (air, truth))
            off.append(np.subtract(told, true))
            size.append(true)
    share = np.sqrt(np.mean(np.square(off), axis=0)) / np.sqrt(np.mean(np.square(size), axis=0))
    assert share.max() < (0.35 if worn else 0.15)
