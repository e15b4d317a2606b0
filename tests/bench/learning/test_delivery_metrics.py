"""The planned delivery of a profile, which learning aims at."""

from __future__ import annotations

from dataclasses import replace
from math import asin, degrees, radians, sin

import pytest

from bench.base.errors import BenchError
from bench.config import load_configuration, shipped_configuration
from bench.learning.delivery import planned_figures
from bench.learning.learn import prepare
from bench.simulation.simulated_bench import Bench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

SHIPPED = load_configuration(shipped_configuration())
BENCH = Bench(SHIPPED.plant, load_profile(find_profile("average-male")), SHIPPED.control, SHIPPED.envelope)


def test_planned_figures_match_profile_delivery() -> None:
    planned, told = planned_figures(BENCH).shown, BENCH.profile.delivery
    assert planned["head_speed_mps"] == pytest.approx(told["head_speed_mps"], abs=0.001)
    assert planned["attack_angle_deg"] == pytest.approx(told["attack_angle_deg"], abs=0.001)
    assert planned["strike_mm"] == pytest.approx(told["in_plane_error_mm"], abs=0.001)
    assert planned["head_speed_mps"] == pytest.approx(41.57, abs=0.05)


def test_planned_figures_attack_angle_accounts_for_lie() -> None:
    rising = replace(BENCH.profile, delivery=BENCH.profile.delivery | {"path_slope_deg": 2.5})
    seen = planned_figures(BENCH._replace(profile=rising)).attack
    assert degrees(seen) == pytest.approx(
        degrees(asin(sin(radians(2.5)) * sin(BENCH.model.robot.lie))), abs=1e-9
    )


def test_planned_figures_profile_without_delivery_is_refused() -> None:
    without = BENCH._replace(profile=replace(BENCH.profile, delivery={}))
    for aimed in (planned_figures, prepare):
        with pytest.raises(BenchError, match="in_plane_error_mm"):
            aimed(without)
