from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.lifecycle import Cause, Phase, State
from bench.shot.shot_matcher import FinishedSwing, SwingWatch
from bench.telemetry.shot_id import shot_id

Cycles = np.ndarray[Any, Any]


@pytest.fixture
def day(make_swing: Any) -> Cycles:
    """Return a swing with a ball between two rests, its ticks from 5000 and times from 0 on, 1 kHz."""
    cycles: Cycles = make_swing(1)
    cycles["state"] = State.SWINGING
    cycles["state"][:200], cycles["state"][-100:] = State.ARMED, State.RECOVERING
    cycles["trip"] = 0
    return cycles


def watched(watch: SwingWatch, cycles: Cycles, piece: int, *, behind: float) -> list[FinishedSwing]:
    """Return the swings seen in pieces, each read when its last cycle is `behind` on the wall's clock."""
    found = []
    for k in range(0, len(cycles), piece):
        part = cycles[k : k + piece]
        found += watch.take(part, float(part["time"][-1]) + behind)
    return found


@pytest.mark.parametrize("piece", [1, 7, 20, 5000])
def test_a_swing_has_one_id_its_impact_and_all_its_cycles(day: Cycles, piece: int) -> None:
    gone = day["time"][np.flatnonzero(day["ball_present"])[-1] + 1]
    for wall, behind in ((True, 0.004), (False, 4000.0)):
        (swing,) = watched(SwingWatch("run", wall=wall), day, piece, behind=behind)
        assert swing.shot == shot_id("run", 5200)
        assert swing.struck
        assert swing.impact == pytest.approx(gone + (0.0 if wall else behind), abs=1e-9)
        assert len(swing.cycles) == len(day) - 300 + 1  # and the one that ended it
        assert swing.cycles.tobytes() == day[200:-99].tobytes()


def test_in_step_with_the_plant_each_piece_has_its_own_place_on_the_clock(day: Cycles) -> None:
    watch, slipped = SwingWatch("run", wall=False), 0.0
    at = int(np.flatnonzero(day["ball_present"])[-1]) + 1
    found = []
    for k in range(0, len(day), 10):
        slipped += 0.03 if k == 700 else 0.0  # the machine stood still before the impact
        part = day[k : k + 10]
        found += watch.take(part, 100.0 + slipped + float(part["time"][-1]))
    (swing,) = found
    assert swing.impact == pytest.approx(100.03 + day["time"][at], abs=1e-9)


def test_a_swing_without_a_ball_and_one_that_was_stopped(day: Cycles) -> None:
    empty = day.copy()
    empty["ball_present"] = False
    (swing,) = watched(SwingWatch("run", wall=True), empty, 50, behind=0.0)
    assert not swing.struck
    assert swing.impact == empty["time"][np.flatnonzero(empty["phase"] == Phase.IMPACT)[0]]

    stopped = day[:900].copy()
    stopped["ball_present"] = True
    stopped["state"][800:], stopped["trip"][800:] = State.FAULT, Cause.OPERATOR_STOP
    stopped["phase"][800:] = Phase.STANDING
    (swing,) = watched(SwingWatch("run", wall=True), stopped, 50, behind=0.0)
    assert (swing.impact, swing.struck) == (None, False)
    assert swing.cycles["trip"][-1] == Cause.OPERATOR_STOP


def test_what_has_no_beginning_has_no_id(day: Cycles) -> None:
    assert watched(SwingWatch("run", wall=True), day[300:], 50, behind=0.0) == []
    watch = SwingWatch("run", wall=True)
    watch.take(day[:400], 0.4)
    assert watch.take(day[500:], 2.0, lost=True) == []
    assert len(watched(watch, day, 50, behind=0.0)) == 1  # the next one is whole again
