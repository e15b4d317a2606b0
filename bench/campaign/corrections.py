"""The learned corrections of a campaign's swings, and their relearning during the campaign."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from typing import Protocol

import numpy as np
from sqlalchemy import Engine

from bench.campaign.plan import CampaignPlan
from bench.campaign.relearning import Arm, Drift
from bench.campaign.swings import Profiles
from bench.config import Configuration
from bench.design.planned_openings import require_planned_openings
from bench.learning.ilc import LearningSettings
from bench.learning.learn import LearningProblem, Swinger, learn, prepare
from bench.learning.store import Conditions, Learned, keep, learned_swings, newest_that_holds, stored
from bench.simulation.series import Bench
from bench.store.records import CampaignEntry
from bench.swing.library import find_profile
from bench.swing.profile import Profile
from sim.plant import PlantParameters

Robot = Callable[[LearningProblem], AbstractContextManager[Swinger]]
"""Provides the robot for a learner."""


class CorrectedProfiles(Protocol):
    """The profiles of a campaign and their corrections, by swing and club."""

    def designed(self, arm: Arm) -> Profile:
        """Return the profile of `arm` without correction."""
        ...

    def weights(self, arm: Arm) -> tuple[float, ...]:
        """Return the correction weights of `arm`; empty: as designed."""
        ...

    def profile(self, arm: Arm) -> Profile:
        """Return the profile of `arm` as it is swung."""
        ...

    def refresh(self, drift: Drift, number: int, robot: Robot, truth: PlantParameters | None = None) -> str:
        """Relearn the drifted swing before shot `number`, and return the text of the event.

        `robot` swings; `truth` is the robot in simulation.

        Raises:
            BenchError: the modelled swing strikes no ball, or the bench refuses.
        """
        ...


class CampaignCorrections:
    """Corrections by swing and club; a campaign starts with the newest valid ones of its start."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: CampaignPlan,
        configuration: Configuration,
        database: Engine,
        profiles: Profiles,
        *,
        simulated: bool,
    ) -> None:
        """`profiles` are as designed; corrections are used if they are `simulated` like the campaign."""
        self._entry, self._plan, self._configuration = entry, plan, configuration
        self._database, self._profiles, self._simulated = database, profiles, simulated
        self._lectures: dict[Arm, LearningProblem] = {}
        self._learned: dict[Arm, Learned | None] = {
            arm: newest_that_holds(
                database,
                entry.bench,
                profile.name,
                self._conditions(arm),
                simulated=simulated,
                until=entry.date,
            )
            for arm, profile in profiles.items()
        }

    def designed(self, arm: Arm) -> Profile:
        """Return the profile of `arm` without correction."""
        return self._profiles[arm]

    def weights(self, arm: Arm) -> tuple[float, ...]:
        """Return the correction weights of `arm`; empty: as designed."""
        learned = self._learned[arm]
        return () if learned is None else learned.weights

    def profile(self, arm: Arm) -> Profile:
        """Return the profile of `arm` as it is swung."""
        learned, profile = self._learned[arm], self._profiles[arm]
        if learned is None:
            return profile
        swung = learned.correction(profile).applied_to(profile)
        return replace(swung, text=f"{swung.text}; learned, version {learned.version}")

    def refresh(self, drift: Drift, number: int, robot: Robot, truth: PlantParameters | None = None) -> str:
        """See `CorrectedProfiles`. Reuses what this campaign learned before an interruption.

        A correction that does not reach its target is not used.
        """
        arm, profile = drift.arm, self._profiles[drift.arm]
        mark = {"campaign": self._entry.id, "before_shot": number}
        before = learned_swings(self._database, self._entry.bench, profile.name)
        found = next((one for one in before if mark.items() <= dict(one.content).items()), None)
        if found is None:
            problem = self._lecture(arm)
            weights = self.weights(arm)
            with robot(problem) as swinger:
                result = learn(
                    problem,
                    swinger,
                    LearningSettings(swings=self._plan.learning.swings),
                    start=np.array(weights) if weights else None,
                )
            found = stored(
                result,
                self._entry.bench,
                profile.name,
                self._conditions(arm, truth),
                "encoders+model",
                datetime.now(UTC),
                simulated=self._simulated,
                beside=mark,
            )
            found = replace(found, version=keep(self._database, found))
        swings = f"{len(found.content['swings']) - 1} learning swings"
        if not found.within:
            return f"{profile.name}: {drift.text}; not relearned in {swings}, it goes on as before"
        self._learned[arm] = found
        return f"{profile.name}: {drift.text}; relearned in {swings}, version {found.version}"

    def _lecture(self, arm: Arm) -> LearningProblem:
        if arm not in self._lectures:
            profile, plant = self._profiles[arm], self._plant(arm)
            c = replace(self._configuration, plant=plant).for_profile(
                profile, find_profile(self._plan.profile(*arm))
            )
            require_planned_openings(c.control)
            bench = Bench.of(c, profile)
            self._lectures[arm] = prepare(bench)
        return self._lectures[arm]

    def _plant(self, arm: Arm) -> PlantParameters:
        return self._configuration.plant_of(arm[1], self._plan.clubs[arm[1]])

    def _conditions(self, arm: Arm, truth: PlantParameters | None = None) -> Conditions:
        plant = self._plant(arm)
        robot = (truth or plant) if self._simulated else None
        return Conditions.of(self._profiles[arm], plant, self._configuration.air.temperature, robot)
