"""Limits made from drawn robots: above all that healthy ones show, and refused where healthy ones stop."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Cause
from bench.control.estimate.residual_monitor import KINDS, LEARNING
from bench.control.residual_thresholds import FROM_SETTINGS, REQUIRED
from bench.control.settings import MODEL_ROWS, ModelSettings
from bench.design.threshold_generation import (
    FLOORS,
    _rounded,
    _tables,
    floor_of,
    gumbel_quantile,
    make_limits,
)
from bench.simulation.plant_variation import HealthyRun
from bench.simulation.simulated_bench import Bench
from bench.swing.profile import Profile
from tests.compiled_only import needs_speed


def test_gumbel_quantile_matches_gumbel_distribution() -> None:
    maxima = np.random.default_rng(1).gumbel(3.0, 0.5, (200_000, 2))
    expected = 3.0 - 0.5 * np.log(-np.log1p(-1e-6))
    assert gumbel_quantile(maxima) == pytest.approx([expected, expected], rel=0.02)


def largest(n: int) -> np.ndarray:
    made = np.zeros((n, len(KINDS), LEARNING, 3))
    made[:, :, MODEL_ROWS["hold"]] = 1e6 + np.linspace(0.0, 1e3, n)[:, None, None]
    return made


def test_tables_limit_exceeds_largest_residual() -> None:
    made = largest(50)
    made[7, 0, MODEL_ROWS["hold"], 1] = 5e7
    table = _tables(made, "")["air"]
    assert table["hold"][1] >= 1.25 * 5e7
    assert 1.25e6 <= table["hold"][0] < 1.3e6


def test_tables_apply_floor_and_skip_rows_with_few_runs() -> None:
    made = largest(50)
    made[:, :, MODEL_ROWS["top"]] = 1e-6
    made[:3, :, MODEL_ROWS["braking_top"]] = 9e9
    tables = _tables(made, "learning_")
    for kind in KINDS:
        assert tables[kind]["learning_top"] == floor_of(kind, "learning_top")
        assert floor_of(kind, "top") == floor_of(kind, "learning_braking_top") == FLOORS[kind]
        assert "learning_braking_top" not in tables[kind]
        assert tables[kind]["learning_impact"] == tables[kind]["learning_hold"]
        assert {f"learning_{row}" for row in REQUIRED} <= tables[kind].keys()
        assert not {f"learning_{row}" for row in FROM_SETTINGS} & tables[kind].keys()


def test_rounded_rounds_up() -> None:
    assert _rounded(np.array([12345.0, 0.001, 99.99])) == (12400.0, 0.001, 100.0)


def test_floor_of_learning_row_depends_on_phase_and_kind() -> None:
    assert floor_of("air", "learning_hold") == ModelSettings().air["hold"]
    assert floor_of("air", "learning_downswing") == FLOORS["air"]
    assert floor_of("velocity", "learning_impact") == FLOORS["velocity"]
    assert floor_of("jump", "learning_downswing") == ModelSettings().jump["downswing"]


@needs_speed
def test_make_limits_healthy_robots_stopped_refuses(default_profile: Profile) -> None:
    valve = default_profile.valve.copy()
    valve[1000:1300, 0] = 1.0
    broken = default_profile.__class__(**{**default_profile.__dict__, "valve": valve})
    with pytest.raises(Refused, match="healthy robots stopped"):
        make_limits(Bench(broken), draws=4)


def test_make_limits_ground_contact_suggests_divot(
    default_profile: Profile, monkeypatch: pytest.MonkeyPatch
) -> None:
    causes = [Cause.NONE, Cause.ARM_EFFORT, *[Cause.GROUND] * 3]
    stopped = [HealthyRun(np.zeros(1), cause, 0, ()) for cause in causes]
    monkeypatch.setattr("bench.design.threshold_generation._drawn", lambda *_: stopped)
    with pytest.raises(Refused, match="4 of 5 healthy robots stopped: club head") as refused:
        make_limits(Bench(default_profile), draws=5)
    assert "divot" in refused.value.action
