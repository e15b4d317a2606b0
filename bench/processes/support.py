"""Recorder, publisher and their like: started, watched by their hearts, started anew.

Without recorder and publisher nothing is armed.
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
"""s without a heartbeat after which a process cannot be relied on; storing a swing may take some on a busy
machine, and the ring keeps 16."""
_FROZEN = 12.0
"""s without a heartbeat after which it is killed, and started anew."""
_PAUSE = 1.0
"""s after which a dead one is started anew."""
_PATIENCE = 12.0
"""s that one may take to store what it has."""


class LastHeartbeat(NamedTuple):
    """What a process told last, and when (s, the supervisor's clock) something new was heard."""

    condition: Condition
    beats: int
    heard: float


class ManagedProcess:
    """One process of the support."""

    def __init__(
        self,
        name: str,
        heart: Path,
        start: Callable[[], Child],
        listener: Callable[[dict[str, Any]], None] = lambda _: None,
    ) -> None:
        """Make the file of its `heart`; `start` starts the process; `listener` hears what else it tells.

        Raises:
            SharedMemoryError: the file cannot be made.
        """
        self.name, self._start, self._listener = name, start, listener
        self._shared = SharedRecord.create(heart, HEARTBEAT)
        self._beat = np.zeros(1, HEARTBEAT)
        self._heart = LastHeartbeat(Condition.STARTING, -1, -np.inf)
        self.child: Child | None = None
        self._died = -np.inf
        self._ending = False
        self.note = "starting"
        """Its condition in words; empty when it works."""

    @property
    def ready(self) -> bool:
        """Whether it can be relied on."""
        return not self.note

    def turn(self, now: float) -> None:
        """Look at it at `now` (s); start it when it does not run."""
        if self.child is not None and not self.child.alive:
            _log.error("%s %s; it is started anew", self.name, self.child.ending)
            self.child.kill()
            self.child, self._died = None, now
        if self._ending:
            return
        if self.child is None:
            self.note = "dead, it is started anew"
            if now - self._died < _PAUSE:
                return
            self.child, self._heart = self._start(), LastHeartbeat(Condition.STARTING, -1, now)
        self._shared.read(self._beat)
        count, condition = int(self._beat["count"][0]), Condition(int(self._beat["condition"][0]))
        if self._heart.beats == -1:
            self._heart = LastHeartbeat(
                Condition.STARTING, count, now
            )  # what stands there is of the one before
        elif count != self._heart.beats:
            self._heart = LastHeartbeat(condition, count, now)
        self.note = self._trouble(now)
        if self._heart.condition is not Condition.STARTING and now - self._heart.heard > _FROZEN:
            self.child.kill()  # seen as dead in the next turn
        for event in self.child.take_events():
            if event["event"] in {"trouble", "dropped", "failed", "relieved"}:
                _log.warning("%s: %s", self.name, event)
            else:
                self._listener(event)

    def _trouble(self, now: float) -> str:
        if self._heart.condition is Condition.STARTING:
            return "starting"
        if now - self._heart.heard > _SILENCE:
            return f"silent for {now - self._heart.heard:.1f} s"
        return "" if self._heart.condition is Condition.WORKING else self._heart.condition.name.lower()

    def leave_dead(self) -> None:
        """From now on start it no more: the bench is ending."""
        self._ending = True

    def end(self) -> None:
        """Let it finish what it has, then end it. Allowed twice."""
        self.leave_dead()
        if self.child is not None:
            self.child.end(_PATIENCE)
            self.child = None
        self._shared.close()
