"""The course of a campaign: the next shot, given those before it, and when it is over.

`course` is a generator: it yields the next step and is sent the shot that came of it. It reads no clock and
draws nothing by itself, so that sending it the stored shots of an interrupted campaign leads to the very
step that would have come next.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bench.campaign.gate import Centre, median_delivery
from bench.campaign.plan import CampaignPlan
from bench.campaign.randomization import Arm, PlannedShot, Role, Section, block_trials, sections, warm_up_arms
from bench.shot.shot import Shot, ShotStatus


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


class Restart(NamedTuple):
    """Sent in place of a shot after a long time without one: warm up again, restart the block."""


RESTART = Restart()
Decide = Callable[[CampaignPlan, Sequence[Shot]], str]
"""Returns from a section's shots why they are enough; empty if they are not."""
Planned = Mapping[tuple[str, str], Centre]
"""Designed delivery by (swing, club)."""
Course = Generator[Step, Shot | Restart, Ending]


def course(plan: CampaignPlan, planned: Planned, decide: Decide) -> Course:
    """Yield the steps of `plan`; send each one's shot.

    After a `Restart` the next step is the first one of the section's warm-up, and after that the block's.
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
) -> Generator[Step, Shot | Restart, list[Shot] | None]:
    """Take the shots of a block, the repeats included; return None if it restarts."""
    shots = []
    for trial in block_trials(plan, section, number):
        for attempt in range(1, plan.design.repeats + 2):
            shot = yield Step(trial, attempt, centres[trial.arm.swing, trial.arm.club])
            if isinstance(shot, Restart):
                return None
            shots.append(shot)
            if shot.status is ShotStatus.VALID:
                break
    return shots


def _warmed_up(
    plan: CampaignPlan, section: Section, planned: Planned
) -> Generator[Step, Shot | Restart, tuple[Planned, str]]:
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
        if plan.gate.centre == "warm-up":
            centres[arm.swing, arm.club] = median_delivery(settled, plan.clubs[arm.club])
    return centres, ""


def is_settled(plan: CampaignPlan, shot: Shot) -> bool:
    """Return whether `shot` settles its planned shot: it is valid, or was the last attempt."""
    tried = shot.status is ShotStatus.VALID or shot.attempt > plan.design.repeats
    return tried and shot.role != Role.WARM_UP


def looks_after(plan: CampaignPlan) -> frozenset[int]:
    """Return the blocks of a section after which the plan's stopping rule is checked; never the last one."""
    stop, blocks = plan.stop, plan.design.blocks
    if stop.rule == "fixed":
        return frozenset()
    points = np.linspace(stop.blocks_at_least, blocks, stop.looks)
    return frozenset(round(float(point)) for point in points) - {blocks}


def _warm_up(
    plan: CampaignPlan, section: Section, arm: Arm
) -> Generator[Step, Shot | Restart, tuple[list[Shot], str] | None]:
    """Swing until the club speed is stable; return the last shots, and the reason if it is not.

    None: restart all of the warm-up.
    """
    w, recent = plan.warm_up, list[Shot]()
    for position in range(1, w.at_most + 1):
        trial = PlannedShot(Role.WARM_UP, section.number, 0, position, arm)
        shot = yield Step(trial, 1, Centre())
        if isinstance(shot, Restart):
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
