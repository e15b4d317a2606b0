"""Learning on a running bench: correct, swing, read the record, get the delivery.

The learner uses the commands that a person at the bench has: it holds the lease, sends the correction at the
address, raises a ball, requests a swing. After a stop a person has to reset the bench; the learner releases
the lease and waits. A simulated bench resets, homes and arms itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from bench.errors import Refused
from bench.learning.figures import UNKNOWN
from bench.learning.learn import LearningProblem, ObservedSwing
from bench.learning.measured import figures_from
from bench.learning.source import Source
from bench.lifecycle import Answer, Cause, Request
from bench.network.bench_service import BenchStatus
from bench.network.client import LATCHED, REST, BenchClient, CommandRefused
from bench.network.live_swing import LOOK, ShotNews, SwingRecord, in_words, tee_up
from bench.network.status_words import launch_monitor_text
from bench.shot.recorded_shot import plant_of
from bench.swing.correction import digest_of
from bench.swing.profile import Profile

Array = NDArray[np.float64]

_LEASE = 15.0
"""Expiry of the lease, s: after it a dead learner no longer holds the bench."""
_READY = 60.0
"""Time-out for a simulated or armed bench to rest at its address, s."""
_SWING = 60.0
"""Time-out of a swing until the robot is back or stands, s."""
_AGAIN = 3
"""Max attempts at a swing whose record has gaps before the ball."""


class MonitorFigures(NamedTuple):
    """Club data of a launch monitor; None if not measured."""

    club_speed: float | None = None
    """m/s"""
    attack_deg: float | None = None


class LiveSwinger:
    """A running bench as a swinger; a context manager that releases the lease at its end."""

    def __init__(
        self,
        client: BenchClient,
        problem: LearningProblem,
        source: Source,
        say: Callable[[str], None],
        ask_mark: Callable[[], tuple[float, float] | None] = lambda: None,
        *,
        with_ball: bool = True,
    ) -> None:
        """`say` shows a message to a person; `ask_mark` asks for the mark on the face, mm.

        Raises:
            Refused: the bench has another profile, or no launch monitor if that is the source.
        """
        self._client, self._lecture, self._source = client, problem, source
        self._say, self._ask_mark, self._with_ball = say, ask_mark, with_ball
        self._stack, self._lease = ExitStack(), ExitStack()
        self._held, self._planned_air = False, bool(problem.bench.profile.air)
        self._settled = self._planned_air
        self._digest = digest_of(problem.bench.profile)
        status = client.status()
        self.simulated = status["driver"] == "sim"
        require_bench(status, problem.bench.profile, source)

    def __enter__(self) -> Self:
        self._news = ShotNews(self._stack.enter_context(self._client.shots()))
        self._stack.enter_context(self._lease)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def __call__(self, weights: Array) -> ObservedSwing:
        """Swing with the correction `weights` (m,) and come to rest.

        Raises:
            BenchError: the bench does not answer, refuses, or stores nothing; no ball comes.
        """
        for _ in range(_AGAIN):
            record = self._swing(weights)
            swung, whole = self._seen(record)
            settled, self._settled = self._settled, self._planned_air or not swung.cause
            if whole:
                return swung._replace(settled=settled)
            self._say("the record has gaps before the ball: the swing is repeated")
        found = f"{_AGAIN} records with gaps before the ball"
        raise self._refused(found, "complete records", "Check the loop timing: golfbench status.")

    def correct(self, weights: Array) -> None:
        """Send the correction `weights` for the next swings, once the robot rests at its address."""
        self._take_address()
        self._client.correct(self._digest, weights.tolist() if np.any(weights) else [])

    def _swing(self, weights: Array) -> SwingRecord:
        self._news.forget()
        tick = self._begin(weights)
        deadline = time.monotonic() + _SWING
        while self._client.status()["state"] in {"SWINGING", "RECOVERING"}:
            if time.monotonic() > deadline:
                raise self._refused(f"swing still running after {_SWING:g} s", "its end", "Check the robot.")
            _pause()
        record = self._news.record_since(tick)
        if record is None:
            raise self._refused(
                "no record of the swing", "its Parquet file", "Check the recorder: golfbench status."
            )
        return record

    def _begin(self, weights: Array) -> int:
        """Begin a swing as soon as the bench accepts it; return a tick before it."""
        deadline = time.monotonic() + _READY
        while True:
            self.correct(weights)
            if self._with_ball and not tee_up(self._client, _pause):
                raise self._refused("no ball came to the tee", "a ball", "Fill the feeder, then learn again.")
            tick = self._client.status()["tick"]
            try:
                self._client.swing()
            except CommandRefused:  # after a re-arming it may move again: that passes, or the time does
                if time.monotonic() > deadline:
                    raise
                _pause()
            else:
                return tick

    def _seen(self, record: SwingRecord) -> tuple[ObservedSwing, bool]:
        """Return the swing in `record`, and whether the record is complete up to the ball."""
        profile, metadata = self._lecture.bench.profile, record.metadata
        cycles, missing = swung_cycles(record.cycles, len(profile.angle))
        cause = Cause[metadata["outcome"]["cause"]]
        if cause:
            return ObservedSwing(cycles, UNKNOWN, cause), True
        if missing[profile.begins[3] : profile.begins[6] + 1].any():
            return ObservedSwing(cycles, UNKNOWN, cause), False
        # The record's calibration, with the model's masses and friction.
        encoders = plant_of(metadata, str(record.path))[0].encoders
        plant = replace(self._lecture.bench.model, encoders=encoders)
        monitor, mark = MonitorFigures(), None
        if self._source == "launch-monitor":
            monitor = self._monitored(record)
        elif self._source == "impact-marks":
            mark = self._ask_mark()
        figures = figures_from(
            self._source, cycles, plant, self._lecture.response.free, mark=mark, **monitor._asdict()
        )
        return ObservedSwing(cycles, figures, cause), True

    def _monitored(self, record: SwingRecord) -> MonitorFigures:
        shot = self._news.message_about(record, self._client.status())
        if shot is None or shot.launch is None:
            self._say("no launch monitor data for this swing: encoder data are used")
            return MonitorFigures()
        club = shot.launch.club
        attack = None if club.attack_angle is None else float(np.degrees(club.attack_angle))
        silent = [
            name for name, value in (("speed", club.speed), ("angle of attack", attack)) if value is None
        ]
        if silent:
            self._say(f"no club {' and no '.join(silent)} from the launch monitor: encoder data are used")
        return MonitorFigures(club.speed, attack)

    # The way to the address ------------------------------------------------------------------------

    def _take_address(self) -> None:
        """Wait until the robot rests at its address; on a simulated bench, take it there."""
        deadline, held_since, waits = time.monotonic() + _READY, np.inf, False
        while True:
            status = self._client.status()
            if status["state"] == "ARMED" and status["phase"] == "HOLD" and self._held:
                held_since = min(held_since, status["time"])
                if status["time"] - held_since >= REST:
                    return
            else:
                held_since = np.inf
            if not self.simulated and status["state"] in {*LATCHED, "SAFE", "HOMING", "ACCESS"}:
                if not waits:
                    self._release()
                    self._say(
                        f"{in_words(status)}: reset and home the bench (golfbench reset, golfbench home), "
                        "then learning continues; Ctrl-C ends it"
                    )
                waits, deadline = True, time.monotonic() + _READY
            else:
                waits = False
                try:
                    self._bring_nearer(status)
                except CommandRefused:
                    # Not at rest, not vented, or the lease is held by others: retry until the time-out.
                    if time.monotonic() > deadline:
                        raise
            if time.monotonic() > deadline:
                raise self._refused(
                    f"{status['state']} in phase {status['phase']} after {_READY:g} s",
                    "rest at its address",
                    "Check golfbench status.",
                )
            _pause()

    def _bring_nearer(self, status: BenchStatus) -> None:
        """Take the lease, or request the next step to the address."""
        if not self._held:
            self._lease.enter_context(self._client.lease("learn", _LEASE))
            self._held = True
            return
        match status["state"]:
            case "READY":
                self._settled = self._planned_air
                self._client.arm()
            case "ESTOP" | "FAULT":
                self._client.reset()
            case "SAFE":
                self._client.home()
            case "ACCESS":
                self._client.secure()

    def _release(self) -> None:
        self._lease.close()
        self._held = False

    def _refused(self, found: str, expected: str, cure: str) -> Refused:
        return Refused(f"learning on bench {self._client.bench}", found, expected, cure)


def _pause() -> None:
    time.sleep(LOOK)


def require_bench(status: BenchStatus, profile: Profile, source: Source) -> None:
    """Refuse a bench with another profile, or without a launch monitor if that is the `source`.

    Raises:
        Refused: the text says which.
    """
    if status["profile"] != profile.name:
        raise Refused(
            f"bench {status['bench']}",
            f"it swings {status['profile']}",
            profile.name,
            f"Start it with golfbench run --profile {profile.name}, or learn the swing that it runs.",
        )
    link = status["launch_monitor"]
    if source == "launch-monitor" and (link is None or not link["present"]):
        raise Refused(
            f"bench {status['bench']}: launch monitor",
            "disabled" if link is None else launch_monitor_text(link),
            "a launch monitor with club data",
            "Enable and connect it ([launch_monitor] enabled = true), or choose another --source.",
        )


def swung_cycles(cycles: np.ndarray[Any, Any], length: int) -> tuple[np.ndarray[Any, Any], NDArray[np.bool_]]:
    """Return `length` cycles, one a tick from the accepted swing on, and which of them are missing.

    A missing cycle repeats the one before it, with NaN as its angle.

    Raises:
        ValueError: no swing begins in `cycles`.
    """
    begins = np.flatnonzero((cycles["request"] == Request.SWING) & (cycles["answer"] == Answer.ACCEPTED))
    if not len(begins):
        raise ValueError("no swing begins in this record")
    first = int(cycles["tick"][begins[0]])
    wanted = np.arange(first, first + length)
    rows = np.searchsorted(cycles["tick"], wanted, side="right") - 1
    missing = cycles["tick"][rows] != wanted
    # As bytes: numpy joins records field by field and leaves their padding to chance.
    whole = cycles.view(np.ndarray)[rows].copy()
    whole["angle"][missing] = np.nan
    return whole, missing
