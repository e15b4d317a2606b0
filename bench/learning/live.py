"""A running bench as its learner: correct, swing, read the record, ask what was delivered.

Nothing is done that a person at the bench could not do by its commands: the lease is held, the correction is
ordered at the address, a ball raised, a swing asked for. After a stop only a person's reset goes on; the
learner gives the lease back and waits. A simulated bench resets, homes and arms itself.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
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
from bench.shot.recorded_shot import plant_of
from bench.swing.correction import digest_of
from bench.swing.profile import Profile

Array = NDArray[np.float64]

_LEASE = 15.0
"""s; a learner that died holds the bench no longer."""
_READY = 60.0
"""s that a simulated bench, or one that is armed, may take to rest at its address."""
_SWING = 60.0
"""s that a swing may take, until the robot is back or stands."""
_AGAIN = 3
"""Times in a row that a swing is made again whose record has gaps before the ball."""


class MonitorFigures(NamedTuple):
    """What a launch monitor saw of the club; None for what it did not."""

    club_speed: float | None = None
    """m/s"""
    attack_deg: float | None = None


class LiveSwinger:
    """The swinger that a running bench is; use it as a context, at whose end the lease is given back."""

    def __init__(
        self,
        client: BenchClient,
        lecture: LearningProblem,
        source: Source,
        say: Callable[[str], None],
        ask_mark: Callable[[], tuple[float, float] | None] = lambda: None,
        *,
        with_ball: bool = True,
    ) -> None:
        """`say` tells a person what is waited for; `ask_mark` asks for the mark on the face, mm.

        Raises:
            Refused: the bench swings something else, or has no launch monitor where that is the source.
        """
        self._client, self._lecture, self._source = client, lecture, source
        self._say, self._ask_mark, self._with_ball = say, ask_mark, with_ball
        self._stack, self._lease = ExitStack(), ExitStack()
        self._held = self._settled = False
        self._digest = digest_of(lecture.bench.profile)
        status = client.status()
        self.simulated = status["driver"] == "sim"
        require_bench(status, lecture.bench.profile, source)

    def __enter__(self) -> Self:
        self._news = ShotNews(self._stack.enter_context(self._client.shots()))
        self._stack.enter_context(self._lease)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def __call__(self, weights: Array) -> ObservedSwing:
        """Swing with the correction `weights` (m,) and come to rest.

        Raises:
            BenchError: the bench does not answer, refuses, or stores nothing; no ball comes.
        """
        for _ in range(_AGAIN):
            record = self._swing(weights)
            swung, whole = self._seen(record)
            settled, self._settled = self._settled, not swung.cause
            if whole:
                return swung._replace(settled=settled)
            self._say("the record has gaps before the ball: the swing is made again")
        found = f"{_AGAIN} records with gaps before the ball"
        raise self._refused(found, "whole ones", "Look at the loop's timing: golfbench status.")

    def correct(self, weights: Array) -> None:
        """Let the swings to come be made with `weights`, once the robot rests at its address."""
        self._take_address()
        self._client.correct(self._digest, weights.tolist() if np.any(weights) else [])

    def _swing(self, weights: Array) -> SwingRecord:
        self.correct(weights)
        self._news.forget()
        if self._with_ball and not tee_up(self._client, _pause):
            raise self._refused("no ball came to the tee", "a ball", "Fill the feeder, then learn again.")
        tick = self._client.status()["tick"]
        self._client.swing()
        deadline = time.monotonic() + _SWING
        while self._client.status()["state"] in {"SWINGING", "RECOVERING"}:
            if time.monotonic() > deadline:
                raise self._refused(f"a swing under way after {_SWING:g} s", "its end", "Look at the robot.")
            _pause()
        record = self._news.record_since(tick)
        if record is None:
            raise self._refused("no record of the swing", "its Parquet file", "Look at golfbench status.")
        return record

    def _seen(self, record: SwingRecord) -> tuple[ObservedSwing, bool]:
        """Return what `record` tells of its swing, and whether it has no gap before the ball."""
        profile, metadata = self._lecture.bench.profile, record.metadata
        cycles, missing = swung_cycles(record.cycles, len(profile.angle))
        cause = Cause[metadata["outcome"]["cause"]]
        if cause:
            return ObservedSwing(cycles, UNKNOWN, cause), True
        if missing[profile.begins[3] : profile.begins[6] + 1].any():
            return ObservedSwing(cycles, UNKNOWN, cause), False
        # Its calibration, at the model's masses and friction.
        encoders = plant_of(metadata, str(record.path))[0].encoders
        plant = replace(self._lecture.bench.model, encoders=encoders)
        monitor, mark = MonitorFigures(), None
        if self._source == "launch-monitor":
            monitor = self._told(record)
        elif self._source == "impact-marks":
            mark = self._ask_mark()
        figures = figures_from(
            self._source, cycles, plant, self._lecture.response.free, mark=mark, **monitor._asdict()
        )
        return ObservedSwing(cycles, figures, cause), True

    def _told(self, record: SwingRecord) -> MonitorFigures:
        told = self._news.message_about(record, self._client.status())
        if told is None or told.launch is None:
            self._say("the launch monitor saw nothing of this swing: the encoders tell of it")
            return MonitorFigures()
        club = told.launch.club
        attack = None if club.attack_angle is None else float(np.degrees(club.attack_angle))
        silent = [
            name for name, value in (("speed", club.speed), ("angle of attack", attack)) if value is None
        ]
        if silent:
            self._say(f"the launch monitor tells no {' and no '.join(silent)} of the club: the encoders do")
        return MonitorFigures(club.speed, attack)

    # The way to the address ------------------------------------------------------------------------

    def _take_address(self) -> None:
        """Wait until the robot has rested at its address, as far as may be asked for by itself."""
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
                    self._give_back()
                    self._say(
                        f"{in_words(status)}: reset and home the bench (golfbench reset, golfbench home), "
                        "learning goes on then; Ctrl-C ends it"
                    )
                waits, deadline = True, time.monotonic() + _READY
            else:
                waits = False
                try:
                    self._bring_nearer(status)
                except CommandRefused:  # not at rest, not vented, somebody else's: the time decides
                    if time.monotonic() > deadline:
                        raise
            if time.monotonic() > deadline:
                raise self._refused(
                    f"{status['state']} in phase {status['phase']} after {_READY:g} s",
                    "rest at its address",
                    "Look at golfbench status.",
                )
            _pause()

    def _bring_nearer(self, status: BenchStatus) -> None:
        """Take the lease, or ask for the next step to the address."""
        if not self._held:
            self._lease.enter_context(self._client.lease("learn", _LEASE))
            self._held = True
            return
        match status["state"]:
            case "READY":
                self._settled = False
                self._client.arm()
            case "ESTOP" | "FAULT":
                self._client.reset()
            case "SAFE":
                self._client.home()
            case "ACCESS":
                self._client.secure()

    def _give_back(self) -> None:
        self._lease.close()
        self._held = False

    def _refused(self, found: str, expected: str, cure: str) -> Refused:
        return Refused(f"learning on bench {self._client.bench}", found, expected, cure)


def _pause() -> None:
    time.sleep(LOOK)


def require_bench(status: BenchStatus, profile: Profile, source: Source) -> None:
    """Refuse a bench that swings something else, or has no launch monitor where that is the `source`.

    Raises:
        Refused: the text says which.
    """
    if status["profile"] != profile.name:
        raise Refused(
            f"bench {status['bench']}",
            f"it swings {status['profile']}",
            profile.name,
            f"Start it with golfbench run --profile {profile.name}, or learn what it swings.",
        )
    link = status["launch_monitor"]
    if source == "launch-monitor" and (link is None or not link["present"]):
        raise Refused(
            f"bench {status['bench']}: launch monitor",
            "none" if link is None else "none is connected",
            "one that tells of the club",
            "Enable and connect it ([launch_monitor] enabled = true), or choose another --source.",
        )


def swung_cycles(cycles: np.ndarray[Any, Any], length: int) -> tuple[np.ndarray[Any, Any], NDArray[np.bool_]]:
    """Return `length` cycles, one a tick from that of the accepted swing on, and which are missing.

    What is missing repeats the cycle before it, with an angle that is no number.

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
