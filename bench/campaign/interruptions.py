"""Interruptions in a campaign's history: the end of the previous run, and the changes since then."""

from __future__ import annotations

import platform
from collections.abc import Iterator, Mapping
from datetime import datetime, timedelta
from functools import cache
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench.store.rows import CampaignRun, CampaignState, Standing

PACKAGES = ("golfbench", "numpy", "numba", "scipy", "filterpy", "sqlalchemy")


_TOP = Path(__file__).parents[2]


_MAX_CHANGES = 5
"""Max number of changed values in a line."""


@cache
def software_versions() -> dict[str, str]:
    """Return the versions of the recorded packages and of Python, and a digest of golfbench's own files."""
    digest = sha256()
    for folder in ("bench", "drivers", "sim"):
        for path in sorted((_TOP / folder).rglob("*")):
            if path.suffix in {".py", ".toml", ".j2", ".json"}:
                digest.update(str(path.relative_to(_TOP)).encode() + b"\0" + path.read_bytes())
    found = {name: version(name) for name in PACKAGES}
    return {**found, "python": platform.python_version(), "source": digest.hexdigest()[:12]}


def duration_text(seconds: float) -> str:
    """Return a duration in words, of two digits or more."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def found_at_begin(
    standing: Standing, runs: list[CampaignRun], shots: int, seen: datetime | None, start: CampaignRun
) -> Iterator[tuple[str, str]]:
    """Yield (kind, text) of the events at the `start` of a run that follows `runs` and `shots` shots.

    `seen` is the last sign of life of the previous run, None if unknown.
    """
    if not runs and not shots:
        return
    now = start.began
    who = f" by {start.by}" if start.by else ""
    since = "" if seen is None else f", {_gap(now - seen)} after its last sign of life at {_clock(seen, now)}"
    if standing.state in {CampaignState.RUNNING, CampaignState.WAITING}:
        yield "killed", f"the runner had ended without closing the campaign; resumed{who}{since}"
    else:
        reason = f" ({standing.reason})" if standing.reason else ""
        yield "resumed", f"resumed{who}, it was {standing.state}{reason}{since}"
    if not runs:
        return
    before = runs[-1]
    if changes := changed(before.versions, start.versions):
        yield "software", f"software changed since run {before.number}: {named(changes)}"
    if changes := changed(before.facts, start.facts):
        yield "configuration", f"bench changed since run {before.number}: {named(changes)}"


def differences(
    before: Mapping[str, Any], now: Mapping[str, Any], path: str = ""
) -> Iterator[tuple[str, Any, Any]]:
    """Yield key, old and new value of all that differ; keys of tables are joined by dots."""
    for key in sorted(before.keys() | now.keys()):
        one, two = before.get(key), now.get(key)
        if isinstance(one, Mapping) and isinstance(two, Mapping):
            yield from differences(one, two, f"{path}{key}.")
        elif one != two:
            yield f"{path}{key}", one, two


def changed(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return the values that differ, as "key old → new"."""
    return [f"{key} {_value(one)} → {_value(two)}" for key, one, two in differences(before, now)]


def named(changes: list[str]) -> str:
    """Return `changes` in a line, the first ones if there are many."""
    more = f" and {len(changes) - _MAX_CHANGES} more" if len(changes) > _MAX_CHANGES else ""
    return f"{', '.join(changes[:_MAX_CHANGES])}{more}"


def _value(value: object) -> str:
    if isinstance(value, list | Mapping):
        return f"({len(value)} values)"
    return "nothing" if value in (None, "") else str(value)


def _gap(gap: timedelta) -> str:
    seconds = gap.total_seconds()
    return duration_text(seconds) if seconds >= 0 else "at an unknown time (the clock went back)"


def _clock(then: datetime, now: datetime) -> str:
    return f"{then:%H:%M:%S}" if then.date() == now.date() else f"{then:%Y-%m-%d %H:%M:%S}"
