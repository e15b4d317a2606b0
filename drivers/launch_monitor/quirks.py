"""Known monitors whose fields hold something else than their names say, read from `quirks.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

_FILE = Path(__file__).with_name("quirks.toml")


class MonitorQuirk(NamedTuple):
    """One family of connectors."""

    name: str
    devices: tuple[str, ...]
    """Device names as they send them."""
    ignore: frozenset[str]
    """Fields without a measurement, in lower case."""
    reason: str
    source: str
    """Repository, commit and file."""


@cache
def quirks() -> Mapping[str, MonitorQuirk]:
    """Return the quirks by device name in lower case."""
    found: dict[str, MonitorQuirk] = {}
    for name, entry in tomllib.loads(_FILE.read_text(encoding="utf-8-sig")).items():
        ignore = frozenset(field.lower() for field in entry["ignore"])
        quirk = MonitorQuirk(name, tuple(entry["names"]), ignore, entry["reason"], entry["source"])
        found |= {device.lower(): quirk for device in quirk.devices}
    return found


def quirk_of(device: str) -> MonitorQuirk | None:
    """Return the quirk of the monitor that calls itself `device`; None if it has none."""
    return quirks().get(device.strip().lower())
