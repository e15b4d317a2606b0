"""A swing of a running bench, as whoever asked for it sees it over the network."""

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
"""s between two looks at the bench."""
FEED = 2.0
"""s that a ball may take to the tee."""
STORED = 30.0
"""s that a swing's record may take."""


class SwingRecord(NamedTuple):
    """What the bench stored of a swing."""

    path: Path
    cycles: np.ndarray[Any, Any]
    metadata: dict[str, Any]


class ShotNews:
    """What the bench tells of shots, as it comes; what became of swings is kept until it is forgotten."""

    def __init__(self, next_message: Callable[[], ShotMessage | None]) -> None:
        """`next_message` is `BenchClient.shots`'."""
        self._next_message = next_message
        self._outcomes: dict[str, ShotMessage] = {}
        """By their shots' ids."""

    def forget(self) -> None:
        """Forget what became of swings so far."""
        self._outcomes.clear()

    def record_since(self, tick: int) -> SwingRecord | None:
        """Return the record of the swing begun after `tick`; None when it does not come."""
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

    def told_of(self, record: SwingRecord, status: BenchStatus) -> ShotMessage | None:
        """Return what the launch monitor's side says of the swing of `record`; None when it says nothing."""
        shot, link = record.metadata.get("shot_id"), status["launch_monitor"]
        deadline = time.monotonic() + STORED + (0.0 if link is None else link["settled_s"])
        while shot not in self._outcomes and time.monotonic() < deadline:
            self._hear()
        return self._outcomes.get(shot or "")

    def _hear(self) -> ShotMessage | None:
        """Return the next message about a shot, None for none yet."""
        message = self._next_message()
        if message is None:
            time.sleep(LOOK)
        elif message.shot_id and message.outcome in (MatchOutcome.MATCHED, MatchOutcome.NO_LAUNCH):
            self._outcomes[message.shot_id] = message
        return message


def tee_up(client: BenchClient, pause: Callable[[], None]) -> bool:
    """Raise the next ball; tell whether one came. `pause` is called between two looks."""
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
