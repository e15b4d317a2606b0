"""The one id of a shot: the swing, its record and the launch of a monitor carry it."""

from __future__ import annotations

from datetime import UTC, datetime


def run_id(start: datetime) -> str:
    """Return the id of a bench's run from `start` on; ticks count from there."""
    return f"{start.astimezone(UTC):%Y%m%dT%H%M%SZ}"


def shot_id(run: str, tick: int) -> str:
    """Return the id of the shot whose swing began at `tick` of `run`."""
    return f"{run}-{tick}"
