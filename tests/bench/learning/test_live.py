"""A running bench as a learner's robot: values read from its records, and which bench it takes."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Answer, Request
from bench.learning.live import require_bench, swung_cycles
from bench.network.bench_service import LaunchMonitorStatus
from bench.records.telemetry.cycle_record import CYCLE
from bench.supervisor.status import NO_LAUNCH_MONITOR
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.bench.fake_bench_service import FakeDesk

PROFILE = load_profile(find_profile("default"))


def record(ticks: list[int], swing: int) -> np.ndarray:
    cycles = np.zeros(len(ticks), CYCLE)
    cycles["tick"] = ticks
    cycles["angle"] = np.array(ticks)[:, None]
    accepted = cycles["tick"] == swing
    cycles["request"][accepted], cycles["answer"][accepted] = Request.SWING, Answer.ACCEPTED
    return cycles


def test_swung_cycles_start_at_accepted_swing_tick_and_keep_rows() -> None:
    cycles, missing = swung_cycles(record(list(range(50, 90)), 60), 20)
    assert cycles["tick"].tolist() == list(range(60, 80))
    assert not missing.any()
    cycles, missing = swung_cycles(record([t for t in range(50, 90) if t not in (65, 66)], 60), 20)
    assert np.flatnonzero(missing).tolist() == [5, 6]
    assert np.isnan(cycles["angle"][[5, 6]]).all()
    assert cycles["angle"][7, 0] == 67


def test_swung_cycles_short_record_marks_end_missing() -> None:
    _, missing = swung_cycles(record(list(range(50, 70)), 60), 20)
    assert np.flatnonzero(missing).tolist() == list(range(10, 20))


def test_swung_cycles_record_without_swing_raises_error() -> None:
    with pytest.raises(ValueError, match="no swing begins"):
        swung_cycles(record(list(range(10)), 99), 5)


def test_require_bench_other_profile_is_refused() -> None:
    status = FakeDesk().status()
    require_bench(status, PROFILE, "encoders+model")
    with pytest.raises(Refused, match="it swings driver-90mph"):
        require_bench({**status, "profile": "driver-90mph"}, PROFILE, "encoders+model")


def test_require_bench_impact_marks_on_machine_are_refused() -> None:
    status = FakeDesk().status()
    require_bench({**status, "driver": "sim"}, PROFILE, "impact-marks")
    with pytest.raises(Refused, match="impact marks"):
        require_bench({**status, "driver": "canopen"}, PROFILE, "impact-marks")


def test_require_bench_absent_launch_monitor_is_refused() -> None:
    status = FakeDesk().status()
    with pytest.raises(Refused, match="launch monitor"):
        require_bench(status, PROFILE, "launch-monitor")
    away = LaunchMonitorStatus(**NO_LAUNCH_MONITOR)
    with pytest.raises(Refused, match="not connected"):
        require_bench({**status, "launch_monitor": away}, PROFILE, "launch-monitor")
    require_bench({**status, "launch_monitor": {**away, "present": True}}, PROFILE, "launch-monitor")
