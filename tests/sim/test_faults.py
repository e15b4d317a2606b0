"""Every kind of fault on every sort of signal acts as specified, from its onset on, reproducibly."""

from __future__ import annotations

from dataclasses import replace
from math import nan, pi

import numpy as np
import pytest

from bench.base.lifecycle import Phase
from drivers.base import CHAMBERS, INVALID, JOINTS
from drivers.base.compiled import new_record
from drivers.base.records import COMMAND, READINGS
from sim.faults import (
    MEANINGS,
    PHASES,
    SIGNALS,
    Fault,
    Faults,
    break_parts,
    deliver_command,
    deliver_readings,
    faulty_time,
    new_faults,
    notice_onsets,
    own_records,
    revive,
    sort_of,
)
from sim.plant import OPEN, PLANT_STATE, SHUT, Plant, PlantParameters, build_plant, initial_state

REST = np.array([0.1, 4.4, 6.0])
SPEED = np.array([3.0, 1.0, -5.0])


FITTED = PlantParameters()


class Bed:
    """A plant whose joints are moved by hand, behind faults."""

    def __init__(
        self, *faults: Fault, watchdog: float = 0.02, seed: int = 1, parameters: PlantParameters = FITTED
    ) -> None:
        self.plant: Plant = own_records(build_plant(parameters))
        self.state = initial_state(self.plant, REST, pressurised=True)
        self.faults: Faults = new_faults(faults, self.plant, watchdog=watchdog, seed=seed)
        self.readings, self.command = new_record(READINGS), new_record(COMMAND)
        self.command["valve"], self.command["supply_enable"] = (0.5, -0.3, 0.1), True
        self.command["exhaust_closed"] = self.command["guard_lock"] = self.command["tee"] = True
        self.tick = 0

    def run(self, ticks: int = 1, phase: int = -1, *, spoken: bool = True) -> Bed:
        for _ in range(ticks):
            self.state["angle"] = REST + 1e-3 * self.tick * SPEED
            self.state["history"] = self.state["angle"]
            notice_onsets(self.faults, self.plant.plant, self.state, phase)
            deliver_readings(self.faults, self.plant.plant, self.state, self.readings)
            deliver_command(self.faults, self.plant.plant, self.command, spoken)
            break_parts(self.faults, self.plant.robot, self.plant.plant, self.state)
            self.tick += 1
        return self

    @property
    def true_angle(self) -> np.ndarray:
        return np.asarray(self.state["angle"][0])

    @property
    def angle(self) -> np.ndarray:
        counts = self.readings["encoder_count"][0]
        turns = 2 * pi * counts / self.plant.parameters.encoders.counts_per_revolution
        return np.asarray(self.true_angle + (turns - self.true_angle + pi) % (2 * pi) - pi)

    @property
    def valve(self) -> np.ndarray:
        return np.asarray(self.faults.sent["valve"][0])


def broken(signal: str, kind: str, value: float = nan, **onset: object) -> Fault:
    return Fault("test", signal, kind, value, **onset)  # type: ignore[arg-type]


def test_fault_phases_match_bench_phases() -> None:
    assert [phase.name.lower() for phase in Phase] == list(PHASES)


def test_fault_signal_sorts_match_meanings() -> None:
    assert {sort_of(signal) for signal in SIGNALS} == set(MEANINGS)


@pytest.mark.parametrize(
    ("signal", "kind", "value"),
    [
        ("no such", "off", nan),
        ("club head", "stuck", nan),
        ("shoulder encoder", "leaking", 0.1),
        ("shoulder encoder", "offset", nan),
        ("shoulder encoder", "intermittent", 1.5),
        ("shoulder valve", "slow", -1.0),
        ("supply", "stuck", nan),
        ("manifold relief", "stuck", nan),
        ("manifold relief", "off", nan),
        ("safety relay", "stuck", nan),
        ("exhausts", "scale", -0.1),
        ("arm exhaust", "scale", 1.5),
        ("arm encoder", "swapped", 3.0),
        ("arm valve", "swapped", 0.5),
        ("guard closed", "swapped", 8.0),
    ],
)
def test_fault_invalid_signal_kind_or_value_raises(signal: str, kind: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"signal|kind|value"):
        broken(signal, kind, value)


def test_new_faults_delay_beyond_history_raises() -> None:
    with pytest.raises(ValueError, match="delay"):
        Bed(broken("shoulder encoder", "delayed", 0.1))


def test_swapped_fault_exchanges_channels_from_onset() -> None:
    faults = (broken("shoulder encoder", "swapped", 2.0, time=0.01), broken("arm valve", "swapped", 0.0))
    bed = Bed(*faults).run(5)
    healthy = Bed().run(5)
    assert (bed.readings["encoder_count"] == healthy.readings["encoder_count"]).all()
    bed.run(20)
    healthy.run(20)
    assert list(bed.readings["encoder_count"][0]) == list(healthy.readings["encoder_count"][0][[2, 1, 0]])
    assert list(bed.valve) == [-0.3, 0.5, 0.1]


@pytest.mark.parametrize("fault", [broken("arm valve", "swapped", 0.0), broken("arm valve", "offset", 0.1)])
def test_valve_fault_without_command_does_not_accumulate(fault: Fault) -> None:
    bed = Bed(fault).run(3)
    before = list(bed.valve)
    assert list(bed.run(7, spoken=False).valve) == before


@pytest.mark.slow
def test_faults_before_onset_change_nothing() -> None:
    bed = Bed(*(broken(s, "off", time=1.0) for s in SIGNALS if "off" in MEANINGS[sort_of(s)])).run(50)
    assert bed.angle == pytest.approx(bed.true_angle, abs=1e-4)
    assert bed.readings["encoder_valid"].all()
    assert bed.readings["emergency_stop_clear"][0]
    assert (bed.faults.sent == bed.command).all()
    assert (bed.plant.plant == bed.faults.healthy_plant).all()
    assert (bed.plant.robot == bed.faults.healthy_robot).all()


def test_encoder_fault_off_stuck_or_offset_changes_readings() -> None:
    faults = (broken("shoulder encoder", "off"), broken("arm encoder", "stuck"))
    bed = Bed(*faults, broken("wrist encoder", "offset", 0.2)).run(100)
    assert bed.readings["encoder_valid"][0].tolist() == [0, 1, 1]
    assert bed.angle[1:] == pytest.approx([REST[1], bed.true_angle[2] + 0.2], abs=1e-4)
    assert bed.readings["encoder_time"][0, 1] == bed.readings["encoder_time"][0, 0]  # its time goes on


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("scale", 0.5, REST[0] + 0.5 * 0.297),
        ("drifting", 2.0, REST[0] + 0.297 + 2.0 * 0.099),
        ("delayed", 0.02, REST[0] + 0.297 - 0.06),
        ("slow", 0.01, REST[0] + 0.297 - 0.03),
    ],
)
def test_encoder_fault_plausible_kind_gives_expected_angle(kind: str, value: float, expected: float) -> None:
    bed = Bed(broken("shoulder encoder", kind, value)).run(100)
    assert bed.true_angle[0] == pytest.approx(REST[0] + 0.297)
    assert bed.angle[0] == pytest.approx(expected, abs=1e-3)


def test_encoder_fault_offset_wraps_below_zero() -> None:
    bed = Bed(broken("shoulder encoder", "offset", -0.2)).run(1)
    assert bed.angle[0] == pytest.approx(REST[0] - 0.2, abs=1e-4)
    assert bed.readings["encoder_count"][0, 0] > 0


def test_intermittent_fault_drops_set_share_reproducibly() -> None:
    def valid(seed: int) -> list[int]:
        bed = Bed(broken("wrist encoder", "intermittent", 0.3), seed=seed)
        return [int(bed.run().readings["encoder_valid"][0, 2]) for _ in range(1000)]

    assert 230 < valid(1).count(0) < 370
    assert valid(1) == valid(1) != valid(2)


def test_garbage_fault_spans_count_range() -> None:
    bed = Bed(broken("arm encoder", "garbage"))
    counts = [int(bed.run().readings["encoder_count"][0, 1]) for _ in range(200)]
    assert min(counts) < 0.1 * 2**17
    assert max(counts) > 0.9 * 2**17


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        ("off", nan, 0.0),
        ("stuck", -1.0, -1.0),
        ("stuck", nan, 0.5),
        ("offset", 0.2, 0.7),
        ("offset", 0.9, 1.0),
        ("scale", 0.5, 0.25),
        ("drifting", 1.0, 0.599),
    ],
)
def test_valve_fault_gives_expected_command(kind: str, value: float, expected: float) -> None:
    bed = Bed(broken("shoulder valve", kind, value)).run(100)
    assert bed.valve == pytest.approx([expected, -0.3, 0.1], abs=1e-6)


def test_valve_fault_slow_or_delayed_lags_command() -> None:
    bed = Bed(broken("shoulder valve", "slow", 0.01), broken("arm valve", "delayed", 0.005)).run(10)
    bed.command["valve"] = (1.0, 1.0, 1.0)
    assert bed.run(5).valve[1] == pytest.approx(-0.3)
    assert 0.5 < bed.valve[0] < 0.8
    assert bed.run(1).valve[1] == pytest.approx(1.0)


def test_part_fault_ends_after_duration() -> None:
    faults = [
        broken("arm valve", "leaking", 0.05, duration=0.05),
        broken("supply", "scale", 0.7, duration=0.05),
    ]
    bed = Bed(*faults).run(40)
    p, h = bed.plant.plant, bed.faults.healthy_plant
    assert p["leakage"][0, 1] == 0.05
    assert p["regulated"] == pytest.approx(0.7 * h["regulated"])
    bed.run(20)
    assert (p == h).all()


@pytest.mark.parametrize("valve", [*CHAMBERS, "manifold"])
@pytest.mark.parametrize(
    ("kind", "value", "opens_above", "full", "leaks"),
    [
        ("stuck", 0.0, 0.0, 1.0, 0.0),
        ("stuck", 1.0, None, 0.0, 0.0),
        ("offset", 2e5, 2e5, 1.0, 0.0),
        ("leaking", 0.05, None, 1.0, 0.05),
    ],
)
def test_relief_fault_changes_valve_and_ends_after_duration(
    valve: str, kind: str, value: float, opens_above: float | None, full: float, leaks: float
) -> None:
    bed = Bed(broken(f"{valve} relief", kind, value, duration=0.02)).run(10)
    p, h, k = bed.plant.plant[0], bed.faults.healthy_plant[0], [*CHAMBERS, "manifold"].index(valve)
    healthy = h["relief_pressure"][k]
    pressure = healthy if opens_above is None else opens_above if kind == "stuck" else healthy + opens_above
    assert p["relief_pressure"][k] == pressure
    assert p["relief_conductance"][k] == pytest.approx(full * h["relief_conductance"][k])
    assert p["relief_leakage"][k] == pytest.approx(leaks * h["relief_conductance"][k])
    bed.run(20)
    assert (bed.plant.plant == bed.faults.healthy_plant).all()


@pytest.mark.parametrize(
    ("signal", "throttled"),
    [
        *((f"{part} exhaust", [k]) for k, part in enumerate([*CHAMBERS, "manifold"])),
        *((f"{joint} exhaust", [2 * i, 2 * i + 1]) for i, joint in enumerate(JOINTS)),
        ("exhausts", list(range(7))),
    ],
)
def test_exhaust_fault_throttles_selected_exhausts_for_duration(signal: str, throttled: list[int]) -> None:
    later = broken("exhausts", "scale", 0.5, time=10.0)
    bed = Bed(broken(signal, "scale", 0.1, duration=0.02), later).run(10)
    expected = np.where(np.isin(np.arange(7), throttled), 0.1, 1.0)
    assert bed.plant.plant["exhaust"][0].tolist() == expected.tolist()
    bed.run(20)
    assert (bed.plant.plant == bed.faults.healthy_plant).all()


@pytest.mark.parametrize(("value", "stuck"), [(1.0, SHUT), (0.0, OPEN)])
def test_safety_relay_fault_sticks_at_either_end(value: float, stuck: int) -> None:
    bed = Bed(broken("safety relay", "stuck", value, duration=0.02)).run(10)
    assert bed.plant.plant["relay_stuck"] == stuck
    assert bed.run(20).plant.plant["relay_stuck"] == 0


def test_supply_fault_off_drifting_or_stuck_changes_supply() -> None:
    assert Bed(broken("supply", "off")).run().plant.plant["regulated"] == pytest.approx(1.013e5)
    bed = Bed(broken("supply", "drifting", -1e6)).run(100)
    assert bed.plant.plant["regulated"] == pytest.approx(8e5 - 1e6 * 0.099)
    bed = Bed(broken("supply", "stuck", 1.0), broken("vents", "stuck", 1.0))
    bed.command["supply_enable"] = bed.command["exhaust_closed"] = False
    bed.run(3)
    assert bed.faults.sent["supply_enable"][0]
    assert bed.faults.sent["exhaust_closed"][0]


@pytest.mark.parametrize("signal", ["emergency stop", "guard closed", "guard locked"])
def test_switch_fault_off_stuck_or_delayed_changes_reading(signal: str) -> None:
    name = {"emergency stop": "emergency_stop_clear"}.get(signal, signal.replace(" ", "_"))
    assert not Bed(broken(signal, "off")).run().readings[name][0]
    bed = Bed(broken(signal, "stuck")).run()
    bed.state[name] = False
    assert bed.run(10).readings[name][0]
    late = Bed(broken(signal, "delayed", 0.01)).run(20)
    late.state[name] = False
    assert late.run(10).readings[name][0]
    assert not late.run(1).readings[name][0]


def test_pressure_sensor_fault_changes_reading() -> None:
    faults = (
        broken("supply sensor", "off"),
        broken("shoulder vane A sensor", "scale", 0.5),
        broken("wrist cylinder B sensor", "offset", 1e4),
    )
    bed = Bed(*faults).run()
    true = bed.state["pressure"][0]
    assert bed.readings["supply_pressure"][0] == INVALID
    expected = true * [0.5, 1, 1, 1, 1, 1] + [0, 0, 0, 0, 0, 1e4]
    assert bed.readings["chamber_pressure"][0] == pytest.approx(expected)


def test_spool_feedback_broken_shows_something_else() -> None:
    faults = (
        broken("shoulder spool feedback", "off"),
        broken("arm spool feedback", "stuck", 0.7),
        broken("wrist spool feedback", "offset", 0.3),
    )
    bed = Bed(*faults, parameters=replace(FITTED, spool_feedback=True)).run()
    shoulder, arm, wrist = bed.readings["spool_position"][0]
    assert (shoulder, arm) == (INVALID, 0.7)
    assert wrist == pytest.approx(0.3, abs=0.006)
    assert np.isnan(Bed(*faults).run().readings["spool_position"]).all()  # not fitted


def test_link_fault_off_holds_readings_and_goes_passive() -> None:
    bed = Bed(broken("link", "off", time=0.05)).run(50)
    before = bed.readings.copy()
    bed.run(19)
    assert bed.faults.sent["supply_enable"][0]
    assert not bed.faults.device["passive"][0]
    for name in before.dtype.names:  # not the bytes: what lies between the fields is no reading
        assert bed.readings[name].tobytes() == before[name].tobytes(), name
    bed.run(2)
    assert bed.faults.device["passive"][0]
    assert not bed.faults.sent["supply_enable"][0]
    assert not bed.valve.any()
    assert not bed.run(50).readings["emergency_stop_clear"][0]
    revive(bed.faults)
    assert not bed.faults.device["passive"][0]


def test_link_fault_delayed_delays_both_directions() -> None:
    bed = Bed(broken("link", "delayed", 0.005)).run(30)
    assert bed.angle == pytest.approx(bed.true_angle - 0.005 * SPEED, abs=1e-4)
    bed.command["valve"] = 0.0
    assert bed.run(5).valve[0] == 0.5
    assert bed.run(1).valve[0] == 0.0


def test_loop_fault_off_makes_device_passive_after_watchdog() -> None:
    bed = Bed(broken("loop", "off", time=0.01), watchdog=0.005).run(10)
    assert bed.faults.device["loop_up"][0]
    assert not bed.run(4, spoken=False).faults.device["loop_up"][0]
    assert not bed.faults.device["passive"][0]
    assert bed.run(1, spoken=False).faults.device["passive"][0]


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [("off", nan, nan), ("stuck", nan, 2.0), ("offset", 0.5, 3.5), ("scale", 2.0, 4.0)],
)
def test_clock_fault_gives_expected_time(kind: str, value: float, expected: float) -> None:
    bed = Bed(broken("clock", kind, value)).run()
    faulty_time(bed.faults, 2.0)
    assert faulty_time(bed.faults, 3.0) == pytest.approx(expected, nan_ok=True)


def test_club_head_fault_off_leaves_shaft_only() -> None:
    bed = Bed(broken("club head", "off")).run(3)
    robot, club = bed.plant.robot[0], PlantParameters().robot.club
    assert robot["mass_c"] == pytest.approx(club.mass - club.head_mass)
    rest = club.shaft_mass * club.shaft_length / 2
    assert robot["mass_c"] * robot["com_c"] == pytest.approx(rest)
    assert 0.0 < robot["inertia_c"] < club.inertia
    assert not bed.state["ball_present"][0]


def test_fault_onset_by_time_acts_for_duration() -> None:
    bed = Bed(broken("shoulder valve", "off", time=0.02, after=0.01, duration=0.005))
    acted = [bed.run().valve[0] == 0.0 for _ in range(60)]
    assert np.flatnonzero(acted).tolist() == [30, 31, 32, 33, 34]


def test_fault_onset_by_phase_starts_in_phase() -> None:
    bed = Bed(broken("shoulder valve", "off", phase="top"))
    assert bed.run(5, Phase.BACKSWING).valve[0] == 0.5
    assert bed.run(1, Phase.TOP).valve[0] == 0.0
    assert bed.run(5, Phase.DOWNSWING).valve[0] == 0.0  # it stays broken


def test_fault_onset_by_joint_angle_starts_at_angle() -> None:
    bed = Bed(broken("shoulder valve", "off", joint="wrist", angle=REST[2] - 0.1))
    assert bed.run(20).valve[0] == 0.5
    assert bed.run(2).valve[0] == 0.0


def test_own_records_leave_original_plant_unchanged() -> None:
    plant = build_plant(PlantParameters())
    own = own_records(plant)
    own.plant["regulated"] = 0.0
    assert plant.plant["regulated"][0] > 0.0
    assert PLANT_STATE.names is not None
