"""Which balls a simulated plant launches: for whoever plays the launch monitor beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.base.shared_record import SharedMemoryError, SharedRecord
from sim.live.exchange import PLANT_REPORT, REPORT_FILE
from sim.truth import Contact, contact_in


def warm_up() -> None:
    """Compile what a contact's launch needs: the first ball must not wait for it."""
    at_rest = (0.0, 0.0, 0.0)
    _ = Contact(0.0, at_rest, at_rest, (60.0, 10.0, 0.0), (0.0, 0.0, -300.0)).launch


class ContactWatch:
    """Looks at the report of the plant in a folder; plants may come and go."""

    def __init__(self, folder: Path) -> None:
        """`folder` is the plant's; neither need be there yet."""
        self._path = folder / REPORT_FILE
        self._report = np.zeros(1, PLANT_REPORT)
        self._shared: SharedRecord | None = None
        self._inode = 0
        self._contacts = 0

    @property
    def attached(self) -> bool:
        """There was a plant when `look` was called last."""
        return self._shared is not None

    def attach(self) -> None:
        """See whether the plant is there, or another one than before; now and then is enough.

        Raises:
            SharedMemoryError: there is one, of other code.
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
                return  # it went just now
            self._inode = inode
            self._contacts = int(self._report["contacts"][0]) if self._shared.read(self._report) else 0

    def look(self) -> Contact | None:
        """Return how the newest ball was struck, None when that was known already."""
        if self._shared is None or not self._shared.read(self._report):
            return None
        contacts = int(self._report["contacts"][0])
        if contacts == self._contacts:
            return None
        self._contacts = contacts
        return contact_in(self._report["contact"])

    def close(self) -> None:
        """Let go of the plant's file. Allowed twice."""
        if self._shared is not None:
            self._shared.close()
        self._shared, self._inode = None, 0
