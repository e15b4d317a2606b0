from __future__ import annotations

from typing import Any, cast

import pytest

from bench.network.bench_service import LaunchMonitorStatus, MonitorStatus
from bench.network.status_words import absent_monitor_text, launch_monitor_text
from bench.supervisor.status import NO_LAUNCH_MONITOR


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
