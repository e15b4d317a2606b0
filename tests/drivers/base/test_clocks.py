"""The offset of the wall clock is not read wrongly where the thread is interrupted between the clocks."""

from __future__ import annotations

import time

import pytest

from drivers.base.clocks import WallOffset


def test_wall_offset_interrupted_reading_keeps_last_offset(monkeypatch: pytest.MonkeyPatch) -> None:
    offset, later = WallOffset(), 0
    monkeypatch.setattr(time, "monotonic_ns", lambda: 1_000 + later)

    def wall() -> int:
        nonlocal later
        later += delay
        return 5_000_000

    monkeypatch.setattr(time, "time_ns", wall)
    delay = 200
    assert offset.read() == 5_000_000 - 1_100
    delay = 160_000  # interrupted between the clocks
    assert offset.read() == 5_000_000 - 1_100
    delay = 0
    assert offset.read() == 5_000_000 - 1_000 - 160_200
