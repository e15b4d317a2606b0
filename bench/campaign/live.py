"""Shots of a running bench, over the network and in real time.

A shot is: make the bench ready, raise a ball, swing once it rests at its address, wait for its record.
What the club did is told by the record. What the ball did is known of a simulated bench only, whose launch
monitor is computed here from the delivery: a real bench has none yet.

After a stop only a person's reset and arming go on. A simulated bench resets, homes and arms itself, and each
time is an event of the campaign.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from bench.campaign.course import Step
from bench.campaign.plan import Plan
from bench.campaign.runner import Suspended
from bench.campaign.shot import Shot, Status
from bench.campaign.simulated import Taken, ball_as_hit, monitored, random_of
from bench.client import LATCHED, BenchClient, CommandRefused
from bench.desk import Status as BenchStatus
from bench.errors import BenchError, Refused
from bench.swing.profile import Profile
from bench.telemetry.recorded_shot import ball_struck, delivery_of_cycles, plant_of
from bench.telemetry.recorder import read_swing
from sim.flight import fly
from sim.impact import Delivery, strike

LEASE = 15.0
"""s; a runner that died holds the bench no longer."""
_LOOK = 0.05
"""s between two looks at the bench."""
_READY = 60.0
"""s that it may take to rest at its address, or until the lease of a runner that died is over."""
_HOLD = 1.0
"""s at the address before a swing: the air in the chambers comes to rest later than the robot."""
_SWING = 60.0
"""s that a swing may take, until the robot is back or stands."""
_STORED = 30.0
"""s that its record may take."""
_RESETS = 3
"""Before one shot, after which even a simulated bench is left to a person."""


Events = tuple[tuple[str, str], ...]


class _Record(NamedTuple):
    path: Path
    cycles: np.ndarray[Any, Any]
    metadata: dict[str, Any]


def require_live(plan: Plan, profiles: Mapping[str, Profile], status: BenchStatus) -> None:
    """Refuse a plan that the running bench cannot swing by itself.

    Raises:
        Refused: it asks for another swing, for several clubs, or for what nobody measures.
    """
    design, profile = plan.design, status["profile"]
    if [profiles[swing].name for swing in design.swings] != [profile]:
        raise Refused(
            f"plan {plan.campaign.name}: design.swings",
            ", ".join(design.swings),
            f"{profile}, which bench {status['bench']} swings",
            "Start the bench with that profile: golfbench run --profile; one campaign a swing.",
        )
    if len(design.clubs) > 1:
        raise Refused(
            f"plan {plan.campaign.name}: design.clubs",
            ", ".join(design.clubs),
            "one club, the mounted one",
            "Run one campaign a club, or with --sim.",
        )
    if status["driver"] != "sim" and plan.analysis.quantity != "club_speed_mps":
        raise Refused(
            f"plan {plan.campaign.name}: analysis.quantity",
            plan.analysis.quantity,
            "club_speed_mps",
            "A real bench measures the club only; what the ball does takes a launch monitor.",
        )


class LiveShots:
    """The running bench as a campaign sees it; use it as a context, at whose end the lease is given back."""

    def __init__(
        self,
        plan: Plan,
        client: BenchClient,
        holder: str,
        *,
        simulated: bool,
        interrupted: Callable[[], bool],
        aborted: Callable[[], bool],
    ) -> None:
        """`holder` takes the lease at the first shot; `aborted` stops a swing, `interrupted` does not."""
        self._plan, self._client, self._holder, self.simulated = plan, client, holder, simulated
        self._interrupted, self._aborted = interrupted, aborted
        self._stack = ExitStack()
        self._held = False

    def __enter__(self) -> Self:
        self._next_record = self._stack.enter_context(self._client.records())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def time_of(self, number: int) -> datetime:
        """Return the clock's time."""
        return datetime.now(UTC)

    def rest(self) -> None:
        """Let the air out."""
        with suppress(BenchError):  # it is not armed, or the next shot tells
            self._client.disarm()

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with ball `sample`; raises as `ShotSource.take`."""
        events: list[tuple[str, str]] = []
        try:
            self._take_lease()
            tick = self._swing(events)
            self._wait_until_over()
            record = self._record_since(tick)
        except BenchError as error:
            raise Suspended(f"{error.place}: {error.found}") from error
        return self._taken(step, number, sample, record, tuple(events))

    # Moving the bench ------------------------------------------------------------------------------

    def _take_lease(self) -> None:
        """Hold the bench; that of a runner of this campaign that died is waited for."""
        deadline = time.monotonic() + _READY
        while not self._held:
            try:
                self._stack.enter_context(self._client.lease(self._holder, LEASE))
                self._held = True
            except CommandRefused:
                lease = self._client.status()["lease"]
                other = lease is not None and lease["holder"] != self._holder
                if other or time.monotonic() > deadline:
                    raise
                self._pause()

    def _swing(self, events: list[tuple[str, str]]) -> int:
        """Swing as soon as the robot rests at its address; return a tick before."""
        deadline, resets, held_since = time.monotonic() + _READY, 0, np.inf
        while True:
            status = self._client.status()
            lease = status["lease"]
            if lease is None or lease["holder"] != self._holder:
                raise Suspended("the bench was started anew, or its lease given to somebody else")
            try:
                if status["state"] == "ARMED" and status["phase"] == "HOLD":
                    held_since = min(held_since, status["time"])
                    if status["time"] - held_since >= _HOLD:
                        self._client.tee()
                        self._client.swing()
                        return status["tick"]
                else:
                    held_since = np.inf
                if status["state"] in LATCHED and resets >= _RESETS:
                    raise Suspended(f"{_words(status)}: it came back {resets} times")
                if self._bring_nearer(status):
                    resets += 1
                    events.append(
                        ("reset", f"{_words(status)}; a simulated bench resets, homes and arms itself")
                    )
            except CommandRefused:  # not at rest, not vented, guard still open: all pass, or the time does
                if time.monotonic() > deadline:
                    raise
            if time.monotonic() > deadline:
                raise Suspended(f"{_words(status)}, not at rest at its address after {_READY:g} s")
            self._pause()

    def _bring_nearer(self, status: BenchStatus) -> bool:
        """Ask for the next step on the way to the address; tell whether it was a reset."""
        match status["state"]:
            case "READY":
                self._client.arm()
            case "ESTOP" | "FAULT" | "SAFE" if not self.simulated:
                raise Suspended(f"{_words(status)}: reset and home it, then resume")
            case "ESTOP" | "FAULT":
                self._client.reset()
                return True
            case "SAFE":
                self._client.home()
            case "ACCESS":
                raise Suspended("the guard is unlocked: golfbench secure, then resume")
        return False

    def _pause(self) -> None:
        """Wait for the next look, unless somebody asks to end before the swing."""
        if self._aborted():
            self._client.stop()
            raise Suspended("aborted by request")
        if self._interrupted():
            raise KeyboardInterrupt
        time.sleep(_LOOK)

    def _wait_until_over(self) -> None:
        """Wait until the robot is back at its address or stands; an abort stops it at once."""
        deadline, stopped = time.monotonic() + _SWING, False
        while self._client.status()["state"] in {"SWINGING", "RECOVERING"}:
            if not stopped and self._aborted():
                self._client.stop()
                stopped = True
            if time.monotonic() > deadline:
                raise Suspended(f"a swing was not over after {_SWING:g} s")
            time.sleep(_LOOK)

    def _record_since(self, tick: int) -> _Record | None:
        """Return the record of the swing begun after `tick`; None when it does not come."""
        deadline = time.monotonic() + _STORED
        while time.monotonic() < deadline:
            if (path := self._next_record()) is None:
                time.sleep(_LOOK)
                continue
            cycles, metadata = read_swing(path)
            states = metadata.get("outcome", {}).get("states", [])
            if any(name == "SWINGING" and at >= tick for at, name in states):
                return _Record(path, cycles, metadata)
        return None

    # What came of it -------------------------------------------------------------------------------

    def _taken(self, step: Step, number: int, sample: int, record: _Record | None, events: Events) -> Taken:
        trial, arm = step.trial, step.trial.arm
        row: dict[str, Any] = {
            "shot": number, "block": trial.block, "position": trial.position, "club": arm.club,
            "ball": arm.ball, "swing": arm.swing, "role": str(trial.role), "section": trial.section,
            "attempt": step.attempt, "sample": sample, "carry_source": "model",
        }  # fmt: skip
        if record is None:
            shot = Shot.from_measurements(
                **row, delivery=None, launch=None, flight=None, status=Status.FAILED,
                reason=f"no record of it within {_STORED:g} s", time_utc=datetime.now(UTC),
            )  # fmt: skip
            return Taken(shot, None, {}, True, events)
        metadata, cycles = record.metadata, record.cycles
        plant, around = plant_of(metadata, str(record.path))
        if plant.robot.club.name != arm.club:
            raise Suspended(f"the bench swings club {plant.robot.club.name}, the plan {arm.club}")
        delivery, struck = delivery_of_cycles(cycles, plant), ball_struck(cycles)
        reason = _failure(metadata, delivery, struck)
        status = Status.FAILED if reason else Status.VALID
        if not reason and not metadata["complete"]:
            status, reason = Status.EXCLUDED, f"{metadata['lost_records']} cycles of its record are missing"
        launch, flight, more = None, None, dict[str, Any]()
        if self.simulated and delivery is not None and struck:
            draws = random_of(self._plan, number).standard_normal(6)
            ball = ball_as_hit(self._plan, arm.ball, sample, number, float(draws[0]))
            more["varied"] = {
                "restitution_factor": ball.restitution_factor,
                "struck_in_the_plant": plant.ball.name,
            }
            try:
                launch = monitored(self._plan.simulation, strike(delivery, plant.robot.club, ball), draws[2:])
                flight = fly(launch, around.air, ball, around.wind, around.turf)
            except ValueError as error:
                status, reason = Status.EXCLUDED, reason or f"no flight: {error}"
        if self.simulated:  # a real bench measures none of these yet
            row |= {
                "air_temperature_k": around.air.temperature,
                "air_pressure_pa": around.air.pressure,
                "relative_humidity": around.air.relative_humidity,
            }
        shot = Shot.from_measurements(
            **row, delivery=delivery, launch=launch, flight=flight, status=status, reason=reason,
            time_utc=datetime.fromisoformat(metadata["time_utc"]),
        )  # fmt: skip
        return Taken(shot, cycles, {**metadata, "record": str(record.path), **more}, struck, events)


def _failure(metadata: dict[str, Any], delivery: Delivery | None, struck: bool) -> str:
    """Return why a swing was no shot; empty when it was."""
    if metadata["outcome"]["cause"] != "NONE":
        return str(metadata["outcome"]["text"])
    if delivery is None:
        return "no swing through the ball's place"
    return "" if struck else "no ball struck"


def _words(status: BenchStatus) -> str:
    """Return the state with its cause."""
    cause = status["cause"]
    return status["state"] if cause is None else f"{status['state']}, {cause['text']}"
