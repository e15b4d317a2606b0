"""The bench's arming is seen once for each time, wherever the ring is cut."""

from __future__ import annotations

from itertools import accumulate, pairwise

import numpy as np
import pytest

from bench.base.lifecycle import State
from bench.supervisor.launch_monitor import ArmingMonitor, ShotPresence

R, A, S = State.READY, State.ARMED, State.SWINGING


@pytest.mark.parametrize(
    ("states", "times"), [([R, R], 0), ([R, A, A], 1), ([A, A], 1), ([R, A, S, A, R, A], 3), ([S, S, R], 0)]
)
def test_arming_monitor_each_arming_counts_once(states: list[State], times: int) -> None:
    cycles = np.zeros(len(states), [("state", "u1")])
    cycles["state"] = states
    each = ArmingMonitor()
    assert sum(each.take(cycles[n : n + 1]) for n in range(len(states))) == times
    for cut in range(len(states) + 1):
        watch = ArmingMonitor()
        edges = pairwise(accumulate([0, cut, len(states) - cut]))
        assert any([watch.take(cycles[start:end]) for start, end in edges]) is (times > 0)


def test_shot_presence_without_struck_ball_is_present() -> None:
    presence = ShotPresence()
    assert presence.is_present(None, 1e6)
    assert presence.is_present(10.0, 1e6)


def test_shot_presence_unanswered_ball_is_absent_until_monitor_seen() -> None:
    presence = ShotPresence()
    for impact in (100.0, 110.0, 215.0):
        presence.note_struck(impact)
        assert presence.is_present(90.0, impact + 5.0)
    assert not presence.is_present(90.0, 220.1)  # since the first of them
    assert not presence.is_present(None, 220.1)
    assert presence.is_present(221.0, 222.0)
    assert presence.is_present(221.0, 1e6)


def test_shot_presence_answered_ball_restarts_timeout() -> None:
    presence = ShotPresence()
    presence.note_struck(100.0)
    assert presence.is_present(101.0, 105.0)
    presence.note_struck(300.0)
    assert presence.is_present(101.0, 420.0)
    assert not presence.is_present(101.0, 420.1)
