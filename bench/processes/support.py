"""Support processes (recorder, publisher and others): started, monitored by heartbeat and restarted.

Arming requires recorder and publisher.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.processes.child import Child
from bench.processes.child_process import HEARTBEAT, Condition
from drivers.base.shared_record import SharedRecord

_log = logging.getLogger("golfbench")

_SILENCE = 5.0
"""Heartbeat time-out after which a process is not ready, s; storing a swing may take some seconds on a busy
machine, and the ring keeps 16 s."""
_FROZEN = 12.0
"""Heartbeat time-out after which a process is killed and restarted, s."""
_PAUSE = 1.0
"""Delay before a restart, s."""
_PATIENCE = 12.0
"""Time a process may take to end and store its data, s."""


class LastHeartbeat(NamedTuple):
    """Last heartbeat of a process and its time (s, supervisor clock)."""

    condition: Condition
    beats: int
    time: float


class ManagedProcess:
    """One support process."""

    def __init__(
        self,
        name: str,
        heartbeat: Path,
        start: Callable[[], Child],
        listener: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        """Create the `heartbeat` file; `start` starts the process; `listener` gets its other events.

        Raises:
            SharedMemoryError: the file cannot be created.
        """
        self.name, self._start, self._listener = name, start, listener
        self._shared = SharedRecord.create(heartbeat, HEARTBEAT)
        self._beat = np.zeros(1, HEARTBEAT)
        self._heartbeat = LastHeartbeat(Condition.STARTING, -1, -np.inf)
        self.child: Child | None = None
        self._died = -np.inf
        self._ending = False
        self.note = "starting"
        """Condition as text; empty while working."""

    @property
    def ready(self) -> bool:
        """Whether it is working."""
        return not self.note

    @property
    def starting(self) -> bool:
        """Whether it has not worked yet; the first time it compiles."""
        return self._heartbeat.condition is Condition.STARTING

    def turn(self, now: float) -> None:
        """Check it at `now` (s); start it if it does not run."""
        if self.child is not None and not self.child.alive:
            _log.error("%s %s; restarting", self.name, self.child.ending)
            self.child.kill()
            self.child, self._died = None, now
        if self._ending:
            return
        if self.child is None:
            self.note = "dead, restarting"
            if now - self._died < _PAUSE:
                return
            self.child, self._heartbeat = self._start(), LastHeartbeat(Condition.STARTING, -1, now)
        self._shared.read(self._beat)
        count, condition = int(self._beat["count"][0]), Condition(int(self._beat["condition"][0]))
        if self._heartbeat.beats == -1:
            # the first value is from the previous process
            self._heartbeat = LastHeartbeat(Condition.STARTING, count, now)
        elif count != self._heartbeat.beats:
            self._heartbeat = LastHeartbeat(condition, count, now)
        self.note = self._trouble(now)
        if self._heartbeat.condition is not Condition.STARTING and now - self._heartbeat.time > _FROZEN:
            self.child.kill()  # restarted in the next turns
        for event in self.child.take_events():
            if event["event"] in {"trouble", "dropped", "failed", "relieved"}:
                _log.warning("%s: %s", self.name, event)
            else:
                self._listener(event)

    def _trouble(self, now: float) -> str:
        condition, silent = self._heartbeat.condition, now - self._heartbeat.time
        if self.starting:
            return "starting"
        if silent > _SILENCE:
            return f"silent for {silent:.1f} s"
        return "" if condition is Condition.WORKING else condition.name.lower()

    def stop_restarting(self) -> None:
        """Do not restart it from now on: the bench is shutting down."""
        self._ending = True

    def end(self) -> None:
        """Stop it after it has stored its data. May be called twice."""
        self.stop_restarting()
        if self.child is not None:
            self.child.end(_PATIENCE)
            self.child = None
        self._shared.close()
