"""Speeds are demanded two at a time until half a m/s more fails, whatever engine plans them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from bench.config import load_configuration
from bench.design import highest_speed as module
from bench.design.designer import DesignFailed
from bench.design.highest_speed import DownswingStudy, highest_speed
from bench.design.optimal_control import SwingDemand
from bench.simulation.sweep import InProcess
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

STUDY = DownswingStudy(load_configuration(None), SwingDemand(), None)


def robot_that_does(
    most: float, monkeypatch: pytest.MonkeyPatch, *, plans: float = 38.0
) -> list[float | None]:
    """Let downswings up to `most` m/s be found, and `plans` m/s without a demand; return the speeds asked."""
    asked = list[float | None]()

    def plan(_: Any, demand: SwingDemand, *__: Any) -> Any:
        asked.append(demand.head_speed)
        speed = plans if demand.head_speed is None else demand.head_speed
        if speed > most:
            raise DesignFailed("the wrist's cushion would take too much")
        return SimpleNamespace(speed=speed)

    monkeypatch.setattr(module, "plan_at_speed", plan)
    return asked


def test_highest_speed_raises_demand_until_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot of this test reaches 41.3 m/s, which does not follow from its fastest plan of 38."""
    asked, shown = robot_that_does(41.3, monkeypatch), list[str]()
    found = highest_speed(STUDY, InProcess(), shown.append)
    assert asked[:3] == [None, 40.0, 42.0]
    assert asked[3:] == pytest.approx([40 + 6 / 9, 40 + 12 / 9, 40 + 8 / 9, 40 + 10 / 9])
    assert found.plan.speed == pytest.approx(40 + 10 / 9)
    assert found.limit == "at 41.3 m/s the wrist's cushion would take too much"
    assert shown[:2] == ["as fast as it goes", "40.0 and 42.0 m/s"]


def test_highest_speed_continues_while_successful(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = robot_that_does(47.0, monkeypatch)
    assert 46.5 <= highest_speed(STUDY, InProcess()).plan.speed <= 47.0
    assert asked[:7] == [None, 40.0, 42.0, 44.0, 46.0, 48.0, 50.0]


def test_highest_speed_success_above_failure_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    def plan(_: Any, demand: SwingDemand, *__: Any) -> Any:
        if demand.head_speed == 40.0:
            raise DesignFailed("no")
        return SimpleNamespace(speed=demand.head_speed or 38.0)

    monkeypatch.setattr(module, "plan_at_speed", plan)
    assert highest_speed(STUDY, InProcess()).plan.speed < 40.0


def test_highest_speed_without_feasible_downswing_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    robot_that_does(30.0, monkeypatch)
    with pytest.raises(DesignFailed, match="cushion"):
        highest_speed(STUDY, InProcess())


def test_highest_speed_unfollowed_fastest_plan_starts_from_profile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It opens the valves as far as they go, so that nothing is left to correct with."""
    asked = robot_that_does(44.0, monkeypatch, plans=50.0)
    start = load_profile(find_profile("driver-85mph"))
    known = start.delivery["head_speed_mps"]
    found = highest_speed(replace(STUDY, start=start), InProcess())
    assert asked[:4] == [None, known, known + 2.0, known + 4.0]
    assert 43.5 <= found.plan.speed <= 44.0
