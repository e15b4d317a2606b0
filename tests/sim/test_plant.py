"""The complete plant: supply, vents, state after a swing, repeatability."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.base.compiled import new_record
from drivers.base.records import COMMAND
from sim.plant import OPEN, SHUT, Plant, PlantParameters, Site, advance, build_plant, initial_state
from sim.pneumatics import Friction
from tests.compiled_only import needs_speed

POSE = np.array([-0.2, 4.1, 5.6])
LOCKED = Friction(viscous=0.0, coulomb=1e9, static=1e9)


def locked_plant(**fields: Any) -> Plant:
    """Return a plant that stands still, with tight valves."""
    parameters = PlantParameters(**fields)
    for name in ("shoulder", "right_arm", "wrist"):
        actuator = getattr(parameters, name)
        tight = replace(actuator, friction=LOCKED, valve=replace(actuator.valve, leakage=0.0))
        parameters = replace(parameters, **{name: replace(tight, cross_leakage=0.0)})
    return build_plant(parameters)


def command_of(**fields: Any) -> Any:
    command = new_record(COMMAND)
    for name, value in fields.items():
        command[name] = value
    return command


def history(plant: Plant, state: Any, ticks: int, command: Any) -> Any:
    """Advance `ticks` ticks and return the states after each."""
    states = []
    for _ in range(ticks):
        advance(*plant.records, state, command)
        states.append(state.copy())
    return np.concatenate(states)


POWERED: dict[str, Any] = {"supply_enable": True, "exhaust_closed": True, "guard_lock": True}


@needs_speed
def test_supply_soft_start_opens_over_set_time() -> None:
    plant = locked_plant()
    states = history(plant, initial_state(plant, POSE), 3000, command_of(**POWERED))
    supply = plant.parameters.supply
    full = round(supply.soft_start_time / plant.parameters.tick)
    assert states["supply_level"][: full - 1] == pytest.approx(np.arange(1, full) / full)
    assert states["supply_level"][full:].tolist() == [1.0] * (3000 - full)
    pressure = states["supply_pressure"]
    assert np.all(np.diff(pressure) >= 0.0)
    assert pressure[0] - supply.atmosphere < 0.01 * (pressure[200] - supply.atmosphere)
    assert pressure[-1] == pytest.approx(supply.pressure, rel=1e-3)
    assert pressure[-1] <= supply.pressure


@needs_speed
def test_air_used_equals_manifold_fill() -> None:
    """Isothermal: mass = V (p - p0) / (R T), in kg."""
    plant = locked_plant(supply=replace(PlantParameters().supply, polytropic_exponent=1.0))
    state = initial_state(plant, POSE)
    history(plant, state, 2000, command_of(**POWERED))
    supply = plant.parameters.supply
    mass = supply.volume * (state["supply_pressure"][0] - supply.atmosphere) / (287.05 * 293.15)
    assert state["air_used"][0] == pytest.approx(mass, rel=1e-6)


@needs_speed
def test_supply_pressure_sags_under_valve_flow() -> None:
    plant = build_plant(PlantParameters())
    state = initial_state(plant, POSE, pressurised=True)
    states = history(plant, state, 100, command_of(valve=(1.0, 1.0, 1.0), **POWERED))
    assert states["supply_pressure"].min() < 0.99 * plant.parameters.supply.pressure


@needs_speed
def test_manifold_supply_disabled_exhausts_to_atmosphere() -> None:
    plant = locked_plant()
    state = initial_state(plant, POSE, pressurised=True)
    pressure = history(plant, state, 2000, command_of(exhaust_closed=True))["supply_pressure"]
    assert np.all(np.diff(pressure) <= 0.0)
    assert pressure[-1] == pytest.approx(plant.parameters.supply.atmosphere, rel=1e-2)
    assert state["supply_level"][0] == 0.0


@needs_speed
def test_vents_empty_chambers_after_delay() -> None:
    plant = locked_plant()
    state = initial_state(plant, POSE, pressurised=True)
    start = state["pressure"][0].copy()
    states = history(plant, state, 3000, command_of())
    delay = round(plant.parameters.supply.vent_delay / plant.parameters.tick)
    assert states["pressure"][delay - 2] == pytest.approx(start, rel=1e-12)
    after = states["pressure"][delay + 2 :]
    assert np.all(np.diff(after, axis=0) <= 0.0)
    assert np.all(after[0] < start)
    atmosphere = plant.parameters.supply.atmosphere
    assert np.all(after[-1] - atmosphere < 0.2 * (start - atmosphere))
    assert np.all(after[-1] >= atmosphere)


def test_vents_exhaust_closed_restarts_delay() -> None:
    plant = locked_plant(supply=replace(PlantParameters().supply, vent_delay=0.003))
    state = initial_state(plant, POSE, pressurised=True)
    start = state["pressure"][0].copy()
    for exhaust_closed in (False, False, True, False, False):
        advance(*plant.records, state, command_of(exhaust_closed=exhaust_closed))
    assert state["pressure"][0] == pytest.approx(start, rel=1e-12)
    history(plant, state, 4, command_of())
    assert np.all(state["pressure"][0] < start)


@needs_speed
def test_relief_valves_open_only_above_set_pressure() -> None:
    plant = locked_plant()
    relief = plant.parameters.supply.relief_pressure
    state = initial_state(plant, POSE)
    state["pressure"] = relief + np.array([1e5, 2e5, 1e5, 2e5, -1e3, -1e5])
    start = state["pressure"][0].copy()
    states = history(plant, state, 300, command_of(exhaust_closed=True))
    assert np.all(np.diff(states["pressure"][:, :4], axis=0) <= 0.0)
    assert np.all(states["pressure"][-1, :4] < relief + 0.2e5)
    assert np.all(states["pressure"][-1, :4] >= relief)
    assert states["pressure"][-1, 4:] == pytest.approx(start[4:], rel=1e-12)


@needs_speed
@pytest.mark.parametrize(
    ("opens_at", "least", "most"), [(1.1, 8.8e5, 9.3e5), (4.0, 11.1e5, 11.2e5)], ids=["fitted", "never opens"]
)
def test_manifold_relief_valve_limits_regulator_surge(opens_at: float, least: float, most: float) -> None:
    plant = locked_plant(supply=replace(PlantParameters().supply, manifold_relief_ratio=opens_at))
    plant.plant["regulated"] = 1.4 * plant.parameters.supply.pressure
    states = history(plant, initial_state(plant, POSE), 2000, command_of(**POWERED))
    assert least < states["supply_pressure"].max() <= most


@needs_speed
def test_manifold_relief_valve_closed_changes_nothing() -> None:
    kept = []
    for opens_at in (1.1, 4.0):
        supply = replace(PlantParameters().supply, manifold_relief_ratio=opens_at)
        plant = build_plant(PlantParameters(supply=supply))
        state = initial_state(plant, POSE, pressurised=True)
        history(plant, state, 200, command_of(valve=(0.4, -0.3, 0.5), **POWERED))
        kept.append(state.tobytes())
    assert kept[0] == kept[1]


def test_guard_locks_only_when_closed() -> None:
    plant = locked_plant()
    state = initial_state(plant, POSE)
    for closed, lock in ((True, True), (True, False), (False, True)):
        state["guard_closed"] = closed
        advance(*plant.records, state, command_of(guard_lock=lock))
        assert state["guard_locked"][0] == (closed and lock)


@needs_speed
def test_plant_peaks_match_motion() -> None:
    plant = build_plant(PlantParameters(site=Site(ground=-3.0)))
    state = initial_state(plant, POSE, pressurised=True)
    start = state["pressure"].copy()
    states = history(plant, state, 150, command_of(valve=(0.6, 0.4, -0.7), **POWERED))
    assert state["peak_pressure"][0] == pytest.approx(np.vstack([start, states["pressure"]]).max(axis=0))
    fastest = np.hypot(states["head"][:, 3], states["head"][:, 4]).max()
    assert state["peak_head_speed"][0] == pytest.approx(fastest, rel=1e-15)  # hypot rounds otherwise
    clearance = states["head"][:, 1] - plant.parameters.site.sole_depth - plant.parameters.site.ground
    assert state["lowest_clearance"][0] == clearance.min()
    assert state["peak_head_speed"][0] > 1.0


@pytest.mark.parametrize(
    ("stuck", "positions"),
    [((0, 0), [1, 1]), ((SHUT, 0), [0, 1]), ((0, SHUT), [1, 0]), ((SHUT, SHUT), [0, 0])],
)
def test_vents_one_working_empties_chambers_as_fast_as_both(
    stuck: tuple[int, int], positions: list[int]
) -> None:
    pressures = []
    state: Any = None
    states: Any = None
    for now in ((0, 0), stuck):
        plant = build_plant(PlantParameters())
        plant.plant["vent_stuck"] = now
        state = initial_state(plant, POSE, pressurised=True)
        states = history(plant, state, 3000, command_of())
        pressures.append(state["pressure"][0].copy())
    assert state["vent_open"][0].tolist() == positions
    assert not states["vent_open"][:400].any()  # after their delay
    if any(positions):
        assert (pressures[1] == pressures[0]).all()
    else:
        assert (pressures[1] > 1.5 * pressures[0]).all()


@pytest.mark.parametrize("share", [0.1, 0.0])
def test_exhaust_throttled_slows_selected_volumes_only(share: float) -> None:
    pressures = []
    for shares in ((1.0,) * 7, (1.0, share, 1.0, 1.0, 1.0, 1.0, share)):
        # Arms that move and spools that leak would let the neighbours feel it, too.
        plant = locked_plant()
        plant.plant["exhaust"] = shares
        state = initial_state(plant, POSE, pressurised=True)
        history(plant, state, 800, command_of())
        pressures.append((*state["pressure"][0], state["supply_pressure"][0]))
    kept = np.array(pressures[1]) / np.array(pressures[0])
    assert (kept[[1, 6]] > 1.1).all()
    assert kept[[0, 2, 3, 4, 5]] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("command", "stuck", "cut"),
    [
        ({}, 0, False),
        ({"supply_enable": False}, 0, True),
        ({"exhaust_closed": False}, 0, False),
        ({"guard_lock": False}, 0, True),
        ({"guard_lock": False}, OPEN, False),
        ({}, SHUT, True),
    ],
)
def test_supply_or_shut_off_valve_closed_empties_manifold(
    command: dict[str, bool], stuck: int, cut: bool
) -> None:
    plant = build_plant(PlantParameters())
    plant.plant["shut_off_stuck"] = stuck
    state = initial_state(plant, POSE, pressurised=True)
    states = history(plant, state, 1500, command_of(**POWERED | command))
    supply = plant.parameters.supply
    pressure = states["supply_pressure"]
    if "supply_enable" not in command and stuck == 0:  # a shut-off valve that shuts does so by its timer
        assert pressure[round(900 * supply.shut_off_delay)] > 0.9 * supply.pressure
    assert bool(pressure[-1] < 1.1 * supply.atmosphere) is cut


@needs_speed
@pytest.mark.parametrize("open_", ["emergency_stop_clear", "guard_closed"])
@pytest.mark.parametrize("stuck", [0, SHUT])
def test_safety_relay_emergency_stop_or_guard_vents_and_cuts_supply(open_: str, stuck: int) -> None:
    plant = build_plant(PlantParameters())
    plant.plant["relay_stuck"] = stuck
    state = initial_state(plant, POSE, pressurised=True)
    state[open_] = False
    states = history(plant, state, 1500, command_of(**POWERED))
    supply, tick = plant.parameters.supply, plant.parameters.tick
    vented, emptied = states["vent_open"].all(axis=1), states["supply_pressure"] < 1.1 * supply.atmosphere
    if stuck:
        assert not vented.any()
        assert not emptied.any()
        return
    assert np.flatnonzero(vented)[0] * tick == pytest.approx(supply.vent_delay, abs=2 * tick)
    assert states["supply_pressure"][round(0.99 * supply.shut_off_delay / tick)] > 0.9 * supply.pressure
    assert emptied[-1]


@needs_speed
def test_safety_relay_stuck_open_acts_as_emergency_stop() -> None:
    plant = build_plant(PlantParameters())
    plant.plant["relay_stuck"] = OPEN
    state = initial_state(plant, POSE, pressurised=True)
    states = history(plant, state, 1500, command_of(**POWERED))
    assert states["vent_open"][-1].all()
    assert states["supply_pressure"][-1] < 1.1 * plant.parameters.supply.atmosphere


def test_plant_equal_inputs_give_equal_bits() -> None:
    rng = np.random.default_rng(8)
    valves = rng.uniform(-1, 1, (40, 3))
    results = []
    for _ in range(2):
        plant = build_plant(PlantParameters())
        state = initial_state(plant, POSE, pressurised=True)
        for valve in valves:
            advance(*plant.records, state, command_of(valve=valve, **POWERED))
        results.append(state.tobytes())
    assert results[0] == results[1]


@pytest.mark.parametrize("mounted", [0.0, 0.6])
def test_effort_equals_air_force_less_atmosphere(mounted: float) -> None:
    plant = build_plant(replace(locked_plant().parameters, wrist_lever_angle=mounted))
    state = initial_state(plant, POSE)
    atmosphere = plant.parameters.supply.atmosphere
    state["pressure"] = atmosphere + np.array([2e5, 0.0, 1e5, 3e5, 4e5, 1e5])
    advance(*plant.records, state, command_of(exhaust_closed=True))
    lever = plant.parameters.wrist_lever * np.sin(POSE[2] + mounted - 1.5 * np.pi)
    expected = [4.0e-4 * 2e5, 19.63e-4 * 1e5 - 16.49e-4 * 3e5, (19.63e-4 * 4e5 - 16.49e-4 * 1e5) * lever]
    assert state["effort"][0] == pytest.approx(expected, rel=1e-9)
