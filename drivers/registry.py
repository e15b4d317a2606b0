"""Find the installed drivers by entry point `golfbench.drivers`.

A plug-in that fails to load is listed with the reason and does not affect the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import cast

from drivers.base import Driver, DriverError

GROUP = "golfbench.drivers"
_METHODS = ("open", "read", "write", "make_passive", "close")

DriverFactory = Callable[..., Driver]
"""Makes a closed driver; its keyword arguments are the driver's own settings."""


@dataclass(frozen=True)
class BrokenDriver:
    """An installed driver that cannot be used."""

    name: str
    origin: str
    """Target of the entry point and the distribution that installed it."""
    reason: str
    """Why it cannot be used."""


def find_drivers(entries: Iterable[EntryPoint] | None = None) -> dict[str, DriverFactory | BrokenDriver]:
    """Return every installed driver by name, sorted by name; `entries` replaces the installed ones."""
    found: dict[str, DriverFactory | BrokenDriver] = {}
    origins: dict[str, str] = {}
    for entry in sorted(entry_points(group=GROUP) if entries is None else entries, key=lambda e: e.name):
        origin = f"{entry.value} ({entry.dist.name if entry.dist else 'no distribution'})"
        if entry.name not in found:
            found[entry.name] = _load(entry, origin)
            origins[entry.name] = origin
        elif origin != origins[entry.name]:
            reason = f"two plug-ins have this name: {origins[entry.name]} and {origin}; uninstall one"
            found[entry.name] = BrokenDriver(entry.name, origin, reason)
    return found


def choose_driver(name: str, drivers: Mapping[str, DriverFactory | BrokenDriver]) -> DriverFactory:
    """Return the factory of driver `name`.

    Raises:
        DriverError: it is not installed or broken; the message names the cause and the action.
    """
    driver = drivers.get(name)
    if driver is None:
        known = ", ".join(n for n, d in drivers.items() if not isinstance(d, BrokenDriver)) or "none"
        raise DriverError(f"driver {name!r} is not installed; working drivers: {known}")
    if isinstance(driver, BrokenDriver):
        raise DriverError(f"driver {name!r} from {driver.origin} is broken: {driver.reason}")
    return driver


def _load(entry: EntryPoint, origin: str) -> DriverFactory | BrokenDriver:
    """Return the target of `entry`, or why it is not a driver."""
    try:
        loaded = entry.load()
    except Exception as error:  # a plug-in may fail in any way
        return BrokenDriver(entry.name, origin, f"{type(error).__name__}: {error}")
    if not callable(loaded):
        reason = f"found {type(loaded).__name__}, expected a class or function that makes a driver"
        return BrokenDriver(entry.name, origin, reason)
    missing = [method for method in _METHODS if not hasattr(loaded, method)]
    if isinstance(loaded, type) and missing:
        return BrokenDriver(entry.name, origin, f"class without {', '.join(missing)}()")
    return cast(DriverFactory, loaded)
