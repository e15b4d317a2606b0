"""Order of shots: randomised complete blocks in sections, from the plan's seed alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from enum import StrEnum
from itertools import product
from typing import NamedTuple

import numpy as np

from bench.campaign.plan import CampaignPlan, levels


class Arm(NamedTuple):
    """One combination of ball, club and swing."""

    swing: str
    club: str
    ball: str

    def __str__(self) -> str:
        return f"{self.ball}, {self.club}, {self.swing}"


class Role(StrEnum):
    """Role of a shot."""

    WARM_UP = "warm-up"
    CONTROL = "control"
    TEST = "test"


class PlannedShot(NamedTuple):
    """One planned shot."""

    role: Role
    section: int
    """From 1."""
    block: int
    """From 1 over all sections; 0 in a warm-up."""
    position: int
    """In its block, from 1."""
    arm: Arm


class Section(NamedTuple):
    """A section: club and swing, or ball, that stay the same while the compared levels alternate."""

    number: int
    arms: tuple[Arm, ...]
    warm_up: Arm
    control: Arm | None
    """The control ball with the section's club and swing; with the first ones where those are compared."""

    @property
    def name(self) -> str:
        """Return what its arms have in common."""
        shared = (values[0] for values in map(tuple, zip(*self.arms, strict=True)) if len(set(values)) == 1)
        return ", ".join(shared)


def sections(plan: CampaignPlan) -> tuple[Section, ...]:
    """Return the plan's sections in their order, that of its lists."""
    d = plan.design
    factors = {"swing": d.swings, "club": d.clubs, "ball": d.balls}
    others = {name: values for name, values in factors.items() if name != d.compare}
    if plan.split:
        return tuple(_split_section(plan, number, swing) for number, swing in enumerate(d.swings, 1))
    found = []
    for number, fixed in enumerate(product(*others.values()), 1):
        common = dict(zip(others, fixed, strict=True))
        arms = tuple(Arm(**common, **{d.compare: level}) for level in levels(plan))
        control = arms[0]._replace(ball=plan.control.ball) if plan.control.ball else None
        found.append(Section(number, arms, control or arms[0], control))
    return tuple(found)


def _split_section(plan: CampaignPlan, number: int, swing: str) -> Section:
    """Return the section of a split-plot: all clubs with all balls."""
    arms = tuple(Arm(swing, club, ball) for club, ball in product(plan.design.clubs, plan.design.balls))
    return Section(number, arms, arms[0], None)


def block_trials(plan: CampaignPlan, section: Section, number: int) -> list[PlannedShot]:
    """Return the shots of a section's block `number` (from 1), in order.

    The order of a block depends on seed, section and number only: it is the same after a restart.
    """
    random = np.random.default_rng((plan.design.seed, section.number, number))
    shuffled = _split_order(plan, section, random) if plan.split else _shuffled(section.arms, random)
    block = (section.number - 1) * plan.design.blocks + number
    line = [(Role.TEST, arm) for arm in shuffled]
    if section.control is not None:
        control = (Role.CONTROL, section.control)
        middle = (len(line) + 1) // 2
        between = [control] if len(line) > 1 else []
        line = [control, *line[:middle], *between, *line[middle:], control]
    return [PlannedShot(role, section.number, block, place, arm) for place, (role, arm) in enumerate(line, 1)]


def _shuffled(arms: Sequence[Arm], random: np.random.Generator) -> list[Arm]:
    return [arms[index] for index in random.permutation(len(arms))]


def _split_order(plan: CampaignPlan, section: Section, random: np.random.Generator) -> list[Arm]:
    """Return a block of a split-plot: clubs in random order, with each the balls so often in random order."""
    clubs = [plan.design.clubs[index] for index in random.permutation(len(plan.design.clubs))]
    balls = {club: [arm for arm in section.arms if arm.club == club] for club in clubs}
    turns = range(plan.design.hits_per_mounting)
    return [arm for club in clubs for _ in turns for arm in _shuffled(balls[club], random)]


def is_mounted(plan: CampaignPlan, before: PlannedShot, trial: PlannedShot) -> bool:
    """Return whether the club of `before` stays mounted for `trial`; in a split-plot in its block only."""
    same_plot = not plan.split or before.block in {0, trial.block}
    return before.arm.club == trial.arm.club and same_plot


def all_trials(plan: CampaignPlan) -> list[PlannedShot]:
    """Return every block's shots in order, warm-up and repeats left out."""
    return [
        trial
        for section in sections(plan)
        for number in range(1, plan.design.blocks + 1)
        for trial in block_trials(plan, section, number)
    ]


def warm_up_arms(section: Section) -> list[Arm]:
    """Return one arm with the warm-up's ball for each swing and club of the section."""
    arms = {(arm.swing, arm.club): arm._replace(ball=section.warm_up.ball) for arm in section.arms}
    return list(arms.values())


def hits_needed(plan: CampaignPlan) -> Counter[str]:
    """Return how often each ball is hit at most, without repeats."""
    hits = Counter(trial.arm.ball for trial in all_trials(plan))
    for section in sections(plan):
        for arm in warm_up_arms(section):
            hits[arm.ball] += plan.warm_up.at_most
    return hits
