"""Order of shots, and the next shot of a campaign, given those before it.

`course` is a generator: it yields the next step and receives the resulting shot. It reads no clock and draws
no numbers but those of the plan's seed. The stored shots of an interrupted campaign therefore lead to the
same next step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from enum import StrEnum
from itertools import product
from typing import NamedTuple

import numpy as np

from bench.campaign.plan.gate import Centre, median_delivery
from bench.campaign.plan.plan import CampaignPlan, levels
from bench.records.shot.shot import Shot, ShotStatus


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
    """Number of the section, from 1."""
    block: int
    """Number of the block, from 1 over all sections; 0 in a warm-up."""
    position: int
    """Position in the block, from 1."""
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
    found = list[Section]()
    if plan.split:  # all clubs with all balls
        for number, swing in enumerate(d.swings, 1):
            every = tuple(Arm(swing, club, ball) for club, ball in product(d.clubs, d.balls))
            found.append(Section(number, every, every[0], None))
        return tuple(found)
    for number, fixed in enumerate(product(*others.values()), 1):
        common = dict(zip(others, fixed, strict=True))
        arms = tuple(Arm(**common, **{d.compare: level}) for level in levels(plan))
        control = arms[0]._replace(ball=plan.control.ball) if plan.control.ball else None
        found.append(Section(number, arms, control or arms[0], control))
    return tuple(found)


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
    return [
        PlannedShot(role, section.number, block, location, arm)
        for location, (role, arm) in enumerate(line, 1)
    ]


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
    """Return an arm (treatment) with the warm-up's ball for each swing and club of the section."""
    arms = {(arm.swing, arm.club): arm._replace(ball=section.warm_up.ball) for arm in section.arms}
    return list(arms.values())


def hits_needed(plan: CampaignPlan) -> Counter[str]:
    """Return how often each ball is hit at most, without repeats."""
    hits = Counter(trial.arm.ball for trial in all_trials(plan))
    for section in sections(plan):
        for arm in warm_up_arms(section):
            hits[arm.ball] += plan.warm_up.at_most
    return hits


class Step(NamedTuple):
    """The next shot: its trial, its attempt, and the delivery it is judged by."""

    trial: PlannedShot
    attempt: int
    centre: Centre


class Ending(NamedTuple):
    """How a campaign ended."""

    complete: bool
    """Whether the plan was completed, possibly early by its own stopping rule."""
    reason: str


Decide = Callable[[CampaignPlan, Sequence[Shot]], str]
"""Returns from a section's shots why they are enough; empty if they are not."""
Planned = Mapping[tuple[str, str], Centre]
"""Designed delivery by (swing, club)."""
Course = Generator[Step, Shot | None, Ending]


def course(plan: CampaignPlan, planned: Planned, decide: Decide) -> Course:
    """Yield the steps of `plan`; send each one's shot, or None after a long time without one.

    After None the next step is the first one of the section's warm-up, and after that the block's.
    """
    words = []
    for section in sections(plan):
        centres, why = yield from _warmed_up(plan, section, planned)
        if why:
            return Ending(False, why)
        shots: list[Shot] = []
        looks = looks_after(plan)
        for number in range(1, plan.design.blocks + 1):
            while (block := (yield from _block(plan, section, number, centres))) is None:
                centres, why = yield from _warmed_up(plan, section, planned)
                if why:
                    return Ending(False, why)
            shots += block
            if number in looks and (enough := decide(plan, shots)):
                words.append(
                    f"section {section.number} after {number} of {plan.design.blocks} blocks: {enough}"
                )
                break
    return Ending(True, "; ".join(words))


def _block(
    plan: CampaignPlan, section: Section, number: int, centres: Planned
) -> Generator[Step, Shot | None, list[Shot] | None]:
    """Take the shots of a block, the repeats included; return None if it restarts."""
    shots = []
    for trial in block_trials(plan, section, number):
        for attempt in range(1, plan.design.repeats + 2):
            shot = yield Step(trial, attempt, centres[trial.arm.swing, trial.arm.club])
            if shot is None:
                return None
            shots.append(shot)
            if shot.status is ShotStatus.VALID:
                break
    return shots


def _warmed_up(
    plan: CampaignPlan, section: Section, planned: Planned
) -> Generator[Step, Shot | None, tuple[Planned, str]]:
    """Warm up with each swing and club; return the gate's centres, and the reason if it failed."""
    arms = warm_up_arms(section) if plan.warm_up.at_most else []
    centres, index = dict(planned), 0
    while index < len(arms):
        arm, index = arms[index], index + 1
        found = yield from _warm_up(plan, section, arm)
        if found is None:
            index = 0
            continue
        settled, why = found
        if why:
            return centres, why
        if plan.gate.reference == "warm-up":
            centres[arm.swing, arm.club] = median_delivery(settled, plan.clubs[arm.club])
    return centres, ""


def is_settled(plan: CampaignPlan, shot: Shot) -> bool:
    """Return whether `shot` settles its planned shot: it is valid, or was the last attempt."""
    tried = shot.status is ShotStatus.VALID or shot.attempt > plan.design.repeats
    return tried and shot.role != Role.WARM_UP


def tests_by_level(plan: CampaignPlan, shots: Iterable[Shot]) -> dict[str, list[Shot]]:
    """Return the test shots of each level of the compared factor, in the plan's order of levels."""
    found: dict[str, list[Shot]] = {name: [] for name in levels(plan)}
    for shot in shots:
        if shot.role == Role.TEST:
            found.get(getattr(shot, plan.design.compare), []).append(shot)
    return found


def looks_after(plan: CampaignPlan) -> frozenset[int]:
    """Return the blocks of a section after which the plan's stopping rule is checked; never the last one."""
    stop, blocks = plan.stop, plan.design.blocks
    if stop.rule == "fixed":
        return frozenset()
    points = np.linspace(stop.min_blocks, blocks, stop.interim_analyses)
    return frozenset(round(float(point)) for point in points) - {blocks}


def _warm_up(
    plan: CampaignPlan, section: Section, arm: Arm
) -> Generator[Step, Shot | None, tuple[list[Shot], str] | None]:
    """Swing until the club speed is stable; return the last shots, and the reason if it is not.

    None: restart all of the warm-up.
    """
    w, recent = plan.warm_up, list[Shot]()
    for position in range(1, w.at_most + 1):
        trial = PlannedShot(Role.WARM_UP, section.number, 0, position, arm)
        shot = yield Step(trial, 1, Centre())
        if shot is None:
            return None
        if shot.status is not ShotStatus.VALID or shot.club_speed_mps is None:
            recent = []
            continue
        recent = [*recent, shot][-w.window :]
        speeds = [found.club_speed_mps for found in recent if found.club_speed_mps is not None]
        if len(recent) == w.window and max(speeds) - min(speeds) <= w.tolerance:
            return recent, _set_up_wrong(plan, recent)
    return [], (
        f"the robot did not warm up: {w.window} club speeds did not come within {w.tolerance:g} m/s in "
        f"{w.at_most} shots of {arm}"
    )


def _set_up_wrong(plan: CampaignPlan, shots: Sequence[Shot]) -> str:
    """Return why the control ball's speed is outside the set-up tolerance; empty if it is not."""
    wanted, tolerance = plan.set_up.control_ball_speed, plan.set_up.tolerance
    speeds = [shot.ball_speed_mps for shot in shots if shot.ball_speed_mps is not None]
    if not wanted or (speeds and abs(float(np.mean(speeds)) - wanted) <= tolerance):
        return ""
    found = f"{np.mean(speeds):.2f} m/s" if speeds else "not measured"
    return (
        f"set-up: the control ball's speed is {found}, wanted {wanted:g} ± {tolerance:g} m/s; "
        "change the swing, or the figure in [set_up]"
    )
