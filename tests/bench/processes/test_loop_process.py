"""Warm-up of the loop's process: ticks are measured until they keep to their share of the period."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.errors import Refused
from bench.processes.loop_process import WARM_UP, LoopProcess
from bench.processes.tick_timing import STAMPS

PERIOD_NS = 1_000_000


def warming(busy: int) -> Any:
    """Return a loop whose first `busy` ticks take 1.2 ms, the others 0.2 ms."""
    loop: Any = object.__new__(LoopProcess)
    marks = np.zeros(len(STAMPS), np.int64)
    loop.cycle = SimpleNamespace(marks=marks, state=SimpleNamespace(control={"warm": False}))
    loop.paced, loop._period_ns, loop.ticks = False, PERIOD_NS, 0

    def tick(clock: object) -> float:
        marks[:] = np.linspace(0, 1_200_000 if loop.ticks < busy else 200_000, len(marks))
        loop.ticks += 1
        return 0.0

    loop._tick = tick
    return loop


def test_a_machine_that_is_busy_at_the_start_is_measured_again() -> None:
    loop = warming(busy=3 * WARM_UP)
    loop._warm_up(None)
    assert loop.cycle.state.control["warm"]
    assert loop.ticks == 4 * WARM_UP
    assert loop.tick_ns == 200_000


def test_ticks_that_are_always_too_long_are_refused() -> None:
    loop = warming(busy=1_000_000)
    with pytest.raises(Refused, match=r"loop\.rate"):
        loop._warm_up(None)
    assert not loop.cycle.state.control["warm"]
    assert loop.ticks < 20 * WARM_UP
