"""The fastest swing of a found robot: a slower backswing where the shipped one's fails."""

from __future__ import annotations

from typing import Any

import pytest

from bench.commissioning.swings import robot_swings
from bench.commissioning.swings.robot_swings import design_at
from bench.config import load_configuration, shipped_configuration
from bench.design.designer import DesignFailed
from bench.design.optimal_control import SwingDemand


@pytest.mark.parametrize("works_from", [0.85, 1.1, 9.0])
def test_design_at_failed_design_tries_slower_backswing(
    monkeypatch: pytest.MonkeyPatch, works_from: float
) -> None:
    tried = list[float]()

    def design(_: Any, demand: SwingDemand, name: str, **given: Any) -> str:
        tried.append(demand.backswing_time)
        assert demand.before_stop > 0.0
        if demand.backswing_time < works_from:
            raise DesignFailed(f"wrist folded too far in {demand.backswing_time} s")
        return name

    monkeypatch.setattr(robot_swings, "design_swing", design)
    configuration = load_configuration(shipped_configuration())
    if works_from > 1.1:
        with pytest.raises(DesignFailed, match=r"in 0.85 s"):
            design_at(configuration, 40.0, "swing")
        return
    assert str(design_at(configuration, 40.0, "swing")) == "swing"
    assert tried == [0.85, 1.1][: tried.index(works_from) + 1]
