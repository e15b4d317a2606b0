"""The fitting of the bench (club, balls, profile), and the prompts needed before a shot.

Pure: what is in place follows from the answered prompts and the shots since, so that a restart knows it too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from bench.campaign.course import Step
from bench.campaign.plan import CampaignPlan
from bench.campaign.sequence import Arm, Role, block_trials, sections
from bench.shot.shot import Shot, ShotStatus
from bench.store.campaigns import Hit, Prompt


class PromptKind(StrEnum):
    """Kind of a prompt."""

    CLUB = "club"
    BALLS = "balls"
    BENCH = "bench"
    """Restart the bench: no simulation does that by itself."""


class Preparation(NamedTuple):
    """Work needed before a shot, in words, and the fitting after it."""

    kind: PromptKind
    text: str
    content: Mapping[str, Any]


Numbered = tuple[str, int]
"""A ball: its model and the number on it."""


class Fitting(NamedTuple):
    """Club and balls in the bench."""

    club: str
    feeder: tuple[Numbered, ...] = ()
    """Balls in it, the next one first."""

    def with_done(self, prompt: Prompt) -> Fitting:
        """Return the fitting after an answered prompt."""
        match prompt.content:
            case {"club": str(club)}:
                return self._replace(club=club)
            case {"balls": [*balls]}:
                return self._replace(feeder=tuple((str(name), int(number)) for name, number in balls))
        return self

    def after(self, shot: Shot) -> Fitting:
        """Return the fitting after `shot`; after a failed one the feeder's content is unknown."""
        return self._replace(feeder=() if shot.status is ShotStatus.FAILED else self.feeder[1:])


def fitting_after(club: str, shots: Sequence[Shot], prompts: Sequence[Prompt]) -> Fitting:
    """Return the fitting of a bench started with `club`, after `shots` and the answered `prompts`."""
    fitting = Fitting(club)
    done: dict[int, list[Prompt]] = {}
    for prompt in prompts:
        if prompt.answered is not None:
            done.setdefault(prompt.before_shot, []).append(prompt)
    for number in range(1, len(shots) + 2):
        for prompt in done.get(number, ()):
            fitting = fitting.with_done(prompt)
        if number <= len(shots):
            fitting = fitting.after(shots[number - 1])
    return fitting


def missing(
    plan: CampaignPlan, fitting: Fitting, step: Step, sample: int, hits: Mapping[Hit, int]
) -> Preparation | None:
    """Return the work needed before `step` is taken with ball `sample`; None if none is."""
    arm, handling = step.trial.arm, plan.ball_handling
    if fitting.club != arm.club:
        return Preparation(
            PromptKind.CLUB, f"Mount club {arm.club} in place of {fitting.club}.", {"club": arm.club}
        )
    if not handling.magazine or fitting.feeder[:1] == ((arm.ball, sample),):
        return None
    balls = coming_balls(plan, step, hits)
    order = ", ".join(f"{name} {number}" for name, number in balls)
    empty = "Empty the feeder, then fill" if fitting.feeder else "Fill"
    text = (
        f"{empty} it in this order: {order}. Balls kept at {handling.temperature - 273.15:.0f} ± "
        f"{handling.temperature_tolerance:g} °C for {handling.conditioning_time / 3600:g} h."
    ).replace("Fill it", "Fill the feeder")
    return Preparation(PromptKind.BALLS, text, {"balls": [list(ball) for ball in balls]})


def coming_balls(plan: CampaignPlan, step: Step, hits: Mapping[Hit, int]) -> list[Numbered]:
    """Return the balls from `step` on as far as the magazine goes, as if every shot were valid.

    A ball comes once: it must be picked up before it can be filled in again.
    """
    counted, found = Counter(hits), list[Numbered]()
    for arm in _coming_arms(plan, step)[: plan.ball_handling.magazine]:
        sample = sample_for(plan, arm.ball, counted)
        if sample is None or (arm.ball, sample) in found:
            break
        found.append((arm.ball, sample))
        counted[Hit("ball", arm.ball, sample)] += 1
    return found


def sample_for(plan: CampaignPlan, ball: str, hits: Counter[Hit]) -> int | None:
    """Return the number of the ball to take: the one of its model with the fewest hits; None: all used up."""
    handling = plan.ball_handling
    numbers = range(handling.first_sample, handling.first_sample + handling.samples)
    number = min(numbers, key=lambda sample: (hits[Hit("ball", ball, sample)], sample))
    return number if hits[Hit("ball", ball, number)] < handling.hits else None


def _coming_arms(plan: CampaignPlan, step: Step) -> list[Arm]:
    """Return the arms from `step` to the end of its warm-up's window or its section, with the same club."""
    trial = step.trial
    if trial.role is Role.WARM_UP:
        return [trial.arm] * max(1, plan.warm_up.window + 1 - trial.position)
    section = sections(plan)[trial.section - 1]
    block = trial.block - (trial.section - 1) * plan.design.blocks
    trials = [
        each
        for number in range(block, min(block + plan.ball_handling.magazine, plan.design.blocks) + 1)
        for each in block_trials(plan, section, number)
    ]
    arms = [each.arm for each in trials[trial.position - 1 :]]
    others = (index for index, arm in enumerate(arms) if arm.club != trial.arm.club)
    return arms[: next(others, len(arms))]
