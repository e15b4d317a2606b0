"""What the driver counts: every frame it took from the bus in exactly one class, and what went wrong."""

from __future__ import annotations

from dataclasses import dataclass

CLASSES = (
    "positions",
    "late",
    "duplicates",
    "inputs",
    "pressures",
    "heartbeats",
    "boot_ups",
    "emergencies",
    "services",
    "wrong_length",
    "error_frames",
    "foreign",
)
"""The counters that sum up to `frames`."""


@dataclass(slots=True)
class BusCounters:
    """Since the driver was made; they outlive closing and opening."""

    frames: int = 0
    """Taken from the bus."""
    positions: int = 0
    """Samples in time."""
    late: int = 0
    """Samples that came after their tick had stopped waiting."""
    duplicates: int = 0
    """Samples of a SYNC that was answered already."""
    inputs: int = 0
    pressures: int = 0
    heartbeats: int = 0
    boot_ups: int = 0
    emergencies: int = 0
    services: int = 0
    """Answers to questions (SDO)."""
    wrong_length: int = 0
    """Frames that are known by their identifier, but not of their length."""
    error_frames: int = 0
    foreign: int = 0
    """Frames that are no business of the bench."""

    syncs: int = 0
    missing: int = 0
    """Samples that had not come when the next SYNC went out."""
    floods: int = 0
    """Ticks in which more frames waited than could be taken."""
    overruns: int = 0
    """Error frames that tell of frames lost in the controller."""
    error_passive: int = 0
    bus_off: int = 0
    no_room: int = 0
    """Frames that could not be sent because the queue was full (ENOBUFS)."""
    send_failures: int = 0
    """Frames that could not be sent because the interface was away, or otherwise."""
    receive_failures: int = 0
    recoveries: int = 0
    """Times that opening ended trouble."""

    def counts(self) -> dict[str, int]:
        """Return all by name."""
        return {name: getattr(self, name) for name in self.__slots__}
