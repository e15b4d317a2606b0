"""A swing is relearned when its delivery has drifted, and only then."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role, Step
from bench.campaign.run._corrections import Drift, DriftDetector
from bench.records.shot.shot import ShotStatus
from tests.bench.campaign.plans import row_of, shipped_plan, with_values


@pytest.fixture(scope="module")
def plan() -> CampaignPlan:
    return shipped_plan("symmetry", learning={"refresh": True})


def step(block: int, swing: str = "default") -> Step:
    return Step(PlannedShot(Role.TEST, 1, block, 1, Arm(swing, "driver", "tour")), 1, Centre())


class Blocks:
    """Shots of block after block, with a delivery that the tests choose."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.drifts, self.random = DriftDetector(plan), np.random.default_rng(1)

    def block(
        self, number: int, speed: float, swing: str = "default", shots: int = 5, **changes: Any
    ) -> Iterator[Drift | None]:
        for _ in range(shots):
            yield self.drifts.before(step(number, swing))
            values = {
                "club_speed_mps": speed + 0.03 * self.random.standard_normal(),
                "attack_angle_deg": 1.0,
                "dynamic_loft_deg": 11.0,
                "strike_x_mm": 0.1 * self.random.standard_normal(),
                "strike_y_mm": -2.0,
            } | changes
            self.drifts.note(row_of(step(number, swing).trial, 1, **values))


def test_drift_detector_scatter_reports_no_drift(plan: CampaignPlan) -> None:
    blocks = Blocks(plan)
    found = [drift for number in range(1, 12) for drift in blocks.block(number, 42.0)]
    assert found == [None] * 55


def test_drift_detector_reports_drift_once_at_next_block(plan: CampaignPlan) -> None:
    blocks = Blocks(plan)
    told = [
        list(blocks.block(number, speed)) for number, speed in enumerate((42.0, 42.05, 42.3, 42.3, 42.3), 1)
    ]
    assert told[:3] == [[None] * 5] * 3
    assert told[3][0] == Drift(("default", "driver"), told[3][0].text)  # type: ignore[union-attr]
    assert "head speed has drifted by +2." in told[3][0].text
    assert told[3][1:] == [None] * 4
    assert told[4] == [None] * 5  # what came after is the new measure


def test_drift_detector_reports_at_next_block_of_same_swing(plan: CampaignPlan) -> None:
    blocks = Blocks(plan)
    for number, speed in ((1, 42.0), (2, 42.4)):
        assert not any(blocks.block(number, speed))
    assert not any(blocks.block(3, 38.0, "driver-90mph"))
    assert any(blocks.block(4, 42.4))


@pytest.mark.parametrize(
    "changes",
    [
        {"role": "warm-up"},
        {"status": ShotStatus.EXCLUDED, "reason": "no launch"},
        {"club_speed_mps": None},
        {"strike_y_mm": None},
    ],
)
def test_drift_detector_invalid_shots_report_no_drift(plan: CampaignPlan, changes: dict[str, Any]) -> None:
    blocks = Blocks(plan)
    for number, speed in ((1, 42.0), (2, 44.0), (3, 46.0)):
        assert not any(blocks.block(number, speed, **changes))


def test_drift_detector_few_shots_report_no_drift(plan: CampaignPlan) -> None:
    blocks = Blocks(plan)
    assert not any(d for number in range(1, 6) for d in blocks.block(number, 40.0 + number, shots=1))


def test_drift_detector_combines_small_blocks(plan: CampaignPlan) -> None:
    blocks = Blocks(plan)
    speeds = (*[42.0] * 4, *[42.5] * 6)
    told = [list(blocks.block(number, speed, shots=2)) for number, speed in enumerate(speeds, 1)]
    assert [drift[0] is not None for drift in told] == [False] * 6 + [True] + [False] * 3


def test_drift_detector_without_refresh_reports_no_drift(plan: CampaignPlan) -> None:
    blocks = Blocks(with_values(plan, learning={"refresh": False}))
    assert not any(d for number in range(1, 6) for d in blocks.block(number, 40.0 + number))
