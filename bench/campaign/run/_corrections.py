"""The learned corrections of a campaign's swings, and their relearning during the campaign.

A swing is relearned between blocks when its delivery has drifted. A block's deliveries of one swing and club
are compared with those of the first block after the last learning; small blocks are combined. The same
measuring chain measures both, so its errors affect both alike. The ball's results are never used.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Engine

from bench.campaign.plan.gate import delivered
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Role, Step
from bench.campaign.run.plan_requirements import Profiles
from bench.config import Configuration
from bench.design.optimal_control import require_planned_openings
from bench.learning.delivery import Tolerance
from bench.learning.learn import LearningProblem, Swinger, learn, prepare
from bench.learning.store import Conditions, Learned, drifted, keep, learned_swings, newest_that_holds, stored
from bench.records.shot.shot import Shot, ShotStatus
from bench.simulation.simulated_bench import Bench
from bench.store.rows import CampaignEntry
from bench.swing.library import find_profile
from bench.swing.profile import Profile
from sim.plant import PlantParameters

Array = NDArray[np.float64]
Arm = tuple[str, str]
"""Swing and club."""

_MIN_SHOTS = 3
"""Min number of shots of a swing and club that are judged; smaller blocks are added to the next one."""
_NAMES = ("head speed", "attack angle", "shaft lean", "strike heel to toe", "strike low to high")


class Drift(NamedTuple):
    """A drift after which a swing is relearned."""

    arm: Arm
    text: str


class DriftDetector:
    """Receives every shot in order and is asked before each step; its state follows from the shots alone."""

    def __init__(self, plan: CampaignPlan) -> None:
        self._plan = plan
        self._block = (0, 0)
        self._seen: dict[Arm, list[tuple[int, Array]]] = defaultdict(list)
        """(block, figures) of the shots that are not judged yet."""
        self._baseline: dict[Arm, Array] = {}
        self._open: dict[Arm, Drift] = {}

    def before(self, step: Step) -> Drift | None:
        """Return the drift after which the swing of `step` is relearned, seen in an earlier block.

        It is returned once, when this swing is next: its club is mounted then.
        """
        if not self._plan.learning.refresh:
            return None
        block, arm = (step.trial.section, step.trial.block), step.trial.arm
        if block != self._block:
            self._block = block
            for key in [key for key, shots in self._seen.items() if len(shots) >= _MIN_SHOTS]:
                deliveries = [figures for _, figures in self._seen.pop(key)]
                if (drift := self._drift_of(key, deliveries)) is not None:
                    self._open[key] = drift
        return self._open.pop((arm.swing, arm.club), None)

    def note(self, shot: Shot) -> None:
        """Note a shot; warm-up and invalid shots are ignored."""
        if shot.status is not ShotStatus.VALID or shot.role == Role.WARM_UP:
            return
        centre = delivered(shot, self._plan.clubs[shot.club])
        figures = np.array([np.nan if value is None else value for value in centre])
        if np.isfinite(figures).all():
            self._seen[shot.swing, shot.club].append((shot.block, figures))

    def set_aside(self, block: int) -> None:
        """Forget the shots of `block`: it restarts."""
        for arm, shots in self._seen.items():
            self._seen[arm] = [shot for shot in shots if shot[0] != block]

    def _drift_of(self, arm: Arm, shots: list[Array]) -> Drift | None:
        now, before = np.array(shots), self._baseline.get(arm)
        if before is None:
            self._baseline[arm] = now
            return None
        scale, middle = _scale(before), before.mean(axis=0)
        errors = (now - middle) / scale
        within = np.concatenate([now - now.mean(axis=0), before - middle]) / scale
        scatter = np.sqrt(np.sum(within**2, axis=0) / (len(within) - 2))
        # The baseline is also a mean of some shots.
        if not drifted(scatter * np.sqrt(1 + len(now) / len(before)), errors):
            return None
        del self._baseline[arm]
        mean = errors.mean(axis=0)
        worst = int(np.abs(mean).argmax())
        return Drift(arm, f"{_NAMES[worst]} has drifted by {mean[worst]:+.1f} tolerances")


def _scale(before: Array) -> Array:
    """Return the tolerances in the units of a gate's figures."""
    t = Tolerance()
    speed = float(before[:, 0].mean())
    return np.array([t.speed * speed, t.attack, t.lean, t.strike, t.strike])


Robot = Callable[[LearningProblem], AbstractContextManager[Swinger]]
"""Provides the robot for a learner."""


class CampaignCorrections:
    """Corrections by swing and club; a campaign starts with the newest valid ones of its start."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: CampaignPlan,
        configuration: Configuration,
        database: Engine,
        profiles: Profiles,
    ) -> None:
        """`profiles` are as designed; corrections are used if they are simulated like the campaign."""
        self._entry, self._plan, self._configuration = entry, plan, configuration
        self._database, self._profiles = database, profiles
        self._lectures: dict[Arm, LearningProblem] = {}
        self._learned: dict[Arm, Learned | None] = {
            arm: newest_that_holds(
                database,
                entry.bench,
                profile.name,
                self._conditions(arm),
                simulated=entry.simulated,
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
        """Return the profile of `arm` with its correction, if any."""
        learned, profile = self._learned[arm], self._profiles[arm]
        if learned is None:
            return profile
        swung = learned.correction(profile).applied_to(profile)
        return replace(swung, text=f"{swung.text}; learned, version {learned.version}")

    def refresh(self, drift: Drift, number: int, robot: Robot, truth: PlantParameters | None = None) -> str:
        """Relearn the drifted swing before shot `number`, and return the text of the event.

        `robot` swings; `truth` is the robot in simulation. What this campaign learned before an interruption
        is reused; a correction that does not reach its target is not used.

        Raises:
            BenchError: the modelled swing strikes no ball, or the bench refuses.
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
                    problem, swinger, self._plan.learning.swings, start=np.array(weights) if weights else None
                )
            found = stored(
                result,
                self._entry.bench,
                profile.name,
                self._conditions(arm, truth),
                "encoders+model",
                datetime.now(UTC),
                simulated=self._entry.simulated,
                beside=mark,
            )
            found = replace(found, version=keep(self._database, found))
        swings = f"{len(found.content['swings']) - 1} learning swings"
        if not found.within:
            return f"{profile.name}: {drift.text}; not relearned in {swings}, continues unchanged"
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
        robot = (truth or plant) if self._entry.simulated else None
        return Conditions.of(self._profiles[arm], plant, self._configuration.air.temperature, robot)
