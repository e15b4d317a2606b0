"""Operation of a running bench by a program: lease, way to the address, correction, ball, swing, record.

After a stop a person resets and homes the bench; a simulated bench is reset, homed and armed from here.
The code of a refusal decides whether it lasts until a person has acted, or passes. Each request is sent once
between two looks at abort and interrupt: the client's own retries would ignore both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Self

import numpy as np

from bench.base.errors import Refused
from bench.base.lifecycle import Refusal, Request, State
from bench.network.bench_service import BenchStatus
from bench.network.client import LATCHED, PRESSURE_TIMEOUT, REST, BenchClient, CommandRefused
from bench.records.shot.shot_message import ShotPublication
from bench.records.telemetry.record_file import SwingRecord, read_swing
from drivers.launch_monitor.record import MatchOutcome

LEASE = 15.0
"""Duration of the lease, s: a dead program holds the bench no longer."""
READY = 60.0
"""Max time until the robot rests at its address, or until the lease of a dead program expires, s."""
_STORED = 30.0
"""Max time until a swing's record is stored, s."""
_LOOK = 0.05
"""Polling interval of the bench, s."""
_FEED = 2.0
"""Max time of a ball to the tee, s."""
_SWING = 60.0
"""Max duration of a swing, until the robot is back or stands, s."""
_RESETS = 3
"""Max number of automatic resets of a simulated bench before one swing."""
_AIR_ON = frozenset({"ARMED", "SWINGING", "RECOVERING"})
"""States that an armed robot leaves for READY only by a disarming, or after a swing without `series`."""
_LASTING = frozenset({Refusal.READ_ONLY, Refusal.BLOCKED, Refusal.CORRECTION})
"""Refusals that last until a person has calibrated, learned again or restarted the bench."""


class NoShot(Refused):
    """No ball came, or no record of the swing."""

    swung: bool
    """Whether the robot swung."""


class BenchOperator:
    """A program at a running bench; a context manager that releases the lease at its end.

    Its methods raise BenchError where the bench does not answer, refuses or does not get on in time.
    """

    def __init__(
        self,
        client: BenchClient,
        holder: str,
        *,
        simulated: bool,
        ask_person: Callable[[str], None],
        on_reset: Callable[[str], None] = lambda cause: None,
        aborted: Callable[[], bool] = lambda: False,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        """`ask_person` shows the action that a person must take first, or raises to give up.

        `on_reset` gets the cause of each stop after which a simulated bench is reset.
        `aborted` stops the robot, `interrupted` raises KeyboardInterrupt before a swing and never in one.
        """
        self.client, self.simulated = client, simulated
        self.armed_anew = False
        """Set at each arming, for the user to clear."""
        self._holder, self._ask_person, self._on_reset = holder, ask_person, on_reset
        self._aborted, self._interrupted = aborted, interrupted
        self._stack, self._lease = ExitStack(), ExitStack()
        self._held, self._resets = False, 0
        self._armed = False
        """Whether the robot was armed at the last look, and not disarmed from here or after a swing since."""
        self._outcomes: dict[str, ShotPublication] = {}
        """Outcomes of the shots since the last `begin_swing`, by shot ID."""

    def __enter__(self) -> Self:
        self._next_message = self._stack.enter_context(self.client.shots())
        self._stack.callback(self.release)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def take_lease(self) -> None:
        """Take the lease, after that of a dead program or of a person has expired.

        Raises:
            Refused: the bench restarted with a robot of another kind.
        """
        if self._held:
            return
        require_kind(self.client.status(), simulated=self.simulated)
        deadline = time.monotonic() + READY
        while not self._held:
            try:
                self._lease.enter_context(self.client.lease(self._holder, LEASE))
                self._held = True
            except CommandRefused:
                if time.monotonic() > deadline:
                    raise
                self.pause()

    def release(self) -> None:
        """Release the lease; the bench disarms."""
        self._lease.close()
        self._held = self._armed = False

    def pause(self) -> None:
        """Wait for the next look at the bench.

        Raises:
            Refused: aborted.
            KeyboardInterrupt: interrupted.
        """
        if self._aborted():
            if self._held:  # else it is the motion of another client
                self.client.stop()
            raise self.refused("aborted by request", "no request to end", "Begin again.")
        if self._interrupted():
            raise KeyboardInterrupt
        time.sleep(_LOOK)

    def rest_at_address(self) -> BenchStatus:
        """Take the robot to its address, and return the status once it rests there.

        Raises:
            CommandRefused: for what lasts, or for too long.
            Refused: too slow, without the lease, a robot of another kind, or another client has disarmed it.
        """
        deadline, held_since, asked = time.monotonic() + READY, np.inf, False
        while True:
            status = self.client.status()
            require_kind(status, simulated=self.simulated)
            self._armed = status["state"] in _AIR_ON or (self._armed and status["state"] == "READY")
            at_address = status["state"] == "ARMED" and status["phase"] == "HOLD"
            held_since = min(held_since, status["time"]) if at_address else np.inf
            if todo := self._persons_work(status):
                if not asked:
                    self._ask_person(todo)
                    self.release()
                asked, deadline = True, time.monotonic() + READY
            elif asked and status["state"] == "HOMING":
                pass  # the person still works
            elif not self._held:
                asked = False
                self.take_lease()
            else:
                self._require_lease(status)
                if at_address and status["time"] - held_since >= REST:
                    return status
                try:
                    self._bring_nearer(status)
                except CommandRefused as refused:
                    _require_passing(refused, deadline)
            if time.monotonic() > deadline:
                found = f"{in_words(status)}, not at rest at its address after {READY:g} s"
                raise self.refused(found, "rest at its address", "Look at golfbench status.")
            self.pause()

    def swing(self, prepare: Callable[[BenchStatus], bool], *, ball: bool) -> SwingRecord:
        """Swing from rest at the address, as `begin_swing` does, and return the record.

        Raises:
            NoShot: no ball or no record came.
        """
        tick = self.begin_swing(prepare, ball=ball)
        self.wait_until_over()
        deadline = time.monotonic() + _STORED
        while time.monotonic() < deadline:
            message = self._hear()
            if message is None or message["record"] is None or message["outcome"] is not None:
                continue
            if message["tick"] is not None and message["tick"] >= tick:
                path = Path(message["record"])
                record = SwingRecord(path, *read_swing(path))
                # Without `series` each swing ends vented: its record shows a disarming by another client.
                requests = record.cycles["request"][record.cycles["state"] == State.RECOVERING]
                self._armed |= bool(np.any(requests == Request.DISARM))
                return record
        raise self._no_shot(f"no record of it within {_STORED:g} s", swung=True)

    def begin_swing(self, prepare: Callable[[BenchStatus], bool], *, ball: bool) -> int:
        """Begin a swing from rest at the address; return a tick before it.

        `prepare` gets the status at the address, and returns whether the robot still rests there.
        """
        self._outcomes.clear()
        self._resets, deadline = 0, 0.0
        while True:
            status = self.rest_at_address()
            deadline = deadline or time.monotonic() + READY
            try:
                if not prepare(status):
                    deadline = 0.0
                    continue
                if ball:
                    self._tee_up()
                self.request_swing()
            except CommandRefused as refused:  # after a re-arming it may move again: that passes
                _require_passing(refused, deadline)
            else:
                return status["tick"]
            self.pause()

    def request_swing(self) -> None:
        """Request a swing; repeat it until the address pressures are as planned."""
        deadline = time.monotonic() + PRESSURE_TIMEOUT
        while True:
            try:
                self.client.swing(0.0)
            except CommandRefused as refused:
                if refused.refusal is not Refusal.AIR or time.monotonic() > deadline:
                    raise
            else:
                return
            self.pause()

    def wait_until_over(self) -> None:
        """Wait until the robot is back at its address or stands; an abort stops it at once."""
        deadline, stopped = time.monotonic() + _SWING, False
        while (status := self.client.status())["state"] in {"SWINGING", "RECOVERING"}:
            if not stopped and self._aborted():
                self.client.stop()
                stopped = True
            if time.monotonic() > deadline:
                raise self.refused(f"swing still running after {_SWING:g} s", "its end", "Check the robot.")
            time.sleep(_LOOK)
        self._armed = self._armed and status["series"]

    def message_about(self, record: SwingRecord) -> ShotPublication | None:
        """Return the launch monitor's message about the swing of `record`; None after a time-out."""
        shot, link = record.metadata.get("shot_id"), self.client.status()["launch_monitor"]
        deadline = time.monotonic() + _STORED + (0.0 if link is None else link["settled_s"])
        while shot not in self._outcomes and time.monotonic() < deadline:
            self._hear()
        return self._outcomes.get(shot or "")

    def refused(self, found: str, expected: str, action: str) -> Refused:
        """Return an error of this bench."""
        return Refused(f"bench {self.client.bench}", found, expected, action)

    def _persons_work(self, status: BenchStatus) -> str:
        """Return the action that only a person may take on the way to the address; empty if none."""
        if status["state"] == "ACCESS":
            return "the guard is unlocked: golfbench access --end"
        if not self.simulated and status["state"] in {*LATCHED, "SAFE"}:
            return f"{in_words(status)}: reset and home the bench (golfbench reset, golfbench home)"
        return ""

    def _require_lease(self, status: BenchStatus) -> None:
        lease = status["lease"]
        if lease is None or lease["holder"] != self._holder:
            found = "the bench restarted, or another holder has its lease"
            raise self.refused(found, f"the lease of {self._holder}", "Look at golfbench status.")

    def _bring_nearer(self, status: BenchStatus) -> None:
        """Request the next step on the way to the address."""
        match status["state"]:
            case "READY":
                if self._armed and status["cause"] is None:
                    action = "Find out who disarmed it and why, then begin again."
                    raise self.refused("disarmed by request of another client", "an armed robot", action)
                self.client.arm(0.0)
                self.armed_anew = True
            case "SAFE":
                self.client.home(0.0)
            case state if state in LATCHED:
                if self._resets >= _RESETS:
                    found = f"{in_words(status)}: it came back {_RESETS} times"
                    raise self.refused(found, "a bench that can be reset", "Look at golfbench status.")
                self.client.reset(0.0)
                self._resets += 1
                self._on_reset(in_words(status))

    def _tee_up(self) -> None:
        self.client.tee(0.0)
        deadline = time.monotonic() + _FEED
        while not self.client.status()["ball_present"]:
            if time.monotonic() > deadline:
                raise self._no_shot("feeder empty or jammed: no ball came", swung=False)
            self.pause()

    def _no_shot(self, found: str, *, swung: bool) -> NoShot:
        action = "Check the recorder: golfbench status." if swung else "Fill the feeder, then begin again."
        refused = NoShot(f"bench {self.client.bench}", found, "a ball, and a record of the swing", action)
        refused.swung = swung
        return refused

    def _hear(self) -> ShotPublication | None:
        """Return the next message about a shot, None if there is none yet."""
        message = self._next_message()
        if message is None:
            time.sleep(_LOOK)
        elif (shot := message["shot_id"]) and message["outcome"] in (
            MatchOutcome.MATCHED,
            MatchOutcome.NO_LAUNCH,
        ):
            self._outcomes[shot] = message
        return message


def require_kind(status: BenchStatus, *, simulated: bool) -> None:
    """Refuse a bench whose robot is not `simulated`, or is, unlike that on which the work began.

    Raises:
        Refused: it is of the other kind.
    """
    if (status["driver"] == "sim") != simulated:
        found, expected = f"driver {status['driver']}", f"{'a simulated' if simulated else 'a real'} robot"
        action = "Start the bench with the driver of the beginning (driver.name), or begin again."
        raise Refused(f"bench {status['bench']}", found, f"{expected}, as at the beginning", action)


def _require_passing(refused: CommandRefused, deadline: float) -> None:
    """Raise a permanent refusal, or any at the `deadline`."""
    if refused.refusal in _LASTING or time.monotonic() > deadline:
        raise refused


def in_words(status: BenchStatus) -> str:
    """Return the state of the bench with its cause."""
    cause = status["cause"]
    return status["state"] if cause is None else f"{status['state']}, {cause['text']}"
