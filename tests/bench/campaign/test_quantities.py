"""The table of all quantities: valid shots only, balls and hits counted, the control ball last."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.campaign.report.findings import QUANTITIES, level_quantities
from bench.campaign.statistics.analysis import values_of
from bench.campaign.statistics.block_model import spread
from bench.records.shot.shot import ShotStatus
from tests.bench.campaign.plans import shipped_plan
from tests.benchmarks.campaign_statistics import Truth, campaign_shots


def test_level_quantities_cover_valid_shots_of_each_level() -> None:
    plan = shipped_plan("symmetry", design={"blocks": 6})
    shots = [replace(s, spin_rpm=2500.0 + s.shot, carry_side_m=0.1) for s in campaign_shots(plan, Truth(), 1)]
    mine = [n for n, shot in enumerate(shots) if shot.ball == "seam"]
    shots[mine[0]] = replace(shots[mine[0]], status=ShotStatus.EXCLUDED, reason="slow", spin_rpm=9000.0)
    shots[mine[1]] = replace(shots[mine[1]], status=ShotStatus.FAILED, reason="no ball")
    pole, seam, control = level_quantities(plan, shots)
    assert [one.name for one in (pole, seam, control)] == ["pole", "seam", "tour"]
    assert (control.control, pole.control) == (True, False)
    assert (pole.balls, pole.hits, pole.valid) == (6, 6, 6)
    assert (seam.balls, seam.hits, seam.valid) == (4, 5, 4)
    assert control.valid == 18
    assert set(pole.spreads) == set(QUANTITIES)
    assert seam.spreads["spin_rpm"].mean < 2600
    assert seam.spreads["ball_speed_mps"].n == 0
    _, values = values_of(plan, [shot for shot in shots if shot.ball == "pole"])
    assert pole.spreads["carry_m"].mean == pytest.approx(spread(values).mean)
