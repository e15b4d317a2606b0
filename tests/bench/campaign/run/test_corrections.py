"""Corrections of a campaign: learned before its start, learned during it, restored after a crash."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import Engine

from bench.campaign.run import _corrections
from bench.campaign.run._corrections import CampaignCorrections, Drift
from bench.campaign.run.runner_control import new_entry
from bench.config import database_url
from bench.learning.learn import LearningProblem, Swinger
from bench.learning.store import Conditions, Learned, keep, learned_swings
from bench.store.database import open_database
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.bench.campaign.plans import NOW, SHIPPED, shipped_plan

PLAN = shipped_plan("symmetry")
ARM = ("default", "driver")
PROFILE = load_profile(find_profile("default"))
PROFILES = {ARM: PROFILE}
SIZE = basis_of(PROFILE).size
DRIFT = Drift(ARM, "head speed has drifted by +2.0 tolerances")
ENTRY = new_entry(PLAN, SHIPPED, NOW, simulated=True)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Engine]:
    with open_database(database_url("", tmp_path), NOW) as engine:
        yield engine


def made(database: Engine, *, simulated: bool = True) -> CampaignCorrections:
    return CampaignCorrections(replace(ENTRY, simulated=simulated), PLAN, SHIPPED, database, PROFILES)


def stored(value: float, date: datetime, **changes: Any) -> Learned:
    plant = SHIPPED.plant
    plant = replace(plant, robot=replace(plant.robot, club=PLAN.clubs[ARM[1]]))
    here = Conditions.of(PROFILE, plant, SHIPPED.air.temperature, plant)
    source, weights = "encoders+model", (value,) * SIZE
    learned = Learned(
        SHIPPED.bench.id, PROFILE.name, date, True, source, here, True, weights, {"swings": [{}, {}]}
    )
    return replace(learned, **changes)


def test_campaign_corrections_start_with_correction_learned_before(database: Engine) -> None:
    assert made(database).profile(ARM) is PROFILE
    keep(database, stored(0.1, NOW - timedelta(hours=1)))
    keep(database, stored(0.2, NOW + timedelta(hours=1)))
    swings = made(database)
    assert swings.weights(ARM) == (0.1,) * SIZE
    assert swings.profile(ARM).text.endswith("learned, version 1")
    assert not np.array_equal(swings.profile(ARM).angle, PROFILE.angle)
    assert swings.designed(ARM) is PROFILE
    assert made(database, simulated=False).weights(ARM) == ()  # of another robot


class School:
    """Stands in for learning, which needs a robot: counts the lessons, and sets their results."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lessons: list[Any] = []
        self.within = True
        monkeypatch.setattr(_corrections, "prepare", lambda bench: bench)
        monkeypatch.setattr(_corrections, "learn", self._learn)
        monkeypatch.setattr(_corrections, "stored", self._stored)

    def robot(self, problem: LearningProblem) -> AbstractContextManager[Swinger]:
        return nullcontext(lambda weights: pytest.fail("no learning expected"))

    def _learn(self, problem: Any, swinger: Swinger, swings: int, start: Any) -> Any:
        self.lessons.append((swings, start))
        return len(self.lessons)

    def _stored(self, result: Any, *args: Any, beside: dict[str, Any], **_: Any) -> Learned:
        content = {"swings": [{}] * 4, **beside}
        return stored(0.1 * result, NOW + timedelta(hours=2), within=self.within, content=content)


@pytest.fixture
def school(monkeypatch: pytest.MonkeyPatch) -> School:
    return School(monkeypatch)


def test_campaign_corrections_refresh_is_restored_on_resume(database: Engine, school: School) -> None:
    keep(database, stored(0.7, NOW))
    swings = made(database)
    told = swings.refresh(DRIFT, 17, school.robot)
    assert told == f"{PROFILE.name}: {DRIFT.text}; relearned in 3 learning swings, version 2"
    assert swings.weights(ARM) == (0.1,) * SIZE
    assert swings.refresh(DRIFT, 29, school.robot).endswith("version 3")
    assert [swings for swings, _ in school.lessons] == [PLAN.learning.swings] * 2
    assert np.array_equal(school.lessons[0][1], (0.7,) * SIZE)  # it goes on from where it was
    again = made(database)  # resumed: its shots lead to the same drifts
    assert again.refresh(DRIFT, 17, school.robot) == told
    assert again.weights(ARM) == (0.1,) * SIZE
    again.refresh(DRIFT, 29, school.robot)
    assert again.weights(ARM) == (0.2,) * SIZE
    assert len(school.lessons) == 2
    assert len(learned_swings(database, SHIPPED.bench.id, PROFILE.name)) == 3


def test_campaign_corrections_correction_off_target_is_not_used(database: Engine, school: School) -> None:
    school.within = False
    swings = made(database)
    assert "not relearned in 3 learning swings" in swings.refresh(DRIFT, 17, school.robot)
    assert swings.profile(ARM) is PROFILE
