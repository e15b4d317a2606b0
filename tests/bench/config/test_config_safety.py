"""Values that a person's safety hangs on are bounded, with a real robot more tightly than in simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import inf, nextafter
from pathlib import Path
from typing import Any

import pytest

from bench.config._rules import BOUNDS, Bound, check_safety
from bench.config._settings import Configuration
from bench.config.files import load_configuration

REAL = (
    '[loop]\nrealtime = "require"\n[driver]\nname = "daq"\n[homing]\nmethod = "index"\n'
    "[lifecycle]\nlocal_reset = true\n"
)
PROVEN = (
    '[daq]\nvent_proof = "pressure switches PS1 to PS6 in the guard circuit"\n'
    'shut_off_feedback = "port0/line7"\n'
)
Found = Callable[[Configuration], dict[str, str]]
each_bound = pytest.mark.parametrize("bound", BOUNDS, ids=lambda bound: bound.key)


def load(folder: Path, text: str) -> Configuration:
    path = folder / "mine.toml"
    path.write_text(f'base = "shipped"\n{text}', encoding="utf-8")
    return load_configuration(path)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    return load(tmp_path_factory.mktemp("simulated"), "")


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Configuration:
    return load(tmp_path_factory.mktemp("real"), REAL + PROVEN)


def mistakes(c: Configuration) -> dict[str, str]:
    """Return the expected values by key."""
    return {key: expected for key, _, expected, _ in check_safety(c, {})}


def with_value(c: Configuration, bound: Bound, number: float) -> Configuration:
    """Return `c` with one number of the bound's value changed."""
    name, key = bound.key.split(".")
    section = getattr(c, name)
    value = getattr(section, key)
    changed = (*value[:-1], number) if isinstance(value, tuple) else number
    return replace(c, **{name: replace(section, **{key: changed})})


def test_check_safety_shipped_configuration_is_accepted(
    simulated: Configuration, real: Configuration
) -> None:
    assert not simulated.is_machine
    assert real.is_machine
    assert mistakes(simulated) == mistakes(real) == {}


@each_bound
@pytest.mark.parametrize("kind", ["simulated", "real"])
def test_check_safety_value_beyond_bound_is_refused(
    bound: Bound, kind: str, simulated: Configuration, real: Configuration
) -> None:
    c = simulated if kind == "simulated" else real
    allowed = bound.allowed(is_machine=c.is_machine)
    for end, beyond in ((allowed.low, -inf), (allowed.high, inf)):
        assert mistakes(with_value(c, bound, end)) == {}
        if end not in (beyond, 0.0):
            wrong = mistakes(with_value(c, bound, nextafter(end, beyond)))
            assert bound.reason in wrong[bound.key]


@each_bound
def test_safety_bounds_real_are_tighter_than_simulated(bound: Bound) -> None:
    assert bound.simulated[0] <= bound.real[0] < bound.real[1] <= bound.simulated[1]
    assert bound.real != bound.simulated
    assert bound.real[1] < inf


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lifecycle.vented_pressure", 9e5),
        ("envelope.max_tick_interval", 100.0),
        ("control.rest_speed", 1e3),
        ("control.brake_timeout", 1e-6),
        ("control.address_tolerance", 3.0),
    ],
)
def test_check_safety_simulated_absurd_value_is_refused(
    name: str, value: float, simulated: Configuration
) -> None:
    bound = next(bound for bound in BOUNDS if bound.key == name)
    assert set(mistakes(with_value(simulated, bound, value))) == {name}


def test_check_safety_real_requires_local_reset_and_warning_time(real: Configuration) -> None:
    lifecycle = replace(real.lifecycle, local_reset=False, warning_time=0.0)
    found = mistakes(replace(real, lifecycle=lifecycle))
    assert set(found) == {"lifecycle.local_reset", "lifecycle.warning_time"}


SENSORS = ("ai1", "ai2", "ai3", "ai4", "ai5", "ai6")


@pytest.mark.parametrize(
    ("fitted", "missing"),
    [
        ({}, {"supply_pressure", "chamber_pressures"}),
        ({"supply_pressure": "ai0"}, {"chamber_pressures"}),
        ({"chamber_pressures": SENSORS}, {"supply_pressure"}),
        ({"supply_pressure": "ai0", "chamber_pressures": (*SENSORS[:5], "")}, {"chamber_pressures"}),
        ({"supply_pressure": "ai0", "vent_feedback": ("port0/line5", "")}, {"chamber_pressures"}),
        ({"supply_pressure": "ai0", "chamber_pressures": SENSORS}, set()),
        ({"supply_pressure": "ai0", "vent_feedback": ("port0/line5", "port0/line6")}, {"chamber_pressures"}),
        ({"vent_proof": "pressure switches PS1 to PS7 in the guard circuit"}, set()),
    ],
)
def test_check_safety_daq_requires_pressures_or_vent_proof(
    real: Configuration, fitted: dict[str, Any], missing: set[str]
) -> None:
    found = mistakes(replace(real, daq=replace(real.daq, **{"vent_proof": ""} | fitted)))
    assert set(found) == {f"daq.{key}" for key in missing}
    assert all("vent_proof" in expected for expected in found.values())


@pytest.mark.parametrize(
    ("node", "vents", "missing"),
    [
        ({}, (5, 6), set()),
        ({"supply_pressure": 0}, (5, 6), {"supply_pressure"}),
        ({"chamber_pressures": (0,) * 6}, (5, 6), {"chamber_pressures"}),
        ({"chamber_pressures": (0,) * 6}, (5, -1), {"chamber_pressures"}),
        ({"chamber_pressures": (0,) * 6, "vent_proof": "switches"}, (-1, -1), set()),
        ({}, (-1, -1), set()),
    ],
)
def test_check_safety_canopen_requires_pressures_or_vent_proof(
    simulated: Configuration, node: dict[str, Any], vents: tuple[int, int], missing: set[str]
) -> None:
    lifecycle = replace(simulated.lifecycle, local_reset=True)
    chosen = simulated.canopen.valve_node
    inputs = replace(chosen.inputs, vent_1_open=vents[0], vent_2_open=vents[1])
    canopen = replace(simulated.canopen, valve_node=replace(chosen, inputs=inputs, **node))
    driver = replace(simulated.driver, name="canopen")
    c = replace(simulated, driver=driver, canopen=canopen, lifecycle=lifecycle)
    assert c.is_machine
    found = {key for key in mistakes(c) if "canopen" in key}
    assert found == {f"canopen.valve_node.{key}" for key in missing}


def test_check_safety_real_requires_shut_off_feedback(simulated: Configuration, real: Configuration) -> None:
    without = replace(real, daq=replace(real.daq, shut_off_feedback=""))
    assert set(mistakes(without)) == {"daq.shut_off_feedback"}
    lifecycle = replace(simulated.lifecycle, local_reset=True)
    for interface, bit, wrong in (
        ("socketcan", 7, False),
        ("socketcan", -1, True),
        ("local_socket", -1, False),
    ):
        node = simulated.canopen.valve_node
        node = replace(node, inputs=replace(node.inputs, shut_off_open=bit))
        canopen = replace(simulated.canopen, interface=interface, valve_node=node)
        driver = replace(simulated.driver, name="canopen")
        c = replace(simulated, driver=driver, canopen=canopen, lifecycle=lifecycle)
        assert ("canopen.valve_node.inputs.shut_off_open" in mistakes(c)) is wrong


@pytest.mark.parametrize("interface", ["local_socket", "socketcan"])
def test_check_safety_local_socket_counts_as_simulated(interface: str, simulated: Configuration) -> None:
    c = replace(
        simulated,
        driver=replace(simulated.driver, name="canopen"),
        canopen=replace(simulated.canopen, interface=interface),
    )
    assert ("lifecycle.local_reset" in mistakes(c)) == (interface == "socketcan")


@pytest.mark.parametrize("realtime", ["off", "prefer", "require"])
def test_check_safety_real_requires_realtime(
    realtime: Any, simulated: Configuration, real: Configuration
) -> None:
    for c, wrong in ((simulated, False), (real, realtime != "require")):
        changed = replace(c, loop=replace(c.loop, realtime=realtime))
        assert ("loop.realtime" in mistakes(changed)) is wrong


def test_check_safety_real_requires_homing_at_stops(simulated: Configuration, real: Configuration) -> None:
    for c, wrong in ((simulated, []), (real, ["homing.stops"])):
        assert list(mistakes(replace(c, homing=replace(c.homing, stops=False)))) == wrong
