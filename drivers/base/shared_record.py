"""One record in shared memory: one process writes, any others read its newest value, never a torn one.

Four slots (`drivers.base.mapped_slots`) take the values in turn. A slot is not reused for three writes: a
reader has that long to copy it. An interrupted write leaves the previous value readable.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np

from drivers.base.mapped_slots import MappedSlots, SharedMemoryError

__all__ = ["SharedMemoryError", "SharedRecord"]

_SLOTS = 4
_KIND = "record"
_ATTEMPTS = 16
"""Copies a reader tries before it stays with its previous value."""


class SharedRecord:
    """A structured record in a mapped file."""

    def __init__(self, slots: MappedSlots) -> None:
        """Use `slots`; see `create` and `open`."""
        self._slots = slots
        self._version = 0
        self._value = b""

    @classmethod
    def create(cls, path: Path, dtype: np.dtype[Any]) -> Self:
        """Make the file at `path`, not yet written to; the writer may, or a reader.

        Raises:
            SharedMemoryError: `path` exists, or its folder is missing, read-only or full.
        """
        return cls(MappedSlots.create(path, _KIND, dtype, _SLOTS))

    @classmethod
    def open(cls, path: Path, dtype: np.dtype[Any]) -> Self:
        """Map the file at `path`, to write or to read it.

        Raises:
            SharedMemoryError: no such file, or no shared record, or damaged, or of other code: another
                layout or another `dtype`.
        """
        return cls(MappedSlots.open(path, _KIND, dtype, writable=True))

    def write(self, record: np.ndarray[Any, Any]) -> None:
        """Make `record` (a one-element array of the dtype) the newest value; a few us, never waits.

        A writer that follows a dead one counts on from its last version.

        Raises:
            ValueError: `record` has not the size of the dtype.
        """
        self._slots.put(record.tobytes())

    @property
    def words(self) -> memoryview[Any]:
        """The file as words, see `drivers.base.mapped_slots`; only until it is closed."""
        return self._slots.words

    @property
    def newest(self) -> int:
        """Version of the newest value, 0 before the first write; a cheap test for a new value."""
        return self._slots.head

    @property
    def block(self) -> np.ndarray[Any, Any]:
        """Words for compiled code, see `drivers.base.compiled_slots`."""
        return self._slots.block

    def read(self, into: np.ndarray[Any, Any]) -> int:
        """Copy the newest whole value into `into` (a one-element array of the dtype); return its version.

        Versions count the writes. At version 0, nothing written yet, `into` stays as it is. If the writer
        overtakes each of a few attempts to copy, `into` gets the value of the last reading, and its version
        is returned again. Never waits.
        """
        slots = self._slots
        for _ in range(_ATTEMPTS):
            newest = slots.head
            if newest == self._version:
                break
            value = slots.fetch(newest)
            if value is not None:
                self._version, self._value = newest, value
                break
        if self._version:
            into.view(np.uint8)[:] = np.frombuffer(self._value, np.uint8)
        return self._version

    def close(self) -> None:
        """Unmap; the file stays. Allowed twice."""
        self._slots.close()
