"""A swing of a running bench, as a client sees it over the network."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.network.bench_service import BenchStatus
from bench.network.client import BenchClient
from bench.shot.shot_message import ShotMessage
from bench.telemetry.recorder import read_swing
from drivers.launch_monitor.matching import MatchOutcome

LOOK = 0.05
"""Polling interval of the bench, s."""
FEED = 2.0
"""Max time of a ball to the tee, s."""
STORED = 30.0
"""Max time until a swing's record is stored, s."""


class SwingRecord(NamedTuple):
    """A swing's record, as the bench stored it."""

    path: Path
    cycles: np.ndarray[Any, Any]
    metadata: dict[str, Any]


class ShotNews:
    """Messages about shots as they arrive; outcomes of swings are kept until forgotten."""

    def __init__(self, next_message: Callable[[], ShotMessage | None]) -> None:
        """`next_message` is the function from `BenchClient.shots`."""
        self._next_message = next_message
        self._outcomes: dict[str, ShotMessage] = {}
        """Keyed by shot ID."""

    def forget(self) -> None:
        """Forget the outcomes so far."""
        self._outcomes.clear()

    def record_since(self, tick: int) -> SwingRecord | None:
        """Return the record of the swing begun after `tick`; None after a time-out."""
        deadline = time.monotonic() + STORED
        while time.monotonic() < deadline:
            message = self._hear()
            if message is None or message.record is None or message.outcome is not None:
                continue
            cycles, metadata = read_swing(message.record)
            states = metadata.get("outcome", {}).get("states", [])
            if any(name == "SWINGING" and at >= tick for at, name in states):
                return SwingRecord(message.record, cycles, metadata)
        return None

    def message_about(self, record: SwingRecord, status: BenchStatus) -> ShotMessage | None:
        """Return the launch monitor's message about the swing of `record`; None after a time-out."""
        shot, link = record.metadata.get("shot_id"), status["launch_monitor"]
        deadline = time.monotonic() + STORED + (0.0 if link is None else link["settled_s"])
        while shot not in self._outcomes and time.monotonic() < deadline:
            self._hear()
        return self._outcomes.get(shot or "")

    def _hear(self) -> ShotMessage | None:
        """Return the next message about a shot, None if there is none yet."""
        message = self._next_message()
        if message is None:
            time.sleep(LOOK)
        elif message.shot_id and message.outcome in (MatchOutcome.MATCHED, MatchOutcome.NO_LAUNCH):
            self._outcomes[message.shot_id] = message
        return message


def tee_up(client: BenchClient, pause: Callable[[], None]) -> bool:
    """Raise the next ball; return whether one came. `pause` is called between two polls."""
    client.tee()
    deadline = time.monotonic() + FEED
    while not client.status()["ball_present"]:
        if time.monotonic() > deadline:
            return False
        pause()
    return True


def in_words(status: BenchStatus) -> str:
    """Return the state of the bench with its cause."""
    cause = status["cause"]
    return status["state"] if cause is None else f"{status['state']}, {cause['text']}"
