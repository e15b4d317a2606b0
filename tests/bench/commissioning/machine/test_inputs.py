"""Inputs are accepted after an observed change: each input fault is found and identified."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import combinations, product
from math import nan
from pathlib import Path
from typing import Any, cast

import pytest
from sqlalchemy import URL, make_url

from bench.base.errors import Refused
from bench.base.lifecycle import REFUSAL_WORDS, Block, Refusal
from bench.calibration.archive import add_calibration, effective_calibration
from bench.calibration.calibration import CalibrationKind, SeenInputs, wiring_digest
from bench.commands.cli import main
from bench.commissioning.commissioning import begin, read_state, see_inputs
from bench.commissioning.machine.commissioning_step import MachineFault
from bench.commissioning.machine.driver_machine import LongStall, SimulatedMachine, Stalled
from bench.commissioning.machine.inputs import ACTS, INPUTS, Act, await_local_reset, fitted, judged, stages
from bench.commissioning.machine.machine import ADRIFT, Segment
from bench.commissioning.steps.inputs_check import PRESSURES, check_inputs, off_at_rest
from bench.config import Configuration
from bench.control.settings import holding_pressure
from bench.store.database import open_database
from drivers.base import CHAMBERS, INVALID, PASSIVE, Command, Readings
from sim.faults import SWITCHES, Fault, Kind
from tests.bench.commissioning.drawn_robots import drawn_robot
from tests.sampling import release_except

NOW = datetime(2026, 5, 1, 8, 0, tzinfo=UTC)
ALL = tuple(INPUTS)
STAGES = stages(local_reset=True)
SENSORS = tuple(f"{name} sensor" for name in ("supply", *CHAMBERS))


@pytest.fixture
def wired(configuration: Configuration) -> Configuration:
    """The bench with a local reset, as a machine has."""
    return replace(configuration, lifecycle=replace(configuration.lifecycle, local_reset=True))


def checked(c: Configuration, *faults: Fault) -> list[MachineFault]:
    with SimulatedMachine(c.plant, c.plant, faults, inputs_only=True) as machine:
        hands = machine.hands._replace(timeout=0.5)
        findings = check_inputs(machine, hands, c)[1]
        assert not machine.driver.applied.supply_enable
        assert machine.loads.peak_head_speed < 0.05, "nothing moves"
    return findings


def broken(signal: str, kind: Kind, value: float = nan) -> Fault:
    return Fault(f"{signal} {kind}", signal, kind, value)


def spans(share: float, atmosphere: float) -> Callable[[Readings], Readings]:
    """Return a supply sensor whose span is `share` of the truth, with a correct zero."""
    return lambda r: r._replace(supply_pressure=atmosphere + share * (r.supply_pressure - atmosphere))


def readings(levels: dict[str, bool]) -> Readings:
    """Return readings with `levels` of all inputs."""
    return Readings(
        0.0,
        (0, 0, 0),
        (0.0, 0.0, 0.0),
        (True, True, True),
        (0.0, 0.0, 0.0),
        levels["emergency stop"],
        levels["guard closed"],
        levels["guard locked"],
        1e5,
        levels["local reset"],
        levels["ball sensor"],
        (1e5,) * 6,
        vent_open=(float(levels["vent 1"]), float(levels["vent 2"])),
        shut_off_open=float(levels["shut-off"]),
    )


def healthy() -> list[dict[str, bool]]:
    """Return the levels of all inputs in each stage of a right machine."""
    return [{name: one.rest != (name in stage.changed) for name, one in INPUTS.items()} for stage in STAGES]


def test_check_inputs_fault_free_machine_accepts_all_inputs(wired: Configuration) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        seen, findings = check_inputs(machine, machine.hands, wired)
    assert findings == []
    assert seen.seen == ALL
    assert abs(seen.gauge) < 0.05e5


def test_stages_give_each_input_unique_pattern() -> None:
    """Only the two vents, which one output opens, act alike."""
    columns = {name: tuple(level[name] for level in healthy()) for name in ALL}
    assert all(len(set(column)) == 2 for column in columns.values())
    assert len(set(columns.values())) == len(ALL) - 1
    assert columns["vent 1"] == columns["vent 2"]


def test_judged_exchanged_inputs_are_reported_as_pair() -> None:
    for a, b in combinations(ALL, 2):
        if {a, b} == {"vent 1", "vent 2"}:
            continue
        seen = [readings(levels | {a: levels[b], b: levels[a]}) for levels in healthy()]
        found = judged(STAGES, seen, ALL)
        assert [set(f.location.split(" and ")) for f in found] == [{a, b}]
        assert "exchanged" in found[0].found, (a, b)


def test_judged_constant_input_is_reported() -> None:
    for name, level in product(ALL, (True, False)):
        found = judged(STAGES, [readings(levels | {name: level}) for levels in healthy()], ALL)
        assert [f.location for f in found] == [name], (name, level)
        assert "all the time" in found[0].found, (name, level)


def test_judged_reversed_polarity_is_reported() -> None:
    for name in ALL:
        seen = [readings(levels | {name: not levels[name]}) for levels in healthy()]
        found = judged(STAGES, seen, ALL)
        assert [(f.location, "opposite" in f.found) for f in found] == [(name, True)]


def test_judged_change_in_wrong_stage_is_reported_with_stage() -> None:
    for name in ALL:
        wrong = healthy()
        wrong[3][name] = not wrong[3][name]
        found = judged(STAGES, [readings(levels) for levels in wrong], ALL)
        assert [f.location for f in found] == [name]
        assert "emergency stop released" in found[0].found, name


FAULTS = (
    (broken("guard closed", "stuck", 1.0), "guard closed", "'closed' all the time"),
    (broken("emergency stop", "stuck", 1.0), "emergency stop", "'clear' all the time"),
    (broken("guard closed", "off"), "guard closed", "'open' all the time"),
    (broken("guard locked", "stuck", 1.0), "guard locked", "'locked' all the time"),
    (broken("local reset", "stuck", 1.0), "local reset", "'pressed' all the time"),
    (broken("emergency stop", "swapped", 1.0), "emergency stop and guard closed", "exchanged"),
    (broken("guard closed", "swapped", 2.0), "guard closed and guard locked", "exchanged"),
    (broken("vent 1 feedback", "swapped", 7.0), "vent 1 and shut-off", "exchanged"),
    (broken("safety relay", "stuck", 1.0), "stop contacts", "welded"),
    (broken("safety relay", "stuck", 0.0), "vent 1", "'open' all the time"),
    (broken("vent 1", "stuck", 1.0), "vent 1", "'shut' all the time"),
    (broken("shut-off", "stuck", 1.0), "shut-off", "'open' all the time"),
    (broken("supply sensor", "scale", 0.8), "supply sensor", "0.810 bar absolute, vented"),
    (broken("wrist cylinder B sensor", "scale", 0.8), "wrist cylinder B sensor", "0.810 bar"),
    (broken("right arm A sensor", "offset", 0.05e5), "right arm A sensor", "1.063 bar absolute, vented"),
)
EVERYDAY = (FAULTS[0], FAULTS[5], FAULTS[8])
"""Bridged, exchanged, welded."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "location", "words"),
    [pytest.param(*case, marks=() if case in EVERYDAY else pytest.mark.release) for case in FAULTS],
    ids=lambda value: f"{value.name} {value.value:g}" if isinstance(value, Fault) else "",
)
def test_check_inputs_injected_fault_is_found(
    wired: Configuration, fault: Fault, location: str, words: str
) -> None:
    findings = checked(wired, fault)
    assert any(location in one.location and words in one.found for one in findings), findings
    assert all(one.expected and one.action for one in findings)


@pytest.mark.parametrize("bar", [0.029, 0.031, -0.031, 0.05, 0.12])
@pytest.mark.parametrize("signal", ["supply sensor", "wrist cylinder B sensor"])
def test_off_at_rest_sensor_zero_beyond_access_bound_is_found(
    configuration: Configuration, signal: str, bar: float
) -> None:
    plant, atmosphere = configuration.plant, configuration.plant.supply.atmosphere
    shown: list[Any] = [atmosphere + 1e5 * bar * (name == signal) for name in SENSORS]
    a, b, c, d, e, g = shown[1:]
    one = readings(healthy()[0])._replace(supply_pressure=shown[0], chamber_pressure=(a, b, c, d, e, g))
    findings = off_at_rest(one, plant)
    assert [f.location for f in findings] == ([signal] if abs(bar) > 0.03 else [])
    if not findings:
        assert max(shown) <= holding_pressure(plant), "access opens"


@pytest.mark.slow
def test_check_inputs_supply_span_error_is_found_by_gauge(
    wired: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sensors of gauge pressure read the atmosphere right; all spans are 0.8 times the truth."""
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        atmosphere = wired.plant.supply.atmosphere
        own = machine.hands
        true_watch, spoiled = machine.watch, spans(0.8, atmosphere)
        monkeypatch.setattr(machine, "watch", lambda *given: spoiled(true_watch(*given)))

        def turned_to_read_right(pressure: float) -> None:
            own.regulator(atmosphere + (pressure - atmosphere) / 0.8)

        findings = check_inputs(machine, own._replace(regulator=turned_to_read_right), wired)[1]
    assert [one.location for one in findings] == ["supply sensor"] * len(PRESSURES)
    assert "by the gauge" in findings[-1].found


def test_check_inputs_unproven_guard_keeps_supply_off(wired: Configuration) -> None:
    turned = list[float]()
    with SimulatedMachine(wired.plant, wired.plant, (broken("guard closed", "stuck", 1.0),)) as machine:
        hands = machine.hands._replace(timeout=0.5)

        def turn(pressure: float) -> None:
            turned.append(pressure)
            hands.regulator(pressure)

        check_inputs(machine, hands._replace(regulator=turn), wired)
    assert not set(turned) & set(PRESSURES)


@pytest.mark.slow
@pytest.mark.parametrize(("measured", "words"), [(True, "the joint moves"), (False, "rad/s")])
def test_check_inputs_stuck_open_spool_ends_check(wired: Configuration, measured: bool, words: str) -> None:
    stuck = broken("shoulder valve", "stuck", 0.5)
    with (
        SimulatedMachine(wired.plant, wired.plant, (stuck,), inputs_only=measured) as machine,
        pytest.raises(MachineFault, match=f"{words}.* with the spools centred"),
    ):
        check_inputs(machine, machine.hands, wired)
    assert not machine.driver.applied.supply_enable
    assert machine.loads.peak_head_speed < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", release_except((408,), (31, *range(400, 440))))
def test_check_inputs_spool_offsets_give_no_finding(wired: Configuration, seed: int) -> None:
    robot = drawn_robot(seed, wired.plant)
    with SimulatedMachine(robot, wired.plant) as machine:
        findings = check_inputs(machine, machine.hands, wired)[1]
        loads = machine.loads
    assert findings == []
    assert loads.stop_share < 0.6
    assert loads.lowest_clearance > 0.0


def stalling(
    machine: SimulatedMachine, monkeypatch: pytest.MonkeyPatch, at: Sequence[int], error: type[Stalled]
) -> list[Command]:
    """Have the watches of `machine` with the numbers `at` end by a stall; return the commands of all."""
    watch, commands = machine.watch, list[Command]()

    def watched(command: Command, *given: Any) -> Readings:
        commands.append(command)
        readings = watch(command, *given)
        if len(commands) - 1 in at:
            machine.make_passive()
            raise error("check of the inputs", "the device went passive", "a machine that reads", "End it.")
        return readings

    monkeypatch.setattr(machine, "watch", watched)
    return commands


def test_check_inputs_stall_repeats_one_stage_each(
    wired: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The act was done before the stall; the levels seen before it count."""
    acts, said = list[str](), list[str]()
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        own = machine.hands
        commands = stalling(machine, monkeypatch, (2, 9, 13, 21), Stalled)

        def act(one: Act) -> None:
            acts.append(one.key)
            own.act(one)

        seen, findings = check_inputs(machine, own._replace(act=act, say=said.append), wired)
    assert (findings, seen.seen) == ([], ALL)
    # Before the guard is released again the chambers are seen to be empty.
    assert commands[10] == commands[14] == PASSIVE
    assert len(commands) == len(STAGES) + 1 + 2 + 2 + 2 * len(PRESSURES) + 2
    assert [acts.count(key) for key in ("press-stop", "release-stop")] == [2, 1]
    repeated = [text.partition("Repeated: ")[2] for text in said if "Repeated" in text]
    assert repeated[0] == "emergency stop pressed; the 2 parts before it count."


def test_check_inputs_long_stall_ends_check(wired: Configuration, monkeypatch: pytest.MonkeyPatch) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        commands = stalling(machine, monkeypatch, (4,), LongStall)
        with pytest.raises(LongStall):
            check_inputs(machine, machine.hands, wired)
    assert len(commands) == 5


def test_check_inputs_air_after_stall_keeps_guard_locked(
    wired: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    clogged = broken("right arm A exhaust", "scale", 0.0)
    with SimulatedMachine(wired.plant, wired.plant, (clogged,), inputs_only=True) as machine:
        commands = stalling(machine, monkeypatch, (10,), Stalled)

        def say(text: str) -> None:
            if "Repeated" in text:
                machine.driver.plant_state["pressure"][0, CHAMBERS.index("right arm A")] = 1.5e5

        findings = check_inputs(machine, machine.hands._replace(say=say), wired)[1]
    released = [number for number, command in enumerate(commands) if not command.guard_lock]
    assert max(released) <= 10
    assert findings


class _Acted(Exception):
    """Ends a check at an act."""


def test_check_inputs_air_in_chamber_keeps_guard_locked(wired: Configuration) -> None:
    """Half a bar behind a clogged silencer lifts an arm: no person is sent to the tee."""
    acts = list[str]()
    clogged = broken("right arm A exhaust", "scale", 0.0)
    with SimulatedMachine(wired.plant, wired.plant, (clogged,), inputs_only=True) as machine:
        own = machine.hands
        written = machine.driver.write
        commands = list[Command]()

        def act(one: Act) -> None:
            acts.append(one.key)
            own.act(one)
            if one.key == "release-reset":  # it leaks into the chamber
                machine.driver.plant_state["pressure"][0, CHAMBERS.index("right arm A")] = 1.5e5

        def write(command: Command) -> Command:
            commands.append(command)
            return written(command)

        machine.driver.write = write  # type: ignore[method-assign]
        seen, findings = check_inputs(machine, own._replace(act=act), wired)
    assert all(command.guard_lock for command in commands)
    assert "open-guard" not in acts
    assert [one.location for one in findings] == ["right arm A sensor"]
    assert "bar absolute, vented" in findings[0].found
    assert "hand valve" in findings[0].action
    assert seen.findings, "arming is blocked"


@pytest.mark.parametrize("failing", ["right arm A", "supply"])
def test_check_inputs_sensor_failing_meanwhile_asks_for_gauges_and_is_found(
    wired: Configuration, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """Its last value proves nothing."""
    done = list[str]()
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        own, read = machine.hands, machine._read_record

        def act(one: Act) -> None:
            done.append(one.key)
            own.act(one)

        def failed(time: float, record: Any) -> None:
            read(time, record)
            if "release-reset" in done:
                record["supply_pressure" if failing == "supply" else "chamber_pressure"] = INVALID

        monkeypatch.setattr(machine, "_read_record", failed)
        findings = check_inputs(machine, own._replace(act=act, confirm=done.append), wired)[1]
    assert done[done.index("open-guard") - 1].startswith(REFUSAL_WORDS[Refusal.GAUGE][0])
    found = {one.location: one.found for one in findings}
    assert found[f"{failing} sensor"] == "no believable reading"


def test_check_inputs_without_chamber_sensors_asks_for_gauges_before_release(wired: Configuration) -> None:
    plant = replace(wired.plant, pressure_sensors=False)
    done = list[str]()
    with SimulatedMachine(plant, plant, inputs_only=True) as machine:
        own = machine.hands

        def act(one: Act) -> None:
            done.append(one.key)
            if one.key == "open-guard":
                raise _Acted
            own.act(one)

        hands = own._replace(act=act, confirm=done.append)
        with pytest.raises(_Acted):
            check_inputs(machine, hands, replace(wired, plant=plant))
    words = done[done.index("open-guard") - 1]
    assert words.startswith(REFUSAL_WORDS[Refusal.GAUGE][0])
    assert "hand valve" in words


def test_check_inputs_person_at_tee_has_open_vents_pin_and_time(
    wired: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = list[float]()
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        own, watch = machine.hands, machine.watch

        def act(one: Act) -> None:
            if one.key == "place-ball":
                assert machine.driver.applied == Command(guard_lock=False)
                assert machine.driver.plant_state["pressure"][0].max() < holding_pressure(wired.plant)
            own.act(one)

        def noted(*given: Any) -> Readings:
            times.append(given[-1])
            return watch(*given)

        monkeypatch.setattr(machine, "watch", noted)
        assert check_inputs(machine, own._replace(act=act), wired)[1] == []
    assert max(times) > 4.0 * own.timeout
    assert "pin the shoulder" in ACTS["place-ball"].text
    assert "Remove the pin" in ACTS["close-guard"].text


def test_check_inputs_supply_pressure_present_is_refused(wired: Configuration) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        hands = machine.hands._replace(regulator=lambda p: None)
        with pytest.raises(Refused, match="Turn the regulator down"):
            check_inputs(machine, hands, wired)
        assert not machine.driver.applied.supply_enable


@pytest.mark.slow
def test_check_inputs_refused_with_air_on_turns_regulator_down(wired: Configuration) -> None:
    atmosphere, turned = wired.plant.supply.atmosphere, list[float]()
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        own = machine.hands

        def turn(pressure: float) -> None:
            turned.append(pressure)
            own.regulator(pressure)

        hands = own._replace(regulator=turn, gauge=lambda: 0.0)
        with pytest.raises(Refused, match="turn the regulator up"):
            check_inputs(machine, hands, wired)
        assert not machine.driver.applied.supply_enable
    assert turned == [atmosphere, PRESSURES[0], atmosphere]


@pytest.mark.slow
def test_check_inputs_gauge_without_air_is_refused(wired: Configuration) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        own = machine.hands
        atmosphere = wired.plant.supply.atmosphere
        with pytest.raises(Refused, match="turn the regulator up"):
            check_inputs(machine, own._replace(regulator=lambda p: own.regulator(atmosphere)), wired)


def test_check_inputs_operator_stop_is_refused_with_restart_action(wired: Configuration) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        hands = machine.hands
        machine._stop = lambda: True
        with pytest.raises(Refused) as refused:
            check_inputs(machine, hands, wired)
    assert (refused.value.location, refused.value.action) == ("check of the inputs", "Begin again.")


def test_check_inputs_without_gauge_is_refused(wired: Configuration) -> None:
    with SimulatedMachine(wired.plant, wired.plant, inputs_only=True) as machine:
        hands = machine.hands._replace(gauge=None)
        with pytest.raises(Refused, match="calibrate inputs"):
            check_inputs(machine, hands, wired)


@pytest.mark.slow
def test_check_inputs_unfitted_inputs_are_skipped(configuration: Configuration) -> None:
    plant = replace(configuration.plant, vent_feedback=False, pressure_sensors=False)
    c = replace(configuration, plant=plant)
    with SimulatedMachine(plant, plant, inputs_only=True) as machine:
        seen, findings = check_inputs(machine, machine.hands, c)
    assert findings == []
    assert set(ALL) - set(seen.seen) == {"vent 1", "vent 2", "local reset"}


def resettable(c: Configuration) -> SimulatedMachine:
    """Return a machine with a local reset."""
    return SimulatedMachine(c.plant, c.plant, local_reset=True)


def test_await_local_reset_pressed_and_released_returns(wired: Configuration) -> None:
    acts, said = list[str](), list[str]()
    with resettable(wired) as machine:
        own = machine.hands

        def act(one: Act) -> None:
            assert machine.driver.applied == PASSIVE
            acts.append(one.key)
            own.act(one)

        hands = own._replace(act=act, say=said.append)
        await_local_reset(machine, hands)
        assert acts == ["press-reset", "release-reset"]
        assert "count the persons" in said[0]
        await_local_reset(machine, hands)
    with SimulatedMachine(wired.plant, wired.plant) as unfitted:
        await_local_reset(unfitted, hands)
    assert len(acts) == 2


@pytest.mark.parametrize(
    ("stuck", "key"), [(False, ""), (True, ""), (False, "open-guard")], ids=["no press", "stuck", "guard"]
)
def test_await_local_reset_without_press_is_refused(wired: Configuration, stuck: bool, key: str) -> None:
    with resettable(wired) as machine:
        own = machine.hands
        machine.driver.plant_state["local_reset"] = stuck
        hands = own._replace(act=lambda one: own.act(ACTS[key]) if key else None, timeout=0.1)
        with pytest.raises(Refused, match="local reset"):
            await_local_reset(machine, hands)


SLOWLY = (Segment(0.05, (0.0, 0.0, 0.0)),)
OPENED = {"guard_closed": "guard is open", "emergency_stop_clear": "emergency stop"}


@pytest.mark.parametrize("field", ["guard_closed", "emergency_stop_clear"])
def test_machine_run_after_open_interlock_requires_new_press(wired: Configuration, field: str) -> None:
    with resettable(wired) as machine:
        with pytest.raises(Refused, match="local reset"):
            machine.run(SLOWLY, ADRIFT)
        await_local_reset(machine, machine.hands)
        machine.run(SLOWLY, ADRIFT)
        for closed in (False, True):
            machine.driver.plant_state[field] = closed
            machine.hold()
        machine.hold()
        assert not machine.may_move()
        with pytest.raises(Refused, match=OPENED[field]):
            machine.run(SLOWLY, ADRIFT)
        assert machine.driver.applied == PASSIVE
        machine.vent()
        with pytest.raises(Refused, match="local reset"):
            machine.run(SLOWLY, ADRIFT)
        await_local_reset(machine, machine.hands)
        machine.run(SLOWLY, ADRIFT)


def test_machine_run_press_behind_open_guard_is_void(wired: Configuration) -> None:
    with resettable(wired) as machine:
        for key in ("open-guard", "press-reset", "close-guard", "release-reset"):
            machine.hands.act(ACTS[key])
            machine.hold()
        assert not machine.may_move()


def test_check_inputs_air_requires_press_after_each_open_interlock(wired: Configuration) -> None:
    acts, c = list[str](), replace(wired, lifecycle=replace(wired.lifecycle, local_reset=True))
    with SimulatedMachine(c.plant, c.plant, inputs_only=True, local_reset=True) as machine:
        own = machine.hands
        assert own.gauge is not None
        read = own.gauge

        def act(one: Act) -> None:
            acts.append(one.key)
            own.act(one)

        def turn(pressure: float) -> None:
            own.regulator(pressure)
            for clear in (False, True):
                machine.driver.plant_state["emergency_stop_clear"] = clear
                machine.hold()
                machine.hold()

        def gauge() -> float:
            acts.append("gauge")
            return read()

        hands = own._replace(act=act, gauge=gauge, regulator=turn)
        _, findings = check_inputs(machine, hands, c)
    assert findings == []
    press = ["press-reset", "release-reset", "gauge"]
    assert acts[-6:] == press * 2
    assert "close-guard" in acts[:-6]


# The calendar ----------------------------------------------------------------------------------------------


def blocks(database: URL, *, required: bool, found: tuple[str, ...], hours: float) -> set[Block]:
    """Return what blocks arming `hours` after a check of the inputs."""
    with open_database(database, NOW) as engine:
        seen = SeenInputs(ALL, "0" * 16, found, 0.0)
        add_calibration(engine, "b", seen, date=NOW, expires=NOW + timedelta(days=1), by="A", method="hand")
        when = NOW + timedelta(hours=hours)
        calibration = effective_calibration(engine, "b", when, required=required)
    return {
        problem.code
        for problem in calibration.problems(when)
        if f"calibrate {CalibrationKind.INPUTS}" in problem.action
    }


@pytest.mark.parametrize(
    ("required", "found", "hours", "expected"),
    [
        (True, (), 1.0, set()),
        (True, (), 25.0, {Block.INPUTS}),
        (True, ("guard closed: bridged",), 1.0, {Block.INPUTS}),
        (False, (), 25.0, set()),
        (False, ("guard closed: bridged",), 1.0, set()),
    ],
    ids=["in force", "due", "failed", "simulated, due", "simulated, failed"],
)
def test_effective_calibration_due_or_failed_inputs_check_blocks_arming(
    tmp_path: Path, required: bool, found: tuple[str, ...], hours: float, expected: set[Block]
) -> None:
    database = make_url(f"sqlite:///{tmp_path / 'b.sqlite'}")
    assert blocks(database, required=required, found=found, hours=hours) == expected


def test_wiring_digest_changes_with_input_assignment(configuration: Configuration) -> None:
    c = replace(configuration, driver=replace(configuration.driver, name="canopen"))
    node = c.canopen.valve_node
    moved = replace(node, inputs=replace(node.inputs, emergency_stop_clear=1, guard_closed=0))
    other = replace(c, canopen=replace(c.canopen, valve_node=moved))
    assert wiring_digest(c) == wiring_digest(replace(c, bench=replace(c.bench, id="other")))
    assert wiring_digest(c) != wiring_digest(other)


# Step 0 ----------------------------------------------------------------------------------------------------


def test_see_inputs_runs_first_and_repeats_when_due(
    tmp_path: Path, configuration: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, kept = begin(tmp_path, configuration, simulated=True), list[SeenInputs]()
    found = [MachineFault("guard closed", "bridged", "a change", "Look.")]
    monkeypatch.setattr(
        "bench.commissioning.commissioning.check_inputs",
        lambda *_: (SeenInputs(ALL, "0" * 16, tuple(map(str, found))), found),
    )

    def step_0(in_force: str | None) -> int:
        """Return how many checks were made up to now."""
        unused = cast("Any", None)
        see_inputs(state, configuration, unused, unused, in_force=in_force, keep=kept.append)
        return len(kept)

    with pytest.raises(MachineFault, match="guard closed"):
        step_0("")
    wrong = read_state(tmp_path).wrong
    assert wrong is not None
    assert (wrong.step, wrong.location, len(kept)) == ("inputs", "guard closed", 1)
    found.clear()
    assert step_0("") == 2
    assert [step.name for step in read_state(tmp_path).done] == ["inputs"]
    assert step_0(None) == 2, "once is enough in simulation"
    assert step_0("calibration inputs version 3") == 2
    assert "version 3" in read_state(tmp_path).done[0].notes[0]
    assert step_0("") == 3, "due again"


@pytest.mark.slow
def test_calibrate_inputs_sim_reports_all_changes(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "inputs", "--sim"])
    assert ended.value.code == 0
    assert "inputs seen to change: emergency stop, guard closed" in capsys.readouterr().out


def test_fault_switches_match_inputs() -> None:
    assert [name.removesuffix(" feedback") for name in SWITCHES] == list(ALL)


def test_fitted_returns_inputs_in_readings() -> None:
    levels = healthy()[0]
    assert fitted(readings(levels), local_reset=True) == ALL
    assert "local reset" not in fitted(readings(levels), local_reset=False)
