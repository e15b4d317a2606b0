"""Counters of the driver: every received frame in exactly one class, and errors."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class BusCounters:
    """Counts since the driver was created; closing and opening do not reset them."""

    frames: int = 0
    """Received frames."""
    positions: int = 0
    """Samples received in time."""
    late: int = 0
    """Samples received after their tick had stopped waiting."""
    duplicates: int = 0
    """Repeated samples of one SYNC."""
    inputs: int = 0
    pressures: int = 0
    heartbeats: int = 0
    boot_ups: int = 0
    emergencies: int = 0
    services: int = 0
    """SDO responses."""
    wrong_length: int = 0
    """Frames with a known identifier and the wrong length."""
    error_frames: int = 0
    foreign: int = 0
    """Frames with an identifier that the bench does not use."""

    syncs: int = 0
    missing: int = 0
    """Samples not received before the next SYNC."""
    floods: int = 0
    """Ticks in which more frames were queued than could be processed."""
    overruns: int = 0
    """Error frames that report frames lost in the controller."""
    error_passive: int = 0
    bus_off: int = 0
    no_room: int = 0
    """Frames not sent because the queue was full (ENOBUFS)."""
    send_failures: int = 0
    """Frames not sent because the interface was down, or for another reason."""
    receive_failures: int = 0
    recoveries: int = 0
    """Times that reopening cleared a fault."""

    def counts(self) -> dict[str, int]:
        """Return all counters by name."""
        return {name: getattr(self, name) for name in self.__slots__}
