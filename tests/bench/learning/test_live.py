"""A running bench as a learner's robot: what is read out of its records, and which bench it takes."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from bench.errors import Refused
from bench.learning.learn import LearningProblem
from bench.learning.live import LiveSwinger, require_bench, swung_cycles
from bench.lifecycle import Answer, Refusal, Request
from bench.network.bench_service import BenchStatus, LaunchMonitorStatus
from bench.network.client import BenchClient, CommandRefused
from bench.network.command import CommandAnswer, Verb
from bench.processes.status import NO_LAUNCH_MONITOR
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from bench.telemetry.cycle_record import CYCLE
from tests.bench.fake_bench_service import FakeDesk

PROFILE = load_profile(find_profile("default"))


def record(ticks: list[int], swing: int) -> np.ndarray:
    cycles = np.zeros(len(ticks), CYCLE)
    cycles["tick"] = ticks
    cycles["angle"] = np.array(ticks)[:, None]
    accepted = cycles["tick"] == swing
    cycles["request"][accepted], cycles["answer"][accepted] = Request.SWING, Answer.ACCEPTED
    return cycles


def test_a_swing_begins_with_the_tick_in_which_it_was_accepted() -> None:
    cycles, missing = swung_cycles(record(list(range(50, 90)), 60), 20)
    assert cycles["tick"].tolist() == list(range(60, 80))
    assert not missing.any()


def test_a_tick_that_is_missing_keeps_its_place() -> None:
    ticks = [t for t in range(50, 90) if t not in (65, 66)]
    cycles, missing = swung_cycles(record(ticks, 60), 20)
    assert np.flatnonzero(missing).tolist() == [5, 6]
    assert np.isnan(cycles["angle"][[5, 6]]).all()
    assert cycles["angle"][7, 0] == 67


def test_a_record_that_ends_early_misses_its_end() -> None:
    _, missing = swung_cycles(record(list(range(50, 70)), 60), 20)
    assert np.flatnonzero(missing).tolist() == list(range(10, 20))


def test_a_record_without_a_swing_is_refused() -> None:
    with pytest.raises(ValueError, match="no swing begins"):
        swung_cycles(record(list(range(10)), 99), 5)


def test_only_the_bench_that_swings_the_profile_learns_it() -> None:
    status = FakeDesk().status()
    require_bench(status, PROFILE, "encoders+model")
    with pytest.raises(Refused, match="it swings driver-90mph"):
        require_bench({**status, "profile": "driver-90mph"}, PROFILE, "encoders+model")


def test_a_launch_monitor_that_is_not_there_tells_nothing() -> None:
    status = FakeDesk().status()
    with pytest.raises(Refused, match="launch monitor"):
        require_bench(status, PROFILE, "launch-monitor")
    away = LaunchMonitorStatus(**NO_LAUNCH_MONITOR)
    with pytest.raises(Refused, match="not connected"):
        require_bench({**status, "launch_monitor": away}, PROFILE, "launch-monitor")
    require_bench({**status, "launch_monitor": {**away, "present": True}}, PROFILE, "launch-monitor")


class SwayingBench:
    """Rests at its address by its status; its loop sees it sway for `sways` requests."""

    bench = "swaying"

    def __init__(self, sways: int) -> None:
        self.asked: list[str] = []
        self._sways = sways
        standing = {"state": "ARMED", "phase": "HOLD", "driver": "sim", "profile": PROFILE.name}
        self._status = cast(BenchStatus, {**FakeDesk().status(), **standing, "time": 0.0, "tick": 0})

    def status(self) -> BenchStatus:
        self._status["time"] += 2.0
        self._status["tick"] += 2000
        return self._status

    def lease(self, holder: str, seconds: float) -> AbstractContextManager[None]:
        return nullcontext()

    def correct(self, profile: str, weights: list[float]) -> None:
        self.asked.append("correct")

    def swing(self) -> None:
        self.asked.append("swing")
        if self._sways:
            self._sways -= 1
            raise CommandRefused(self.bench, Verb.SWING, SWAYS)


SWAYS = CommandAnswer(False, "ARMED", Refusal.NOT_AT_ADDRESS.name, reason="the robot does not rest")


def swinger(bench: SwayingBench) -> LiveSwinger:
    problem = cast(LearningProblem, SimpleNamespace(bench=SimpleNamespace(profile=PROFILE)))
    client = cast(BenchClient, bench)
    return LiveSwinger(client, problem, "encoders+model", lambda text: None, with_ball=False)


def test_a_swing_refused_while_the_robot_sways_is_requested_again() -> None:
    """Re-armed after a stopped swing it may still sway when its status says HOLD."""
    bench = SwayingBench(sways=2)
    source = swinger(bench)
    tick = source._begin(np.zeros(3))
    assert bench.asked == ["correct", "swing"] * 3
    assert tick == bench._status["tick"]


def test_a_swing_refused_for_longer_than_the_time_out_ends_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.learning.live._READY", 0.2)
    bench = SwayingBench(sways=1000)
    source = swinger(bench)
    with pytest.raises(CommandRefused, match="does not rest"):
        source._begin(np.zeros(3))
