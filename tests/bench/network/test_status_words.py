from __future__ import annotations

from typing import Any, cast

import pytest

from bench.base.lifecycle import Block, State
from bench.network.bench_service import BenchStatus, LaunchMonitorStatus, MonitorStatus
from bench.network.status_words import (
    CHECK_INPUTS,
    COMMANDS,
    HOMING_BLOCKED,
    absent_monitor_text,
    launch_monitor_text,
    next_command,
    next_step,
    warning_texts,
)
from bench.supervisor.status import NO_LAUNCH_MONITOR
from tests.bench.fake_bench_service import FakeDesk


def link(**changes: Any) -> LaunchMonitorStatus:
    return cast(LaunchMonitorStatus, {**NO_LAUNCH_MONITOR, **changes})


def test_launch_monitor_text_connected_monitors_lists_names() -> None:
    names = [
        MonitorStatus(address="::1", device=name, silent_s=0.0, ready=ready, ball_detected=None)
        for name, ready in (("radar", False), ("", None))
    ]
    assert launch_monitor_text(link(monitors=names)) == "radar (reports itself not ready), ::1"
    assert launch_monitor_text(link()) == "not connected"
    assert absent_monitor_text(link()) == "no launch monitor is connected"


@pytest.mark.parametrize(
    ("seen", "text"), [(None, "not seen so far"), (0.5, "seen within 1 min"), (61.0, "seen within 2 min")]
)
def test_launch_monitor_text_connection_per_shot_shows_last_seen(seen: float | None, text: str) -> None:
    status = link(presence="per_shot", seen_s=seen)
    assert launch_monitor_text(status) == f"connects per shot, {text}"
    assert absent_monitor_text(status).endswith(text)


def test_warning_texts_wear_finding_has_date_and_action() -> None:
    text = "wrist valve, dead band: worn. Clean it."
    finding = {"part": "wrist valve", "text": text, "time_utc": "2026-01-02T03:04:05+00:00"}
    status = cast(BenchStatus, {**FakeDesk().status(), "wear": [finding]})
    assert f"wear seen 2026-01-02, {text}" in warning_texts(status)


@pytest.mark.parametrize(
    ("code", "command"),
    [
        (Block.INPUTS, CHECK_INPUTS),
        (Block.UNREADABLE, "golfbench status"),
        (Block.CALIBRATION_EXPIRED, COMMANDS[State.SAFE]),
    ],
)
def test_next_command_in_safe_leads_to_what_blocks_homing(code: Block, command: str) -> None:
    block = {"code": code, "location": "inputs", "found": "never", "expected": "one", "action": "check"}
    status = cast(BenchStatus, {**FakeDesk(State.SAFE).status(), "arming_blocks": [block]})
    assert next_command(status) == command
    assert (next_step(status) == HOMING_BLOCKED) is (command != COMMANDS[State.SAFE])
