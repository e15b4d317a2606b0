"""The launch monitor's side of a running bench. `python -m bench.processes.launch_monitor`.

It listens for a launch monitor, sees the swings go by in the ring, matches both and tells what became of
each; it passes launches on to GSPro where that is configured. Plan: a pickled LaunchMonitorPlan on stdin.
Told on stdout, one JSON line each:

`ready`      it reads the ring; whether it listens, `link` tells
`shot`       `message`: a settled outcome, as `bench.shot.shot_message` describes it, without its record
`link`       `link`: how the connections are (`LaunchMonitorStatus`); on change and every second
`trouble`    `text`: it cannot listen; it tries again
`relieved`   that is over
`failed`     `place`, `found`, `expected`, `cure`, `exit_code`: it cannot work at all
`ended`      nothing else

It ends by SIGTERM or when its supervisor is gone. What is not settled then stays unsettled.
"""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import Any

from bench.errors import BenchError, ExitCode
from bench.network.bench_service import LaunchMonitorStatus, MonitorStatus, SimulatorStatus
from bench.processes.child_process import Condition, HeartbeatSender, Parent, read_plan, tell, tell_failure
from bench.processes.launch_monitor_plan import LaunchMonitorPlan
from bench.shot.recorded_shot import FlightConditions, shot_to_json, warm_up_shots
from bench.shot.shot_matcher import LaunchBook, Told
from bench.shot.shot_message import SHOT_VERSION, launch_to_json, shortened
from bench.shot.swing_watch import SwingWatch
from bench.telemetry.ring import RingReader
from drivers.base import DriverError
from drivers.base.shared_record import SharedMemoryError
from drivers.launch_monitor.client import SimulatorClient
from drivers.launch_monitor.server import LaunchMonitorServer

POLL = 0.01
"""s between two looks."""
_RING = 1 << 16
"""More records than the ring holds."""
_LINK = 1.0
"""s between two words about the connections when nothing changes."""
_LISTEN = 2.0
"""s between two attempts to listen."""


class LaunchMonitorDesk:
    """One run of the process; `turn` is everything it does between two sleeps."""

    def __init__(self, plan: LaunchMonitorPlan) -> None:
        """Open the shared files and begin to connect to the simulator, if there is to be one.

        Raises:
            BenchError, SharedMemoryError: a shared file is unusable.
        """
        settings = plan.settings
        self._stack = ExitStack()
        try:
            self._heart = HeartbeatSender(plan.heartbeat)
            self._stack.callback(self._heart.close)
            self._ring = RingReader(plan.ring)
            self._stack.callback(self._ring.close)
            self._server = LaunchMonitorServer(settings)
            self._stack.callback(self._server.close)
            self._client: SimulatorClient | None = None
            if settings.simulator.enabled:
                self._client = SimulatorClient(settings.simulator, settings.device)
                self._client.open()
                self._stack.callback(self._client.close)
        except BaseException:
            self._stack.close()
            raise
        around = FlightConditions(plan.air, plan.wind, plan.turf)
        self._window = settings.window
        self._watch = SwingWatch(plan.run, wall=plan.wall)
        self._book = LaunchBook(settings.window, settings.plausible, plan.plant, around)
        self._lost = 0
        self._trouble = "not listening yet"
        self._listen_at = self._link_at = -float("inf")
        self._linked: Any = None

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens; DriverError when it does not."""
        return self._server.address

    def turn(self, now: float, utc: datetime) -> None:
        """Listen, look, match and tell, at `now` (s, CLOCK_MONOTONIC) and `utc`."""
        if self._trouble and now >= self._listen_at:
            self._listen(now)
        # All there are: the newest tells how far the loop's clock is behind, and no launch is given up for
        # want of a swing that is in the ring already.
        cycles = self._ring.read(_RING)
        lost, self._lost = self._ring.lost > self._lost, self._ring.lost
        for swing in self._watch.take(cycles, now, lost=lost):
            self._book.note_swing(swing, utc)
        self._book.note_launches(self._server.take())
        for told in self._book.settle(now):
            tell("shot", message=message_of(told))
            self._pass_on(told)
        self._tell_link(now)
        condition = Condition.TROUBLE if self._trouble else Condition.WORKING
        self._heart.beat(now, condition, lost=self._ring.lost, done=sum(self._book.counts.values()))

    def close(self) -> None:
        """End all connections and unmap the shared files."""
        self._stack.close()

    def _listen(self, now: float) -> None:
        try:
            self._server.open()
        except DriverError as error:
            if str(error) != self._trouble:
                tell("trouble", text=str(error))
            self._trouble, self._listen_at = str(error), now + _LISTEN
            return
        if self._listen_at > 0.0:
            tell("relieved")
        self._trouble = ""

    def _pass_on(self, told: Told) -> None:
        """Pass a launch of ours on that nothing speaks against."""
        launch = None if told.launch is None or told.reason else told.launch.launch
        if self._client is not None and launch is not None and told.launch is not None:
            carry = None if told.shot is None else told.shot.carry_m
            self._client.send(launch, told.launch.club, carry)

    def _tell_link(self, now: float) -> None:
        link = self._status()
        essence = (
            [(one["address"], one["device"], one["ready"]) for one in link["monitors"]],
            link["note"],
            link["simulator"],
            link["outcomes"],
        )
        if essence != self._linked or now - self._link_at >= _LINK:
            self._linked, self._link_at = essence, now
            tell("link", link=link)

    def _status(self) -> LaunchMonitorStatus:
        link = self._server.link()
        listening = "" if self._trouble else "{}:{}".format(*self._server.address)
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
                trouble=shortened(p.trouble),
                taken=p.taken,
                refused=p.refused + p.out_of_date,
            )
        note = self._trouble
        if len(monitors) > 1:
            note = note or f"{len(monitors)} monitors are connected: two launches of one swing are doubtful"
        return LaunchMonitorStatus(
            listening=listening,
            present=bool(monitors) and not self._trouble,
            monitors=monitors,
            note=shortened(note),
            outcomes={str(outcome): count for outcome, count in self._book.counts.items()},
            settled_s=self._window.latest,
            refused=link.counts.refused + link.counts.too_large + link.counts.cut_off,
            simulator=simulator,
        )


def message_of(told: Told) -> dict[str, Any]:
    """Return the message of a settled outcome; its record is the supervisor's to add."""
    return {
        "version": SHOT_VERSION,
        "shot_id": told.shot_id or None,
        "record": None,
        "shot": None if told.shot is None else shot_to_json(told.shot),
        "outcome": str(told.outcome),
        "launch": None if told.launch is None else launch_to_json(told.launch),
        "reason": shortened(told.reason),
    }


def main() -> int:
    """Serve until the supervisor ends it or is gone."""
    parent = Parent()
    try:
        plan: LaunchMonitorPlan = read_plan()
        warm_up_shots(plan.plant, FlightConditions(plan.air, plan.wind, plan.turf))
        desk = LaunchMonitorDesk(plan)
    except (BenchError, SharedMemoryError, DriverError) as error:
        return tell_failure(error)
    parent.listen()
    tell("ready")
    try:
        while not (parent.wants_end or parent.gone):
            desk.turn(time.monotonic(), datetime.now(UTC))
            time.sleep(POLL)
    finally:
        desk.close()
    tell("ended")
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
