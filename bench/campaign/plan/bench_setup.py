"""The fitting of the bench (club, balls, profile), and the prompts needed before a shot.

A feeder with a magazine is loaded at once with the balls of the coming shots: the load list.

Pure: the fitting follows from the answered prompts and the shots since. A restart therefore restores it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import Any, NamedTuple

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import PlannedShot, Role, Step, block_trials, sections, warm_up_arms
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import Hit, Numbered, Prompt, PromptKind, places


class Preparation(NamedTuple):
    """Work needed before a shot, in words, and the fitting after it."""

    kind: PromptKind
    text: str
    content: Mapping[str, Any]


class Fitting(NamedTuple):
    """Club and balls in the bench."""

    club: str
    feeder: tuple[Numbered, ...] = ()
    """Balls in it, the next one first."""
    used_in: int = 0
    """Block in which the club was hit since it was mounted; 0: in none."""

    def with_done(self, prompt: Prompt) -> Fitting:
        """Return the fitting after an answered prompt."""
        match prompt.content:
            case {"club": str(club)}:
                return self._replace(club=club, used_in=0)
            case {"balls": [*balls]}:
                return self._replace(feeder=tuple((str(name), int(number)) for name, number in balls))
        return self

    def after(self, shot: Shot) -> Fitting:
        """Return the fitting after `shot`; after a failed one the feeder's content is unknown."""
        feeder = () if shot.status is ShotStatus.FAILED else self.feeder[1:]
        return self._replace(feeder=feeder, used_in=shot.block or self.used_in)


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
        text = " ".join(
            (f"Mount club {arm.club} in place of {fitting.club}.", plan.preparation.get(arm.club, ""))
        )
        return Preparation(PromptKind.CLUB, text.rstrip(), {"club": arm.club})
    if plan.split and fitting.used_in not in {0, step.trial.block} and step.trial.block:
        text = f"Take club {arm.club} off and mount it again: each mounting counts for itself."
        return Preparation(PromptKind.CLUB, text, {"club": arm.club})
    if not handling.magazine or fitting.feeder[:1] == ((arm.ball, sample),):
        return None
    balls = coming_balls(plan, step.trial, hits)
    count = f"with {len(balls)} ball{'s' * (len(balls) > 1)} in this order"
    empty = "Empty the feeder, then fill it" if fitting.feeder else "Fill the feeder"
    text = (
        f"{empty} {count}: {', '.join(places(balls))}. Balls kept at {handling.temperature - 273.15:.0f} ± "
        f"{handling.temperature_tolerance:g} °C for {handling.conditioning_time / 3600:g} h. "
        f"Check that club {arm.club} is mounted."
    )
    return Preparation(PromptKind.BALLS, text, {"balls": [list(ball) for ball in balls]})


class LoadList(NamedTuple):
    """One load of the magazine."""

    before: PlannedShot
    balls: list[Numbered]


def load_lists(plan: CampaignPlan, hits: Mapping[Hit, int]) -> list[LoadList]:
    """Return the loads of a plan's magazine, as if every shot were valid and each warm-up the shortest.

    `hits` are those that its balls have taken before. Empty without a magazine.
    """
    if not plan.ball_handling.magazine:
        return []
    counted, feeder, found = Counter(hits), list[Numbered](), list[LoadList]()
    for trial in _shortest_course(plan):
        sample = sample_for(plan, trial, counted)
        if sample is None:
            break
        if feeder[:1] != [(trial.arm.ball, sample)]:
            feeder = coming_balls(plan, trial, counted)
            found.append(LoadList(trial, feeder))
        feeder = feeder[1:]
        counted[Hit("ball", trial.arm.ball, sample)] += 1
    return found


def _shortest_course(plan: CampaignPlan) -> Iterator[PlannedShot]:
    """Yield the planned shots with the shortest warm-ups, none repeated."""
    for section in sections(plan):
        for arm in warm_up_arms(section) if plan.warm_up.at_most else ():
            for position in range(1, plan.warm_up.window + 1):
                yield PlannedShot(Role.WARM_UP, section.number, 0, position, arm)
        for number in range(1, plan.design.blocks + 1):
            yield from block_trials(plan, section, number)


def coming_balls(plan: CampaignPlan, trial: PlannedShot, hits: Mapping[Hit, int]) -> list[Numbered]:
    """Return the balls from `trial` on as far as the magazine goes, as if every shot were valid.

    A ball comes once: it must be picked up before it can be filled in again.
    """
    found = list[Numbered]()
    for coming, sample in islice(coming_shots(plan, trial, hits), plan.ball_handling.magazine):
        if (coming.arm.ball, sample) in found:
            break
        found.append((coming.arm.ball, sample))
    return found


def coming_shots(
    plan: CampaignPlan, trial: PlannedShot, hits: Mapping[Hit, int]
) -> Iterator[tuple[PlannedShot, int]]:
    """Yield the shots from `trial` on and the numbers of their balls, as if every shot were valid."""
    counted = Counter(hits)
    for coming in _coming_trials(plan, trial):
        sample = sample_for(plan, coming, counted)
        if sample is None:
            return
        yield coming, sample
        counted[Hit("ball", coming.arm.ball, sample)] += 1


def sample_for(plan: CampaignPlan, trial: PlannedShot, hits: Counter[Hit]) -> int | None:
    """Return the number of the ball to take: the one of its model with the fewest hits; None: all used up.

    In a split-plot all clubs of a block hit the same balls, else what differs between balls would be taken
    for a difference of clubs.
    """
    ball, handling = trial.arm.ball, plan.ball_handling
    if plan.split and trial.block:
        d = plan.design
        turn = (trial.position - 1) % plan.shots_per_mounting // len(d.balls)
        number = handling.first_sample + ((trial.block - 1) * d.hits_per_mounting + turn) % handling.samples
        if hits[Hit("ball", ball, number)] < handling.hits:
            return number
    numbers = range(handling.first_sample, handling.first_sample + handling.samples)
    hit_so_far = {hit.sample: n for hit, n in hits.items() if (hit.kind, hit.name) == ("ball", ball)}
    used = dict.fromkeys(numbers, 0) | hit_so_far
    number = min(numbers, key=used.__getitem__)
    return number if used[number] < handling.hits else None


def _coming_trials(plan: CampaignPlan, trial: PlannedShot) -> list[PlannedShot]:
    """Return the shots from `trial` to the end of its warm-up or its section, over club changes.

    A warm-up that its window does not end may take all its shots: a further load on the way would vent.
    """
    if trial.role is Role.WARM_UP:
        warm = plan.warm_up
        last = warm.window if trial.position <= warm.window else warm.at_most
        return [trial] * max(1, last + 1 - trial.position)
    section = sections(plan)[trial.section - 1]
    block = trial.block - (trial.section - 1) * plan.design.blocks
    trials = [
        each
        for number in range(block, min(block + max(1, plan.ball_handling.magazine), plan.design.blocks) + 1)
        for each in block_trials(plan, section, number)
    ]
    return trials[trial.position - 1 :]
