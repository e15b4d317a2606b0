"""Monitors as they are sold: the simulated one, through a proxy that rewrites its messages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, Literal

import pytest

from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_matcher import FinishedSwing, SettledOutcome, ShotMatcher
from drivers.base import Launch
from drivers.launch_monitor.record import MatchOutcome, MatchWindow
from drivers.launch_monitor.server import LaunchMonitorServer
from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.plant import PlantParameters, Site
from sim.simulated_monitor import ClubMotion, MonitorParameters, SimulatedMonitor
from tests.bench.conftest import BALL
from tests.drivers.launch_monitor.proxy import DIALECTS, Proxy

LAUNCH, CLUB, CARRY = Launch(52.0, 0.2, 0.01, 300.0, 0.02), ClubMotion(36.0, 0.03), 150.0
EXACT = MonitorParameters(0.0, 0.0, 0.0, 0.0, 0.0, delay=0.0, delay_spread=0.0, club=True)
SHOTS = 5


@pytest.fixture
def server(request: pytest.FixtureRequest) -> Iterator[LaunchMonitorServer]:
    presence: Literal["connected", "per_shot"]
    presence = "per_shot" if DIALECTS[request.getfixturevalue("dialect")].per_shot else "connected"
    # The first shot may compile for longer than the usual silence.
    made = LaunchMonitorServer(LaunchMonitorSettings(presence=presence, silence=3600.0), port=0)
    made.open()
    made.announce_player("DR")
    yield made
    made.close()


@pytest.mark.parametrize("dialect", DIALECTS)
def test_shot_matcher_each_monitor_dialect_gives_valid_shots(
    dialect: str, server: LaunchMonitorServer, robot: Any, make_swing: Any
) -> None:
    site = replace(Site(), ball_x=BALL[0], ball_y=BALL[1])
    plant = PlantParameters(robot=robot, site=site)
    book = ShotMatcher(MatchWindow(), plant, FlightConditions())
    cycles = make_swing(1)
    cycles["cause"] = 0
    proxy = Proxy(dialect, server.address[1])
    monitor = SimulatedMonitor(EXACT, "127.0.0.1", proxy.port)
    told: list[SettledOutcome] = []
    try:
        for number in range(SHOTS):
            impact = time.monotonic()
            book.note_swing(FinishedSwing(f"r-{number}", impact, True, cycles), datetime.now(UTC))
            monitor.see(LAUNCH, impact, CLUB, CARRY)
            deadline, counts = impact + 20.0, server.link().counts
            heard = counts.shots + counts.clubs + len(DIALECTS[dialect].messages(_tree()))
            while counts.shots + counts.clubs < heard:
                assert time.monotonic() < deadline, counts
                monitor.step(time.monotonic())
                time.sleep(0.002)
                counts = server.link().counts
            book.note_launches(server.take())
            book.note_asides(server.take_asides())
            told += book.settle(impact + MatchWindow().latest + 0.5)  # a swing each 8 s, without the wait
    finally:
        monitor.close()
        proxy.close()
    assert server.link().counts.refused == 0
    assert [(one.outcome, one.reason) for one in told] == [(MatchOutcome.MATCHED, "")] * SHOTS
    for one in told:
        assert one.shot is not None
        assert one.launch is not None
        assert one.shot.status is ShotStatus.VALID
        assert one.launch.launch == pytest.approx(LAUNCH, abs=1e-3)
        assert one.launch.carry == pytest.approx(CARRY, abs=1e-3)
        assert one.launch.club.speed == pytest.approx(CLUB.speed, abs=1e-3)
        attack = None if dialect == "metric" else pytest.approx(CLUB.attack_angle, abs=1e-4)
        assert one.launch.club.attack_angle == attack


def _tree() -> dict[str, Any]:
    return {"ShotNumber": 1, "BallData": {}, "ClubData": {"Speed": 1}, "ShotDataOptions": {}}
