"""Detect the balls that a simulated plant launches, for a simulated launch monitor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.base.shared_record import SharedMemoryError, SharedRecord
from sim.live.exchange import PLANT_REPORT, REPORT_FILE
from sim.truth import Contact, contact_in


def warm_up() -> None:
    """Compile the launch computation, so that the first ball is not delayed."""
    at_rest = (0.0, 0.0, 0.0)
    _ = Contact(0.0, at_rest, at_rest, (60.0, 10.0, 0.0), (0.0, 0.0, -300.0)).launch


class ContactMonitor:
    """Reads the report of the plant in a folder; the plant may stop and restart."""

    def __init__(self, folder: Path) -> None:
        """Watch the plant in `folder`; neither need exist yet."""
        self._path = folder / REPORT_FILE
        self._report = np.zeros(1, PLANT_REPORT)
        self._shared: SharedRecord | None = None
        self._inode = 0
        self._contacts = 0

    @property
    def attached(self) -> bool:
        """Whether a plant existed at the last call of `attach`."""
        return self._shared is not None

    def attach(self) -> None:
        """Attach to the plant if it exists or was replaced; call it occasionally.

        Raises:
            SharedMemoryError: the plant runs another version of the code.
        """
        try:
            inode = self._path.stat().st_ino
        except OSError:
            self.close()
            return
        if inode != self._inode:
            self.close()
            try:
                self._shared = SharedRecord.open(self._path, PLANT_REPORT)
            except SharedMemoryError:
                if self._path.exists():
                    raise
                return  # it was removed just now
            self._inode = inode
            self._contacts = int(self._report["contacts"][0]) if self._shared.read(self._report) else 0

    def look(self) -> Contact | None:
        """Return the newest contact, None if already returned."""
        if self._shared is None or not self._shared.read(self._report):
            return None
        contacts = int(self._report["contacts"][0])
        if contacts == self._contacts:
            return None
        self._contacts = contacts
        return contact_in(self._report["contact"])

    def close(self) -> None:
        """Unmap the plant's file. May be called twice."""
        if self._shared is not None:
            self._shared.close()
        self._shared, self._inode = None, 0
