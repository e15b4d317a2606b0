"""Reports of the supervisor: stalls, disarming, state for the next run, systemd."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import CAUSE_TEXT, REFUSAL_WORDS, Cause, Phase, Refusal, Request, State
from bench.control.monitor.pressure_monitor import FAULTS
from bench.network.bench_service import WearFinding
from bench.records.telemetry.cycle_record import CYCLE
from bench.supervisor.status import (
    RunMarker,
    StoredWear,
    cause_text,
    disarmed_for,
    notify_service,
    refusal_words,
    stall_note,
    supervisor_note,
    watchdog_interval,
    wear_file,
    write_wear,
)

# Stalls ----------------------------------------------------------------------------------------------

LOST_TIME, PERIOD = 0.0045, 0.001


def records() -> np.ndarray:
    """Return ten records of a loop in step, all encoders read."""
    cycles = np.zeros(10, CYCLE)
    cycles["measured_step"], cycles["encoder_valid"], cycles["encoder_age"] = PERIOD, 1, 2e-4
    return cycles


def note(cycles: np.ndarray, cause: Cause = Cause.SHOULDER_ENCODER) -> str:
    return stall_note(cycles, cause, LOST_TIME, PERIOD)


def test_stall_note_loop_stall_names_duration() -> None:
    cycles = records()
    cycles["measured_step"][-1], cycles["encoder_age"][-1] = 0.0083, 0.009
    assert "the loop stood still for 8.3 ms" in note(cycles)
    assert note(cycles, Cause.WRIST_FOLLOWING) == ""
    assert cause_text(Cause.GUARD, "") == CAUSE_TEXT[Cause.GUARD]


@pytest.mark.parametrize(
    ("last", "added"),
    [
        (5, np.linspace(0.001, 0.005, 5)[:, None]),
        (5, np.linspace(-0.001, 0.0033, 5)[:, None] + [0.0, 0.0, 0.001]),  # one a tick before the others
        (3, np.array([[0.003] * 3, [0.004] * 3, [0.0, 0.005, 0.005]])),  # one back in the last tick
        (10, np.where(np.arange(10) == 2, np.nan, np.linspace(0.004, 0.0052, 10))[:, None]),  # in all records
    ],
)
def test_stall_note_all_encoders_lost_names_all_three(last: int, added: np.ndarray) -> None:
    cycles = records()
    cycles["encoder_age"][-last:] += added
    assert "all three encoders were lost at once" in note(cycles, Cause.WRIST_ENCODER)


@pytest.mark.parametrize("lost", [0, 2])
def test_stall_note_one_encoder_lost_is_empty(lost: int) -> None:
    cycles = records()
    cycles["encoder_valid"][-5:, lost] = 0
    assert note(cycles, Cause(Cause.SHOULDER_ENCODER + lost)) == ""


def test_stall_note_jump_after_one_missed_tick_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"] = -5e-5  # sampled at the tick, as over CANopen
    cycles["encoder_age"][-2, 0] += 0.001
    assert note(cycles, Cause.SHOULDER_JUMP) == "", "one encoder alone is its own"
    cycles["encoder_age"][-2] = 0.00096
    assert "all three encoders were late at once" in note(cycles, Cause.SHOULDER_JUMP)
    cycles["encoder_age"][-2], cycles["encoder_age"][-6] = -5e-5, 0.00096
    assert note(cycles, Cause.SHOULDER_JUMP) == "", "six ticks before it explains no jump"


def test_stall_note_jump_after_stall_names_stall() -> None:
    cycles = records()
    assert note(cycles, Cause.ARM_JUMP) == ""
    cycles["encoder_age"][-3, 1] = 0.004
    assert note(cycles, Cause.ARM_JUMP) == "", "one encoder alone is its own"
    cycles["encoder_age"][-3] = 0.004
    assert "all three encoders were late at once" in note(cycles, Cause.ARM_JUMP)
    cycles["measured_step"][-4] = 0.006
    assert "the loop stood still for 6.0 ms" in note(cycles, Cause.ARM_JUMP)


def test_stall_note_homing_failed_names_stall_anywhere_in_homing() -> None:
    cycles = np.concatenate([records() for _ in range(5)])
    cycles["measured_step"][3] = 0.0083  # before the homing
    cycles["phase"][10:] = Phase.HOMING
    assert note(cycles, Cause.HOMING_FAILED) == ""
    assert note(cycles[:10], Cause.HOMING_FAILED) == ""
    cycles["measured_step"][20] = 0.0083
    assert "the loop stood still for 8.3 ms while homing" in note(cycles, Cause.HOMING_FAILED)


def test_stall_note_device_fault_takes_precedence() -> None:
    cycles = records()
    cycles["encoder_valid"][-5:, 0] = 0
    fault = "node 1 has left the operational state: another master has commanded it"
    for cause in (Cause.SHOULDER_ENCODER, Cause.DEVICE_PASSIVE):
        assert stall_note(cycles, cause, LOST_TIME, PERIOD, fault) == fault
    assert stall_note(cycles, Cause.GUARD, LOST_TIME, PERIOD, fault) == ""


def test_stall_note_passive_device_after_late_loop_reports_stall() -> None:
    """A node whose timer has expired reports an error: 8130h."""
    cycles, fault = records(), "node 13 reports error 8130h, register 11h"
    assert stall_note(cycles, Cause.DEVICE_PASSIVE, LOST_TIME, PERIOD, fault) == fault
    cycles["measured_step"][-3] = 0.061
    text = stall_note(cycles, Cause.DEVICE_PASSIVE, LOST_TIME, PERIOD, fault)
    assert text.startswith(f"{fault}, after the loop stood still for 61.0 ms")
    assert stall_note(cycles, Cause.DEVICE_PASSIVE, LOST_TIME, PERIOD) == ""


def test_refusal_words_device_fault_takes_precedence() -> None:
    fault = "another master has commanded node 1"
    assert refusal_words(Refusal.READINGS, fault, 0) == ("an encoder yields no valid readings", fault)
    assert refusal_words(Refusal.READINGS, "", 0) == REFUSAL_WORDS[Refusal.READINGS]
    assert refusal_words(Refusal.GUARD, fault, 0) == REFUSAL_WORDS[Refusal.GUARD]


def test_refusal_words_not_vented_names_slow_exhaust() -> None:
    """Waiting ends no access that is refused for a throttled exhaust or for a sensor above the atmosphere."""
    slow = 1 << FAULTS.index(Cause.ARM_B_EXHAUST)
    other = 1 << FAULTS.index(Cause.GUARD_LOCK)
    fact, action = refusal_words(Refusal.NOT_VENTED, "", slow | other)
    assert fact == "right arm chamber B vents too slowly"
    assert "hand valve" in action
    assert "sensor's zero" in action
    assert refusal_words(Refusal.NOT_VENTED, "", other) == REFUSAL_WORDS[Refusal.NOT_VENTED]
    assert refusal_words(Refusal.GUARD, "", slow) == REFUSAL_WORDS[Refusal.GUARD]


def test_cause_text_stall_note_replaces_action() -> None:
    text = cause_text(Cause.SHOULDER_ENCODER, "the loop stood still")
    assert text == "shoulder encoder R1 without a valid reading: the loop stood still"


def test_supervisor_note_stall_names_duration() -> None:
    found = supervisor_note(Cause.SUPERVISOR, 0.62, 0.5)
    assert "the supervisor stood still for 0.6 s" in found
    text = cause_text(Cause.SUPERVISOR, found)
    assert text.startswith("no heartbeat from the supervisor: the supervisor stood still")


def test_supervisor_note_without_stall_is_empty() -> None:
    assert not supervisor_note(Cause.SUPERVISOR, 0.02, 0.5)
    assert not supervisor_note(Cause.GUARD, 0.62, 0.5)


# Disarming -------------------------------------------------------------------------------------------


def cycle(state: State, **values: object) -> Any:
    record = np.zeros(1, CYCLE)[0]
    record["state"], record["lease_held"], record["support_ready"] = state, True, True
    for name, value in values.items():
        record[name] = value
    return record


@pytest.mark.parametrize(
    ("before", "after", "values", "cause"),
    [
        (State.ARMED, State.READY, {"lease_held": False}, Cause.LEASE),
        (State.ARMED, State.RECOVERING, {"lease_held": False}, Cause.LEASE),
        (State.HOMING, State.SAFE, {"lease_held": False}, Cause.LEASE),
        (State.RECOVERING, State.READY, {"lease_held": False}, Cause.LEASE),
        (State.ARMED, State.READY, {"support_ready": False}, Cause.SUPPORT),
        (State.ARMED, State.READY, {}, Cause.ARMED_TIME),
        (State.HOMING, State.READY, {}, Cause.NONE),
        (State.ARMED, State.READY, {"request": Request.DISARM}, Cause.NONE),
        (State.ARMED, State.FAULT, {"cause": Cause.OPERATOR_STOP, "lease_held": False}, Cause.NONE),
        (State.ARMED, State.SWINGING, {}, Cause.NONE),
        (State.RECOVERING, State.READY, {}, Cause.NONE),
        (State.ARMED, State.ARMED, {"lease_held": True}, Cause.NONE),
    ],
)
def test_disarmed_for_state_change_names_cause(
    before: State, after: State, values: dict[str, object], cause: Cause
) -> None:
    assert disarmed_for(cycle(after, **values), before, series=True) is cause


def test_disarmed_for_venting_after_single_swing_names_no_cause() -> None:
    vents = cycle(State.READY, lease_held=False)
    assert disarmed_for(vents, State.RECOVERING, series=False) is Cause.NONE


# State kept between two runs -------------------------------------------------------------------------


def run(folder: Path, *, clean: bool, stop: dict[str, str] | None = None, fatal: bool = False) -> RunMarker:
    marker = RunMarker(folder, "b1")
    marker.begin(1234, "2026-01-02T03:04:05+00:00")
    marker.note_state("SWINGING", "TOP")
    if stop is not None:
        marker.note_stop(stop, fatal=fatal)
    marker.end(clean=clean)
    return marker


def reread(folder: Path) -> RunMarker:
    marker = RunMarker(folder, "b1")
    marker.end(clean=False)
    return marker


def test_run_marker_first_run_has_no_last_stop(tmp_path: Path) -> None:
    first = run(tmp_path, clean=True)
    assert (first.was_killed, first.last_stop) == (False, None)


def test_run_marker_clean_end_reports_no_kill(tmp_path: Path) -> None:
    run(tmp_path, clean=True, stop={"cause": "GUARD"})
    after = reread(tmp_path)
    assert (after.was_killed, after.last_stop) == (False, {"cause": "GUARD"})


def test_run_marker_unclean_end_reports_restart(tmp_path: Path) -> None:
    run(tmp_path, clean=False)
    after = reread(tmp_path)
    assert after.was_killed
    assert after.last_stop is not None
    assert after.last_stop["cause"] == "RESTART"
    assert "supervisor was killed" in after.last_stop["text"]
    assert (after.last_stop["state"], after.last_stop["phase"]) == ("SWINGING", "TOP")


def test_run_marker_fatal_stop_is_kept_across_runs(tmp_path: Path) -> None:
    stop = {"cause": "RESTART", "text": "the loop killed by SIGKILL in phase DOWNSWING"}
    run(tmp_path, clean=False, stop=stop, fatal=True)
    after = run(tmp_path, clean=True)
    assert (after.was_killed, after.last_stop) == (True, stop)
    assert reread(tmp_path).last_stop == stop


@pytest.mark.parametrize("garbage", ["", "{", "[]", "\0" * 100, '{"running": {"a": 1}}'])
def test_run_marker_invalid_file_is_replaced(tmp_path: Path, garbage: str) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "b1.json").write_text(garbage)
    reread(tmp_path)
    run(tmp_path, clean=True)
    assert json.loads((tmp_path / "state" / "b1.json").read_text())["running"] is False


def test_run_marker_unusable_state_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    with pytest.raises(BenchError, match="state"):
        RunMarker(tmp_path, "b1")


def worn(folder: Path) -> tuple[list[WearFinding], str]:
    """Return findings and fault that a bench reads."""
    marker = RunMarker(folder, "b1")
    marker.look_for_wear()
    marker.end(clean=False)
    return marker.wear, marker.wear_fault


def test_run_marker_reads_findings_of_wear(tmp_path: Path) -> None:
    assert worn(tmp_path) == ([], "")
    finding = WearFinding(part="wrist valve", text="wrist valve: worn. Clean it.", time_utc="2026-01-02")
    write_wear(wear_file(tmp_path, "b1"), StoredWear(finding["time_utc"], [finding]))
    assert worn(tmp_path) == ([finding], "")
    write_wear(wear_file(tmp_path, "b1"), StoredWear(finding["time_utc"], []))
    assert worn(tmp_path) == ([], "")


@pytest.mark.parametrize(
    "garbage",
    [
        "",
        "[]",
        "[" * 100_000,
        '{"version": 2}',
        '{"version": 1, "time_utc": "", "findings": [{"part": "x"}]}',
        "ÿ",
    ],
)
def test_run_marker_invalid_wear_file_is_named(tmp_path: Path, garbage: str) -> None:
    wear_file(tmp_path, "b1").parent.mkdir()
    wear_file(tmp_path, "b1").write_text(garbage, encoding="latin-1")
    findings, fault = worn(tmp_path)
    assert not findings
    assert str(wear_file(tmp_path, "b1")) in fault


# systemd ---------------------------------------------------------------------------------------------


@pytest.fixture(params=["path", "abstract"])
def service_manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """A socket as systemd's, and its name as it stands in NOTIFY_SOCKET."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@golfbench-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(name.replace("@", "\0", 1))
        listener.settimeout(5.0)
        yield listener, name


def test_notify_service_message_arrives_unchanged(service_manager: tuple[socket.socket, str]) -> None:
    listener, name = service_manager
    assert notify_service("READY=1\nSTATUS=state ESTOP", {"NOTIFY_SOCKET": name})
    assert listener.recv(4096) == b"READY=1\nSTATUS=state ESTOP"


@pytest.mark.parametrize("address", [None, "", "relative/path", "vsock:2:1234"])
def test_notify_service_without_socket_sends_nothing(address: str | None) -> None:
    assert not notify_service("READY=1", {} if address is None else {"NOTIFY_SOCKET": address})


@pytest.mark.parametrize("name", ["/nonexistent/notify", "/" + "x" * 200, "@nobody-listens-here"])
def test_notify_service_missing_socket_returns_false(name: str) -> None:
    assert not notify_service("WATCHDOG=1", {"NOTIFY_SOCKET": name})


def test_notify_service_full_queue_does_not_block(service_manager: tuple[socket.socket, str]) -> None:
    listener, name = service_manager
    environment = {"NOTIFY_SOCKET": name}
    sent = sum(notify_service("WATCHDOG=1", environment) for _ in range(10_000))
    assert 0 < sent < 10_000  # the queue was full, and no call waited or raised
    messages = [listener.recv(64) for _ in range(sent)]
    assert set(messages) == {b"WATCHDOG=1"}
    assert notify_service("WATCHDOG=1", environment)


@pytest.mark.parametrize(
    ("environment", "interval"),
    [
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "42"}, 2.0),
        ({"WATCHDOG_USEC": "500000"}, 0.5),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "41"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-5"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": ""}, None),
        ({}, None),
    ],
)
def test_watchdog_interval_reads_environment(environment: dict[str, str], interval: float | None) -> None:
    assert watchdog_interval(environment, 42) == interval
