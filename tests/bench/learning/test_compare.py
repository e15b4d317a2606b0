"""Controllers compared: each row is its own controller on the same robot."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest

from bench.config import load_configuration
from bench.learning.compare import compare
from bench.learning.series import Bench
from bench.lifecycle import Cause
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)


def test_planned_openings_track_where_pids_alone_do_not() -> None:
    steady = load_configuration(Path("steady"))
    bench = Bench(steady.plant, load_profile(find_profile("steady")), steady.control)
    told: list[str] = []
    alone, damped, planned, learned = compare(bench, steady.plant, swings=1, told=told.append)
    assert told == [alone.controller, damped.controller, planned.controller, "learning"]
    assert planned.cause is learned.cause is Cause.NONE
    assert planned.figures.speed == pytest.approx(42.4, abs=1.0)
    assert learned.figures.speed == pytest.approx(42.4, abs=0.3)
    for row in (alone, damped):
        assert row.cause is not Cause.NONE or row.tracking.max() > 2 * planned.tracking.max()
    assert 0.0 < planned.air < 0.5
    assert 0.0 < planned.saturated < 1.0
