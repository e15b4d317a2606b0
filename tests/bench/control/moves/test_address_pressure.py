"""Pressures at the address: planned as the dither's equilibrium, regulated, awaited, reported on failure."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Refusal, Request, State
from bench.control.estimate.air import load_force
from bench.control.law.force_reference import actuator_forces
from bench.control.law.gain_table import DAMPING
from bench.control.moves.address_pressure import LATE, SLIPPED
from bench.control.moves.pressure_plan import dither_amplitudes, dither_periods, planned_air, with_planned_air
from bench.control.settings import SIMULATED, build_controller
from bench.control.step_records import ADDRESS_AIR
from bench.simulation.lockstep import Lockstep
from bench.simulation.plant_variation import WORN, healthy_plant
from bench.simulation.simulated_bench import Bench, Series, quiet
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import flow
from tests.bench.commissioning.drawn_robots import drawn_robot
from tests.bench.control.puppet import QUICK, STILL, Puppet
from tests.compiled_only import needs_speed
from tests.sampling import release_except

Array = np.ndarray[Any, Any]

PLANT = PlantParameters()
NEAR_GROUND = replace(PLANT, site=replace(PLANT.site, ground=-1.62))
"""The robot on ground to which its club hangs down."""
PLANNED = replace(STILL, air=(5.9e5,) * 6, air_supply=8e5)
TOLERANCE = SIMULATED.pressure_tolerance
LOOKED_AT = 1.02 * TOLERANCE
"""Pa, where the engine looks every ten ticks only: chambers leak."""


@pytest.fixture(scope="module")
def profile() -> Profile:
    return with_planned_air(load_profile(find_profile("default")), PLANT)


def bench_on(
    profile: Profile,
    plant: PlantParameters = PLANT,
    angle: Array | None = None,
    model: PlantParameters = PLANT,
) -> LockstepEngine:
    """Return a bench that believes in `model` and stands vented at `angle`, by default hanging."""
    start = hanging_pose(plant) if angle is None else angle
    bench = LockstepEngine(Lockstep(build_plant(plant), build_controller(model, profile), start))
    bench.advance(200)
    return bench


@pytest.fixture(scope="module")
def armed(profile: Profile) -> LockstepEngine:
    """Return a bench, to be copied, that holds its address."""
    bench = bench_on(profile)
    bench.arm()
    return bench


def deviation(bench: LockstepEngine, profile: Profile) -> Array:
    """Return the errors of the true chambers (6,) from the planned ones, Pa."""
    state = bench.plant_state[0]
    return np.asarray(
        state["pressure"] - np.array(profile.air) * state["supply_pressure"] / profile.air_supply
    )


# What is planned --------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.1])
def test_planned_air_balances_load_and_flow(factor: float, profile: Profile) -> None:
    plant = replace(PLANT, supply=replace(PLANT.supply, pressure=factor * PLANT.supply.pressure))
    planned, rest = planned_air(plant, profile.angle[0]), np.zeros((1, 3))
    load = actuator_forces(plant, profile.angle[:1], rest, rest)[0]
    for i, actuator in enumerate(plant.actuators):
        a, b = planned[2 * i : 2 * i + 2]
        atmosphere = plant.supply.atmosphere
        force = (a - atmosphere) * actuator.area_a - (b - atmosphere) * actuator.area_b
        assert force == pytest.approx(load[i], abs=0.1)
        # Filled for the same shares of the time, neither chamber changes.
        valve, supply = actuator.valve, plant.supply.pressure

        def share(pressure: float, valve: Any = valve, supply: float = supply) -> float:
            into = flow(valve.conductance, supply, pressure, valve.critical_ratio)
            out = flow(valve.conductance, pressure, PLANT.supply.atmosphere, valve.critical_ratio)
            return out / (into + out)

        assert share(a) + share(b) == pytest.approx(1.0, abs=1e-6)


def test_load_force_equals_actuator_forces_at_rest(profile: Profile) -> None:
    rest = np.zeros((1, 3))
    load = actuator_forces(PLANT, profile.angle[:1], rest, rest)[0]
    machine = build_plant(PLANT).plant
    for i in range(3):
        force, _ = load_force(PLANT.robot.record, machine[0], profile.angle[0], i)
        assert force == pytest.approx(load[i])


def test_planned_air_load_beyond_supply_raises(profile: Profile) -> None:
    heavy = replace(PLANT, robot=replace(PLANT.robot, club=replace(PLANT.robot.club, head_mass=300.0)))
    with pytest.raises(ValueError, match="cannot hold"):
        planned_air(heavy, profile.angle[0])


def test_dither_amplitudes_exceed_dead_band(profile: Profile) -> None:
    widths = dither_amplitudes(PLANT, build_plant(PLANT).plant, profile.angle[0])
    assert np.all(widths > [actuator.valve.dead_band for actuator in PLANT.actuators])
    assert np.all(widths <= 0.4)
    assert widths[0] > 2.0 * widths[2]  # the vane's chambers are the largest


# How it is brought ------------------------------------------------------------------------------------


@needs_speed
@pytest.mark.parametrize(
    "plant",
    [PLANT, replace(PLANT, pressure_sensors=False), WORN.applied_to(PLANT)],
    ids=["sensors", "observer", "worn"],
)
def test_address_pressure_swing_refused_until_chambers_reach_plan(
    plant: PlantParameters, profile: Profile
) -> None:
    bench = bench_on(profile, plant)
    bench.arm()
    assert not bench.request(Request.SWING)
    assert bench.control["refusal"][0] == Refusal.AIR
    assert bench.await_air()
    slack = 1.0 if plant.pressure_sensors else 2.0
    assert np.abs(deviation(bench, profile)).max() < slack * LOOKED_AT
    assert np.all(bench.stepper.state.pid["integral"][0] == 0.0)
    assert np.abs(bench.control["desired"][0]).max() < 0.02  # all spools rest
    assert np.all(np.abs(bench.plant_state["speed"][0]) < 1e-3)
    assert bench.request(Request.SWING)
    bench.advance(1)
    assert bench.control["state"][0] == State.SWINGING
    assert not bench.control["address_air"]["ready"][0]


@needs_speed
@pytest.mark.parametrize("chamber", range(6))
@pytest.mark.parametrize("change", [-0.5e5, 0.5e5])
def test_address_pressure_disturbed_chamber_returns_to_plan(
    profile: Profile, armed: LockstepEngine, chamber: int, change: float
) -> None:
    bench = armed.copy()
    bench.advance(1000)
    bench.plant_state["pressure"][0, chamber] += change
    bench.advance(20)
    assert bench.await_air()
    assert np.abs(deviation(bench, profile)).max() < LOOKED_AT


@needs_speed
def test_address_pressure_minute_of_hold_stays_in_tolerance(profile: Profile, armed: LockstepEngine) -> None:
    bench = armed.copy()
    assert bench.await_air()
    worst = 0.0
    for _ in range(600):
        bench.advance(100)
        worst = max(worst, float(np.abs(deviation(bench, profile)).max()))
    assert bench.cause is Cause.NONE
    assert bench.phase is Phase.HOLD
    assert worst < 3.0 * TOLERANCE
    assert bench.await_air()
    assert np.abs(deviation(bench, profile)).max() < LOOKED_AT


@needs_speed
def test_start_swing_waits_for_planned_air(armed: LockstepEngine) -> None:
    bench = armed.copy()
    assert bench.start_swing(1, 10)


@needs_speed
def test_precharge_near_ground_keeps_head_height(profile: Profile) -> None:
    low = np.array([-0.012, 4.404, 6.271])
    bench = bench_on(profile, NEAR_GROUND, low, NEAR_GROUND)
    height = float(bench.control["head"][0, 1])
    bench.request(Request.ARM)
    lowest = height
    while bench.control["time"][0] < bench.control["move"]["start"][0]:
        bench.advance(20)
        lowest = min(lowest, float(bench.control["head"][0, 1]))
    assert height - lowest < 0.002
    assert bench.run_until(bench.holding, 10.0)


@needs_speed
@pytest.mark.parametrize("shoulder", [0.107, 0.208])
def test_arming_low_head_raises_clearance(profile: Profile, shoulder: float) -> None:
    low = np.array([shoulder, 4.404, 6.275])
    bench = bench_on(profile, NEAR_GROUND, low, NEAR_GROUND)
    bench.reset_peaks()
    bench.advance(1)
    clearance = bench.loads().lowest_clearance
    bench.arm()
    assert bench.cause is Cause.NONE
    assert bench.control["clearance_relief"][0] == 0.0
    assert bench.loads().lowest_clearance > clearance - 0.001


@needs_speed
def test_arming_low_head_pushed_down_reports_ground(profile: Profile) -> None:
    bench = bench_on(profile, NEAR_GROUND, np.array([0.107, 4.404, 6.275]), NEAR_GROUND)
    bench.request(Request.ARM)
    bench.advance(1000)
    assert not bench.control["cause"][0]
    for _ in range(15):  # as if something pushed it down
        bench.plant_state["angle"][0, 0] += 2e-3
        bench.advance(1)
    assert bench.cause is Cause.GROUND


# What comes of it when it fails -----------------------------------------------------------------------


@needs_speed
@pytest.mark.parametrize("chamber", range(6))
def test_pressure_timeout_names_chamber(profile: Profile, chamber: int) -> None:
    air = list(profile.air)
    air[chamber] -= 1.0e5  # no spool that swings leads there
    bench = bench_on(replace(profile, air=tuple(air)))
    bench.stepper.parameters.control["pressure_timeout"] = 2.0
    bench.arm()
    assert not bench.await_air()
    assert bench.cause in (
        Cause.SHOULDER_A_AIR + 2 * (chamber // 2),
        Cause.SHOULDER_B_AIR + 2 * (chamber // 2),
    )
    assert bench.phase is not Phase.HOLD


def test_pressure_timeout_unsettled_joint_reports_address_timeout() -> None:
    puppet = Puppet(replace(STILL, air=(1.0132e5,) * 6, air_supply=8e5))
    puppet.hold()
    puppet.parameters.control["pressure_timeout"] = 0.05
    puppet.parameters.control["pressure_tolerance"] = 1e6
    puppet.parameters.control["address_deadband"] = 0.0
    puppet.parameters.control["address_tolerance"] = 1.0
    puppet.follows = False
    puppet.give(**{"address_air.held": 0})
    puppet.offset[:] = 1e-3
    puppet.run(100)
    assert puppet.cause is Cause.ADDRESS_TIMEOUT


@pytest.mark.parametrize(
    ("miss", "planned", "phase"),
    [(0.04, True, Phase.HOLD), (0.1, True, Phase.RETURN), (0.04, False, Phase.RETURN)],
    ids=["near", "too far for the hold", "air as it comes"],
)
def test_return_joint_hunting_near_address_enters_hold(miss: float, planned: bool, phase: Phase) -> None:
    """A wrist with little area for its friction never came back to its address after a swing.

    Its PID alone took it from one side to the other.
    """
    patient = replace(QUICK, move_timeout=6.0)
    puppet = Puppet(PLANNED if planned else STILL, patient).enter(Phase.RETURN)
    puppet.shift(2, miss)
    puppet.run(1000)
    assert puppet.phase is Phase.RETURN
    puppet.run(1500)
    assert (puppet.phase, puppet.cause) == (phase, Cause.NONE)
    late = [bool(held & LATE) for held in puppet.control["address_air"]["held"]]
    assert late == [False, False, phase is Phase.HOLD]


@pytest.mark.parametrize(("waited", "forgotten"), [(1000, False), (2500, True)])
def test_return_slip_after_move_end_clears_integral(waited: int, forgotten: bool) -> None:
    """A shoulder slipped 0.1 rad to either side of its address, beyond the hold's limit, until timeout."""
    patient = replace(QUICK, move_timeout=6.0)
    puppet = Puppet(PLANNED, patient).enter(Phase.RETURN)
    puppet.shift(0, -0.1)
    puppet.run(waited)
    wound = puppet.state.pid[0]["integral"][0]
    assert abs(wound) > 0.01
    puppet.follows = False
    for _ in range(40):
        puppet.offset[0] += 0.0005
        puppet.tick()
    left = puppet.state.pid[0]["integral"][0]
    assert abs(left) < 0.01 * abs(wound) if forgotten else abs(left) >= abs(wound)


@pytest.mark.parametrize("planned", [True, False])
def test_feed_forward_planned_air_omits_dead_band_opening(*, planned: bool) -> None:
    """Dither and dead-band compensation together drove a soft shoulder past its return's limit."""
    puppet = Puppet(PLANNED if planned else STILL).enter(Phase.RETURN)
    control, parameters = puppet.control, puppet.parameters.control[0]
    parameters["move_band"] = 0.02  # which the machine's gains have
    control["move"]["origin"][:] = puppet.parameters.angle[0] - 0.2
    control["move"]["start"], control["move"]["duration"] = puppet.time, 2.0
    puppet.follows = False
    puppet.run(900)
    assert puppet.phase is Phase.RETURN
    ahead = control["move"]["gain"] * control["reference_velocity"]
    damping = puppet.state.pid[0]["gains"][DAMPING] * control["reference_acceleration"]
    band = np.zeros(3) if planned else parameters["move_band"]
    assert np.all(parameters["move_band"] > 0.0)
    assert control["feed_forward"] - ahead - damping == pytest.approx(band, rel=0.1, abs=1e-4)


@pytest.mark.slow
@needs_speed
@pytest.mark.parametrize("seed", release_except({1000002}, [1000001, 1000002, 1000003, 1000006]))
def test_arming_soft_shoulder_reaches_address(seed: int) -> None:
    """A small vane with low pressure and large dead bands slipped to and fro by 0.1 rad until its timeout.

    Its large dither moved the force by 15 N m, which a PID as soft as its air could not compensate.
    """
    known = drawn_robot(429, PLANT)
    profile = with_planned_air(load_profile(find_profile("default")), known)
    bench = bench_on(profile, healthy_plant(known, seed), model=known)
    bench.arm()
    bench.await_air()


@pytest.mark.parametrize(("waited", "caught"), [(50, False), (700, True)])
def test_hold_joint_slipping_through_band_marks_slipped(waited: int, caught: bool) -> None:
    """A shoulder slipped to and fro by 0.03 rad, until it touched the ball; not while it arrives."""
    puppet = Puppet(PLANNED).hold()
    puppet.follows = False
    puppet.shift(0, -0.02)
    puppet.run(waited)
    assert puppet.control["address_air"]["held"][0] == 0
    for _ in range(150):
        puppet.offset[0] += 0.0002
        puppet.tick()
    assert bool(puppet.control["address_air"]["held"][0] & SLIPPED) is caught
    assert not any(held & LATE for held in puppet.control["address_air"]["held"])


def test_address_pressure_without_planned_air_stays_idle() -> None:
    puppet = Puppet().hold()
    for name in ADDRESS_AIR.names or ():
        assert not np.any(puppet.control["address_air"][name]), name
    assert not puppet.state.air["started"][0]
    puppet.tick(Request.SWING)
    assert puppet.bench is State.SWINGING


@pytest.mark.parametrize("spoilt", ["pressures", "supply"])
def test_address_pressure_nan_readings_keep_openings_bounded(spoilt: str) -> None:
    puppet = Puppet(PLANNED).hold()
    if spoilt == "supply":
        puppet.give(supply_pressure=np.nan)
    else:
        puppet.state.air["pressure"] = np.nan
    openings = puppet.run(50)
    assert np.all(np.isfinite(openings))
    assert np.abs(openings).max() < 0.5
    assert puppet.tick(Request.SWING) != 1 or spoilt == "supply"


# Other machines ---------------------------------------------------------------------------------------


def machine(profile: Profile, **valve: float) -> tuple[PlantParameters, Profile]:
    """Return PLANT with other valves and the profile with the air planned for it."""

    def other(i: int) -> Any:
        actuator = PLANT.actuators[i]
        side = (1.0, -1.0, 1.0)[i]
        changed = {key: side * value if key == "centre" else value for key, value in valve.items()}
        return replace(actuator, valve=replace(actuator.valve, **changed))

    plant = replace(PLANT, shoulder=other(0), right_arm=other(1), wrist=other(2))
    return plant, with_planned_air(profile, plant)


@needs_speed
@pytest.mark.parametrize(
    "valve",
    [
        {"centre": 0.03},
        pytest.param({"centre": -0.03, "dead_band": 0.01}, marks=pytest.mark.release),
        pytest.param({"natural_frequency": 2.0 * np.pi * 60.0, "dead_band": 0.05}, marks=pytest.mark.release),
        pytest.param({"leakage": 0.005, "natural_frequency": 2.0 * np.pi * 150.0}, marks=pytest.mark.release),
    ],
    ids=["off centre", "off centre, hardly a dead band", "slow spools", "leaking"],
)
def test_address_pressure_known_valves_reach_plan(valve: dict[str, float], profile: Profile) -> None:
    plant, planned = machine(profile, **valve)
    bench = bench_on(planned, plant, model=plant)
    bench.arm()
    assert bench.await_air()
    assert np.abs(deviation(bench, planned)).max() < 1.6 * TOLERANCE


@pytest.mark.release
@needs_speed
def test_hold_stick_slip_joint_stays_at_address(profile: Profile) -> None:
    """A shoulder with much friction, little area, and a plan far from what its spool swings to.

    A commissioned robot had it; it slipped past its address again and again.
    """
    friction = replace(PLANT.shoulder.friction, coulomb=7.5, static=10.3)
    valve = replace(PLANT.shoulder.valve, natural_frequency=550.0, dead_band=0.017, leakage=0.0026)
    shoulder = replace(PLANT.shoulder, area_a=4.64e-4, area_b=3.18e-4, friction=friction, valve=valve)
    valve = replace(PLANT.right_arm.valve, natural_frequency=446.0, dead_band=0.036)
    arm = replace(PLANT.right_arm, area_a=2.12e-3, area_b=1.40e-3, valve=valve)
    plant = replace(PLANT, shoulder=shoulder, right_arm=arm)
    planned = with_planned_air(profile, plant)
    for start in (hanging_pose(plant), planned.angle[0] + [-0.1, 0.0, 0.0]):
        bench = bench_on(planned, plant, start, plant)
        bench.arm()
        assert bench.await_air()
        held = bench.advance(6000)["angle"]
        assert np.abs(held - held[0]).max() < 0.012
        assert np.abs(held - planned.angle[0]).max() < 0.02


@needs_speed
@pytest.mark.parametrize("seed", [1_000_002, 1_000_015])
def test_arming_unmodelled_leakage_reaches_planned_air(profile: Profile, seed: int) -> None:
    """An arm with much leakage: what its model missed pushed as hard as its loosening.

    A commissioned robot had it; a third of its healthy neighbours never came to its band.
    """
    arm = PLANT.right_arm
    friction = replace(arm.friction, coulomb=38.78, static=52.36, viscous=19.18)
    valve = replace(
        arm.valve,
        centre=-0.02799,
        dead_band=0.041556,
        conductance=9.3135e-8,
        critical_ratio=0.25683,
        leakage=2.427e-3,
        natural_frequency=564.78,
    )
    found = replace(
        arm,
        area_a=1.47043e-3,
        area_b=2.01301e-3,
        dead_volume=3.7823e-5,
        cross_leakage=7.5315e-11,
        friction=friction,
        valve=valve,
    )
    model = replace(PLANT, right_arm=found, encoders=replace(PLANT.encoders, latency=6.4e-4))
    planned, plant = with_planned_air(profile, model), healthy_plant(model, seed)
    bench = bench_on(planned, plant, model=model)
    bench.arm()
    assert bench.await_air(), bench.cause.name


def test_dither_periods_slow_spool_lengthens_period() -> None:
    slow = replace(PLANT.wrist, valve=replace(PLANT.wrist.valve, natural_frequency=2.0 * np.pi * 60.0))
    quick = replace(PLANT.wrist, valve=replace(PLANT.wrist.valve, natural_frequency=2.0 * np.pi * 150.0))
    usual = dither_periods(PLANT)
    assert dither_periods(replace(PLANT, wrist=slow)) == pytest.approx(usual * [1.0, 1.0, 100.0 / 60.0])
    assert np.all(dither_periods(replace(PLANT, wrist=quick)) == usual)


@needs_speed
def test_swing_known_spool_centre_keeps_delivery(profile: Profile) -> None:
    """Openings are relative to the spool's centre: a profile also holds for other valves."""
    delivered = []
    for centre in (0.0, 0.025):
        plant, _ = machine(profile, centre=centre)
        made = Series(Bench(profile, quiet(plant)), quiet(plant)).swing(profile)
        assert made.delivery is not None
        delivered.append(made.delivery)
    straight, beside = delivered
    assert beside.speed == pytest.approx(straight.speed, rel=0.002)
    assert beside.in_plane_error == pytest.approx(straight.in_plane_error, abs=0.001)


@needs_speed
def test_standing_robot_offset_centre_commands_zero(profile: Profile) -> None:
    plant, planned = machine(profile, centre=0.03)
    bench = bench_on(planned, plant, model=plant)
    assert np.all(bench.stepper.command["valve"] == 0.0)
