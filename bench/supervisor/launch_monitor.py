"""The launch monitor process of a running bench. `python -m bench.supervisor.launch_monitor`.

It listens for launch monitors, detects swings in the ring, matches both and reports each outcome; if
configured it forwards launches to GSPro. Plan: a pickled LaunchMonitorPlan on stdin. Output on stdout, one
JSON line each:

`ready`      it reads the ring; `link` reports whether it listens
`shot`       `message`: a settled outcome, as `bench.records.shot.shot_message` describes it, without its
             record
`link`       `link`: status of the connections (`LaunchMonitorStatus`); on change and every second
`fault`    `text`: it cannot listen and retries
`recovered`   it listens again
`failed`     `location`, `found`, `expected`, `action`, `exit_code`: it cannot work at all
`ended`      no further keys

It ends on SIGTERM or when its supervisor is gone. Outcomes that are unsettled at its end remain so.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from math import inf
from typing import Any

import numpy as np

from bench.base.errors import ExitCode
from bench.base.lifecycle import State
from bench.network.bench_service import LaunchMonitorStatus, MonitorStatus, SimulatorStatus
from bench.records.shot.recorded_shot import shot_to_json
from bench.records.shot.shot_matcher import SettledOutcome, ShotMatcher, SwingWatch
from bench.records.shot.shot_message import ShotPublication, launch_to_json, shortened, shot_publication
from bench.records.telemetry.ring import RingReader
from bench.supervisor.child_process import (
    RING_FILE,
    Condition,
    HeartbeatSender,
    LaunchMonitorPlan,
    begin_service,
    send_event,
)
from drivers.base import DriverError
from drivers.launch_monitor.record import CLUB_DELAY
from drivers.launch_monitor.server import LaunchMonitorServer
from drivers.launch_monitor.simulator_link import SimulatorClient

SEEN_WITHIN = 120.0
"""Time after a struck ball within which the monitor must have sent something, s: two shots of a series."""


class ShotPresence:
    """Presence of a launch monitor, by its answers to struck balls; times in s on one clock."""

    def __init__(self) -> None:
        self._unanswered: float | None = None
        """Impact of the first ball since the monitor was last seen."""

    def note_struck(self, impact: float) -> None:
        """Note a struck ball."""
        if self._unanswered is None:
            self._unanswered = impact

    def is_present(self, seen: float | None, now: float) -> bool:
        """Return whether the monitor answers struck balls in time; `seen` is the time of its last message."""
        if self._unanswered is not None and seen is not None and seen >= self._unanswered:
            self._unanswered = None
        return self._unanswered is None or now - self._unanswered <= SEEN_WITHIN


class ArmingMonitor:
    """Follows the state of the bench; for one run of its loop."""

    def __init__(self) -> None:
        self._armed = False

    def take(self, cycles: np.ndarray[Any, Any]) -> bool:
        """Return whether the bench was armed within `cycles`, which continue those of the last call."""
        if not len(cycles):
            return False
        armed = cycles["state"] == State.ARMED
        before = np.concatenate([[self._armed], armed[:-1]])
        self._armed = bool(armed[-1])
        return bool(np.any(armed & ~before))


POLL = 0.01
"""Polling period, s."""
_RING = 1 << 16
"""Max records read at once: more than the ring holds."""
_LINK = 1.0
"""Period of unchanged status reports, s."""
_LISTEN = 2.0
"""Time between two attempts to listen, s."""


class LaunchMonitorService:
    """One run of the process; call `turn` once per polling period."""

    def __init__(self, plan: LaunchMonitorPlan) -> None:
        """Open the shared files and start connecting to the simulator, if enabled.

        Raises:
            BenchError, SharedMemoryError: a shared file is unusable.
        """
        settings = plan.settings
        self._stack = ExitStack()
        try:
            self._heartbeat = HeartbeatSender(plan.folder, "launch monitor")
            self._stack.callback(self._heartbeat.close)
            self._ring = RingReader(plan.folder / RING_FILE)
            self._stack.callback(self._ring.close)
            self._server = LaunchMonitorServer(settings)
            self._stack.callback(self._server.close)
            self._club = plan.club
            self._server.announce_player(self._club)
            self._client: SimulatorClient | None = None
            if settings.simulator.enabled:
                self._client = SimulatorClient(settings.simulator)
                self._client.open()
                self._stack.callback(self._client.close)
        except BaseException:
            self._stack.close()
            raise
        self._window = settings.window
        self._watch = SwingWatch(plan.run, wall=plan.wall)
        self._book = ShotMatcher(settings.window, plan.plant, plan.around)
        self._per_shot, self._presence = settings.presence == "per_shot", ShotPresence()
        self._lost = 0
        self._arming, self._due = ArmingMonitor(), inf
        self._fault = "not listening yet"
        self._listen_at = self._link_at = -float("inf")
        self._linked: Any = None

    def turn(self, now: float, utc: datetime) -> None:
        """Listen, read swings and launches, match and report, at `now` (s, CLOCK_MONOTONIC) and `utc`."""
        if self._fault and now >= self._listen_at:
            self._listen(now)
        # Read all records: the newest shows how far the loop's clock is behind, and a launch must not expire
        # while its swing is already in the ring.
        cycles = self._ring.read(_RING)
        lost, self._lost = self._ring.lost > self._lost, self._ring.lost
        for swing in self._watch.take(cycles, now, lost=lost):
            self._book.note_swing(swing, utc)
            if swing.struck and swing.impact is not None:
                self._presence.note_struck(swing.impact)
        self._book.note_launches(self._server.take())
        self._book.note_asides(self._server.take_asides())
        if self._arming.take(cycles):
            self._due = now + CLUB_DELAY
        awaited = self._book.awaits_launch
        if self._due < inf and (not awaited or now >= self._due):  # a monitor that measures is not armed anew
            self._server.announce_player(self._club)
            self._due = inf
        not_ready = awaited and any(one.ready is False for one in self._server.link().connected)
        for told in self._book.settle(now, not_ready=not_ready):
            send_event("shot", message=message_of(told))
            self._pass_on(told)
        self._report_link(now)
        condition = Condition.FAULT if self._fault else Condition.WORKING
        self._heartbeat.beat(now, condition, lost=self._ring.lost, done=sum(self._book.counts.values()))

    def close(self) -> None:
        """Close all connections and unmap the shared files."""
        self._stack.close()

    def _listen(self, now: float) -> None:
        try:
            self._server.open()
        except DriverError as error:
            if str(error) != self._fault:
                send_event("fault", text=str(error))
            self._fault, self._listen_at = str(error), now + _LISTEN
            return
        if self._listen_at > 0.0:
            send_event("recovered")
        self._fault = ""

    def _pass_on(self, told: SettledOutcome) -> None:
        """Forward an undoubted launch of this bench to the simulator."""
        launch = None if told.launch is None or told.reason else told.launch.launch
        if self._client is not None and launch is not None and told.launch is not None:
            self._client.send(launch, told.launch.club, told.launch.carry)

    def _report_link(self, now: float) -> None:
        link = self._status(now)
        essence = (
            [(one["address"], one["device"], one["ready"]) for one in link["monitors"]],
            link["present"],
            link["note"],
            link["refused"],
            link["simulator"],
            link["outcomes"],
        )
        if essence != self._linked or now - self._link_at >= _LINK:
            self._linked, self._link_at = essence, now
            send_event("link", link=link)

    def _status(self, now: float) -> LaunchMonitorStatus:
        link = self._server.link()
        listening = "" if self._fault else "{}:{}".format(*self._server.address)
        monitors = [
            MonitorStatus(
                address=one.address,
                device=one.device,
                silent_s=round(one.silent, 3),
                ready=one.ready,
                ball_detected=one.ball_detected,
            )
            for one in link.connected
        ]
        simulator: SimulatorStatus | None = None
        if self._client is not None:
            p = self._client.status()
            simulator = SimulatorStatus(
                connected=p.connected,
                fault=shortened(p.fault),
                taken=p.taken,
                refused=p.refused + p.out_of_date,
            )
        note = self._fault
        seen = link.understood
        present = self._presence.is_present(seen, now) if self._per_shot else bool(monitors)
        if len(monitors) > 1 and not self._per_shot:
            note = note or f"{len(monitors)} monitors are connected: duplicate launches are marked doubtful"
        return LaunchMonitorStatus(
            listening=listening,
            presence="per_shot" if self._per_shot else "connected",
            present=present and not self._fault,
            seen_s=None if seen is None else round(max(0.0, now - seen), 3),
            monitors=monitors,
            note=shortened(note),
            outcomes={str(outcome): count for outcome, count in self._book.counts.items()},
            settled_s=self._window.latest,
            refused=link.counts.refused + link.counts.too_large + link.counts.cut_off + link.rejected,
            refusal=shortened(link.refusal),
            simulator=simulator,
        )


def message_of(told: SettledOutcome) -> ShotPublication:
    """Return the message of a settled outcome; the supervisor adds its record."""
    return shot_publication(
        shot_id=told.shot_id or None,
        shot=None if told.shot is None else shot_to_json(told.shot),
        outcome=told.outcome,
        launch=None if told.launch is None else launch_to_json(told.launch),
        reason=shortened(told.reason),
    )


def main() -> int:
    """Run until stopped by the supervisor or orphaned."""
    parent, service = begin_service(LaunchMonitorService)
    try:
        while not parent.wants_end:
            service.turn(time.monotonic(), datetime.now(UTC))
            time.sleep(POLL)
    finally:
        service.close()
    send_event("ended")
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
