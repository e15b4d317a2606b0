"""The bench's arming is seen once for each time, wherever the ring is cut."""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np
import pytest

from bench.lifecycle import State
from bench.processes.launch_monitor import ArmingWatch

R, A, S = State.READY, State.ARMED, State.SWINGING


@pytest.mark.parametrize(
    ("states", "times"), [([R, R], 0), ([R, A, A], 1), ([A, A], 1), ([R, A, S, A, R, A], 3), ([S, S, R], 0)]
)
def test_each_arming_counts_once(states: list[State], times: int) -> None:
    cycles = np.zeros(len(states), [("state", "u1")])
    cycles["state"] = states
    each = ArmingWatch()
    assert sum(each.take(cycles[n : n + 1]) for n in range(len(states))) == times
    for cut in range(len(states) + 1):
        watch = ArmingWatch()
        edges = pairwise(accumulate([0, cut, len(states) - cut]))
        assert any([watch.take(cycles[start:end]) for start, end in edges]) is (times > 0)
