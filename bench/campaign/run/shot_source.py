"""The bench, the operator and the observers of a campaign's run, as the runner sees them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from bench.campaign.plan.bench_setup import Preparation
from bench.campaign.plan.carry import Measured, carry_columns
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import PlannedShot, Step
from bench.campaign.run._corrections import Drift
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import Shot, ShotStatus, delivery_columns
from bench.records.shot.shot_matcher import reported_columns
from bench.store.rows import CampaignState, Prompt, PromptKind
from drivers.launch_monitor.record import LaunchRecord
from sim.ball import Air, Ball
from sim.impact import Delivery


class Suspended(Exception):
    """No more shots until a person has checked the bench; the text gives the reason."""


class BlockingCondition(NamedTuple):
    """A temporary hindrance to a shot."""

    text: str
    armed: bool = False
    """Whether only an armed bench at rest at its address can detect the end of the condition."""


class ShotPostponed(Exception):
    """A hindrance was met on the way to the swing; the arguments are the (kind, text) of what happened."""


class Taken(NamedTuple):
    """A shot with its record."""

    shot: Shot
    cycles: np.ndarray[Any, Any] | None
    """None if the robot did not swing."""
    metadata: Mapping[str, Any]
    struck: bool
    """Whether the ball was hit, which wears it."""
    events: tuple[tuple[str, str], ...] = ()
    """(kind, text) of the events before it."""
    stopped: bool = False
    """Whether the robot was stopped within the swing."""
    original: Path | None = None
    """The bench's own record, which is moved to the campaign's folder."""


class MonitorResult(NamedTuple):
    """Result of a shot at the launch monitor."""

    launch: LaunchRecord | None = None
    reason: str = ""
    """Reason for missing or invalid values; empty for valid ones or without a struck ball."""


def shot_row(
    step: Step,
    number: int,
    sample: int,
    time_utc: datetime,
    status: ShotStatus,
    reason: str,
    *,
    delivery: Delivery | None = None,
    air: Air | None = None,
) -> Shot:
    """Return the row of shot `number`, taken as `step` with ball `sample` in the measured `air`."""
    trial, arm = step.trial, step.trial.arm
    columns = delivery_columns(delivery)
    if air is not None:
        columns |= {
            "air_temperature_k": air.temperature,
            "air_pressure_pa": air.pressure,
            "relative_humidity": air.relative_humidity,
        }
    columns |= {"swing": arm.swing, "role": str(trial.role), "section": trial.section}
    columns |= {"attempt": step.attempt, "sample": sample, "time_utc": time_utc}
    return Shot(number, trial.block, trial.position, arm.club, arm.ball, status, reason, **columns)


def with_launch(
    shot: Shot,
    heard: MonitorResult,
    plan: CampaignPlan,
    measured: Measured,
    around: FlightConditions,
    simulated: Ball | None,
) -> Shot:
    """Return `shot` with the reported launch and its carry; excluded if one of them is in doubt.

    `measured`, `around`, `simulated` as `carry_columns` takes them.
    """
    columns, doubt = dict[str, Any](), heard.reason
    if heard.launch is not None:
        columns = reported_columns(heard.launch)
        if not doubt and (launch := heard.launch.launch) is not None:
            reported = heard.launch.carry
            carries, doubt = carry_columns(plan, measured, shot.ball, launch, around, reported, simulated)
            columns |= carries
    if doubt and not shot.reason:
        columns |= {"status": ShotStatus.EXCLUDED, "reason": doubt}
    return replace(shot, **columns)


class ShotSource:
    """A bench as a campaign sees it: by default without hindrance, and without work for a person."""

    simulated: bool

    def time_of(self, number: int) -> datetime:
        """Return the start time of shot `number`: real or virtual."""
        raise NotImplementedError

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with physical ball `sample`.

        Raises:
            Suspended: it was not taken, and none can be for now.
            ShotPostponed: it was not taken; `hindrance` returns the reason.
            KeyboardInterrupt: a stop was requested before the swing.
        """
        raise NotImplementedError

    def foresee(self, number: int, coming: Iterator[tuple[PlannedShot, int]]) -> None:
        """Prepare shot `number` and the `coming` ones with their balls, which may still change."""

    def relearn(self, drift: Drift, number: int) -> str:
        """Relearn a drifted swing before shot `number`; return the text of the event.

        Raises:
            Suspended: it cannot.
        """
        raise NotImplementedError

    def hindrance(self, step: Step) -> BlockingCondition | None:
        """Return the hindrance to `step`, None if there is none. Raises Suspended."""
        return None

    def rest(self) -> None:
        """Disarm: the time of the next shot is unknown."""

    def required_restart(self, step: Step) -> Preparation | None:
        """Return the restart of the bench that `step` requires; None if none."""
        return None

    def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        """Grant a person access to the robot, or to the whole bench. Raises Suspended as `take`.

        `ask` shows earlier work of the person, such as a reading of the gauges; empty if none. It is called
        at each look, and raises to end the wait.
        """

    def resume_after_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        """Continue after the person has confirmed the work, even if no access was granted. Raises Suspended.

        `ask` shows what else the person has to do, such as to press a button, as in `grant_access`.
        """

    def work_before_arming(self) -> str:
        """Return the work of a person between locking and arming, once; empty if none."""
        return ""


class Operator(Protocol):
    """The operator, for work the robot cannot do; answers may also come through the database."""

    name: str
    kinds: frozenset[PromptKind]
    """Kinds of prompts to show; others are answered automatically, as in simulation."""

    def show(self, prompt: Prompt) -> None:
        """Show a prompt."""
        ...

    def answered(self) -> bool:
        """Return whether the prompt was answered here; never waits."""
        ...

    def hide(self) -> None:
        """Hide the prompt: it is answered or no longer needed."""
        ...


class Watcher:
    """Receives the progress of a run and passes it on to other watchers."""

    _watchers: tuple[Watcher, ...] = ()

    def __init__(self, *watchers: Watcher) -> None:
        self._watchers = watchers

    def shot(self, shot: Shot) -> None:
        """Receive a shot."""
        for watcher in self._watchers:
            watcher.shot(shot)

    def feeder(self, balls: int) -> None:
        """Receive the number of balls left in a feeder that a person fills."""
        for watcher in self._watchers:
            watcher.feeder(balls)

    def set_aside(self, block: int) -> None:
        """Receive the number of a block that restarts: its shots so far do not count."""
        for watcher in self._watchers:
            watcher.set_aside(block)

    def say(self, text: str) -> None:
        """Receive an event."""
        for watcher in self._watchers:
            watcher.say(text)

    def standing(self, state: CampaignState, reason: str) -> None:
        """Receive the campaign's state; while it waits, `reason` is the prompt."""
        for watcher in self._watchers:
            watcher.standing(state, reason)
