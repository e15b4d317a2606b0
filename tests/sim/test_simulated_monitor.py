from __future__ import annotations

import json
import socket
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from math import radians
from unittest.mock import Mock

import numpy as np
import pytest

from drivers.base import Launch
from drivers.launch_monitor.conversation import add_doubts
from drivers.launch_monitor.open_connect import read_message
from drivers.launch_monitor.record import LaunchRecord, MatchOutcome, MatchWindow, SwingImpact, match
from drivers.launch_monitor.server import LaunchMonitorServer
from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.simulated_monitor import (
    MPH,
    RECONNECT,
    ClubMotion,
    MonitorParameters,
    SimulatedMonitor,
    monitor_messages,
)
from tests.drivers.launch_monitor.stream import serving

STRUCK = Launch(65.0, 0.2, 0.01, 300.0, -0.05)
EXACT = MonitorParameters(speed_noise=0.0, angle_noise=0.0, spin_noise=0.0, axis_noise=0.0)


@pytest.fixture
def server() -> Iterator[LaunchMonitorServer]:
    with serving() as made:
        yield made


def told(launch: Launch, number: int, parameters: MonitorParameters) -> list[LaunchRecord]:
    records = []
    for delay, message in monitor_messages(launch, number, parameters):
        record = read_message(message, delay)
        assert isinstance(record, LaunchRecord)
        records.append(add_doubts(record))
    return records


def test_monitor_messages_carry_has_noise_and_keeps_launch() -> None:
    noisy, exact = MonitorParameters(seed=3), replace(EXACT, carry_noise=0.0)
    assert told(STRUCK, 1, exact)[0].carry is None
    for launch, parameters, carry, tolerance in ((STRUCK, exact, 190.0, 1e-3), (STRUCK, noisy, 190.0, 5.0)):
        messages = monitor_messages(launch, 1, parameters, carry=carry)
        (record,) = [read_message(one.message, one.due) for one in messages]
        assert isinstance(record, LaunchRecord)
        assert record.carry == pytest.approx(carry, abs=tolerance)
        assert record.launch == told(launch, 1, parameters)[0].launch
    carries = []
    for number in range(200):
        for one in monitor_messages(STRUCK, number, noisy, carry=200.0):
            record = read_message(one.message, 0.0)
            assert isinstance(record, LaunchRecord)
            carries.append(record.carry or 0.0)
    assert np.std(carries) == pytest.approx(1.0, rel=0.2)


def test_monitor_messages_without_noise_give_exact_launch() -> None:
    (record,) = told(STRUCK, 1, EXACT)
    assert record.launch == pytest.approx(STRUCK, rel=1e-4)
    assert record.valid


def test_monitor_messages_with_club_report_club_motion() -> None:
    club = ClubMotion(43.0, -0.02)
    parameters = replace(EXACT, club=True)
    ((_, message),) = monitor_messages(STRUCK, 1, parameters, club)
    record = read_message(message, 0.0)
    assert isinstance(record, LaunchRecord)
    assert record.club[:2] == pytest.approx(club, rel=1e-3)
    assert monitor_messages(STRUCK, 1, EXACT, club) == monitor_messages(STRUCK, 1, EXACT)
    assert told(STRUCK, 2, replace(MonitorParameters(), club=True)) == told(STRUCK, 2, MonitorParameters())
    seen = [monitor_messages(STRUCK, n, replace(MonitorParameters(), club=True), club)[0] for n in range(300)]
    speeds = [json.loads(message)["ClubData"]["Speed"] * MPH for _, message in seen]
    assert np.std(speeds) == pytest.approx(MonitorParameters().speed_noise * club.speed, rel=0.15)


def test_monitor_messages_noise_has_set_deviation() -> None:
    p = MonitorParameters()
    launches = np.array([told(STRUCK, number, p)[0].launch for number in range(600)])
    spread = [p.speed_noise * 65, p.angle_noise, p.angle_noise, p.spin_noise * 300, p.axis_noise]
    assert np.std(launches, axis=0) == pytest.approx(spread, rel=0.12)
    assert np.all(np.abs(np.mean(launches, axis=0) - STRUCK) < 5 * np.array(spread) / 600**0.5)


@pytest.mark.parametrize(
    ("fault", "messages"), [("missing", 0), ("double", 2), ("repeated", 2), ("ghost", 2), ("misread", 1)]
)
def test_monitor_messages_fault_affects_set_share_only(fault: str, messages: int) -> None:
    faults = replace(MonitorParameters(), **{fault: 0.25})  # type: ignore[arg-type]
    clean = [monitor_messages(STRUCK, n, MonitorParameters()) for n in range(400)]
    faulty = [monitor_messages(STRUCK, n, faults) for n in range(400)]
    struck = [n for n in range(400) if clean[n] != faulty[n]]
    assert len(struck) == pytest.approx(100, abs=30)
    assert {len(faulty[n]) for n in struck} == {messages}
    assert faulty == [monitor_messages(STRUCK, n, faults) for n in range(400)]
    assert clean != [monitor_messages(STRUCK, n, MonitorParameters(seed=2)) for n in range(400)]


@pytest.mark.parametrize(("ball", "angle", "doubted"), [(0.63, 50, False), (0.65, 12, True), (0.7, 0, True)])
def test_add_doubts_smash_bound_follows_launch_angle(ball: float, angle: float, doubted: bool) -> None:
    shot = LaunchRecord(0.0, "x", 1, speed=30.0 * ball, launch_angle=radians(angle))
    assert bool(add_doubts(shot, 30.0).doubts) is doubted


def test_add_doubts_flags_misread_shots_only() -> None:
    for number in range(200):
        assert told(STRUCK, number, MonitorParameters())[0].valid
        assert not told(STRUCK, number, MonitorParameters(misread=1.0))[0].valid
        (blind,) = told(STRUCK, number, MonitorParameters(no_spin=1.0))
        assert "no spin" in blind.reason


def test_match_series_with_faults_gives_expected_outcomes() -> None:
    p = MonitorParameters(missing=0.1, double=0.1, repeated=0.1, ghost=0.05)
    swings, records, expected = [], [], Counter[MatchOutcome]()
    for n in range(300):
        impact = 100.0 * n
        swings.append(SwingImpact(f"shot {n}", impact))
        planned = monitor_messages(STRUCK, n, p)
        heard = [replace(record, time=impact + record.time) for record in told(STRUCK, n, p)]
        records += heard
        if not planned:
            expected[MatchOutcome.NO_LAUNCH] += 1
            continue
        expected[MatchOutcome.MATCHED] += 1
        for delay, message in planned[1:]:
            kind = MatchOutcome.REPEATED if message == planned[0].message else MatchOutcome.DOUBLE
            expected[MatchOutcome.NO_SWING if delay > 8.0 else kind] += 1
    decided = match(swings, records, 1e6, MatchWindow()).decided
    assert Counter(m.outcome for m in decided) == expected
    assert min(expected.values()) > 5  # each of them happened
    for found in decided:
        if (
            found.outcome is MatchOutcome.MATCHED
            and found.launch is not None
            and found.launch.number is not None
        ):
            assert found.shot == f"shot {found.launch.number // 2}"


def test_simulated_monitor_sends_shots_to_server(server: LaunchMonitorServer) -> None:
    monitor = SimulatedMonitor(replace(EXACT, delay=0.0), *server.address)
    try:
        monitor.see(STRUCK, 0.0)
        monitor.see(STRUCK, 0.0)
        records: list[LaunchRecord] = []
        deadline = time.monotonic() + 10.0
        while len(records) < 2 or monitor.answers.count(b"200") < 2:
            assert time.monotonic() < deadline
            monitor.step(1.0)
            records += server.take()
            time.sleep(0.001)
        assert [record.number for record in records] == [2, 4]
        assert (monitor.sent, monitor.waiting) == (2, 0)
        assert server.link().counts.statuses == 1
    finally:
        monitor.close()


def test_simulated_monitor_reconnects_after_server_outage(server: LaunchMonitorServer) -> None:
    address, now = server.address, 0.0
    monitor = SimulatedMonitor(EXACT, *address)
    again = LaunchMonitorServer(LaunchMonitorSettings(), port=address[1])
    try:
        deadline = time.monotonic() + 10.0
        while not all((server.link().connected, monitor.connected)):  # each learns of it by itself
            monitor.step(now)
            assert time.monotonic() < deadline
        server.close()
        while monitor.connected:
            monitor.step(now)
            assert time.monotonic() < deadline
        monitor.see(STRUCK, now)
        again.open()
        while not (records := again.take()):
            now += RECONNECT / 2
            monitor.step(now)
            time.sleep(0.005)
            assert time.monotonic() < deadline
        assert records[0].number == 2
    finally:
        monitor.close()
        again.close()


def test_monitor_parameters_invalid_share_raises() -> None:
    with pytest.raises(ValueError, match="missing"):
        MonitorParameters(missing=1.5)


def test_simulated_monitor_connection_drop_resends_shot(
    server: LaunchMonitorServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor, deadline = SimulatedMonitor(EXACT, *server.address), time.monotonic() + 10.0
    try:
        while not monitor.connected:
            monitor.step(0.0)
            assert time.monotonic() < deadline
        monitor.see(STRUCK, 0.0)
        with monkeypatch.context() as dropped:
            dropped.setattr(socket.socket, "send", Mock(side_effect=ConnectionResetError))
            monitor.step(9.0)
        assert (monitor.connected, monitor.sent, monitor.waiting) == (False, 0, 1)
        now = 9.0
        while not (records := server.take()):
            now += RECONNECT / 2
            monitor.step(now)
            assert time.monotonic() < deadline
        assert [record.number for record in records] == [2]
        assert (monitor.sent, monitor.waiting) == (1, 0)
    finally:
        monitor.close()
