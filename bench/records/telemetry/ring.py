"""The ring of cycle records between the loop and the processes that read it.

One writer, any readers, records numbered from 1 on (`drivers.base.shared_memory`). The writer never waits: a
reader too slow loses the oldest records, counts them, and continues with the oldest still there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.base.errors import BenchError, ExitCode
from bench.records.telemetry.cycle_record import CYCLE
from drivers.base.shared_memory import MappedSlots, SharedMemoryError, SharedRecord

if TYPE_CHECKING:
    from drivers.base.native import NativeCall

CAPACITY = 16384
"""Min number of records."""
_SECONDS = 16.0
"""Time that the ring holds, s: a reader that stores a swing on a busy machine takes some."""

_KIND = "ring"


def ring_capacity(rate: float) -> int:
    """Return the number of records of the ring of a loop at `rate` (Hz): a power of two, 16 s or more."""
    return max(CAPACITY, 1 << (round(_SECONDS * rate) - 1).bit_length())


class NoRing(BenchError):
    """The ring cannot be created, or no ring exists that this program can read."""

    exit_code = ExitCode.DEVICE


class RingWriter:
    """Writer, the loop's side: publishes the cycle it is called with."""

    def __init__(self, path: Path, capacity: int = CAPACITY) -> None:
        """Make the ring at `path` for `capacity` (a power of two) records, all of its memory reserved.

        Raises:
            NoRing: `path` exists, or its folder is missing, read-only or full.
            ValueError: `capacity` is not a power of two.
        """
        with _refusing():
            self._slots = MappedSlots.create(path, _KIND, CYCLE, capacity)

    @property
    def head(self) -> int:
        """Records written so far."""
        return self._slots.head

    def __call__(self, record: np.ndarray[Any, Any]) -> None:
        """Publish `record` (a one-element array of CYCLE); a few us, never waits.

        Raises:
            ValueError: `record` has not the size of a CYCLE.
        """
        self._slots.put(record.tobytes())

    def native_call(self) -> NativeCall:
        """Return the native function that copies the CYCLE at an address straight into the ring."""
        from drivers.base.compiled_slots import put_native  # here, as readers need no compiler
        from drivers.base.native import NativeCall

        return NativeCall(put_native.address, self._slots.block.ctypes.data)

    def close(self) -> None:
        """Unmap; the file stays. Allowed twice."""
        self._slots.close()


class RingReader:
    """One reader; each has a separate position in the ring, and its mapping cannot write."""

    def __init__(self, path: Path, *, from_oldest: bool = False, past: int = 0) -> None:
        """Open the ring at `path` and start with the newest record, or with the oldest still there.

        With `past` it starts that many records before the newest, as far as they are still there.

        Raises:
            NoRing: the file is missing, damaged, not a ring, or written by other code.
        """
        with _refusing():
            self._slots = MappedSlots.open(path, _KIND, CYCLE, writable=False)
        self.lost = 0
        """Records that were overwritten before this reader read them."""
        past = self.capacity - 1 if from_oldest else min(past, self.capacity - 1)
        self._next = max(1, self.head - past)
        self._newest = SharedRecord(self._slots)

    @property
    def capacity(self) -> int:
        """Capacity of the ring in records."""
        return self._slots.slots

    @property
    def head(self) -> int:
        """Records written so far; grows while the loop lives."""
        return self._slots.head

    def read(self, limit: int = 4096) -> np.ndarray[Any, Any]:
        """Return up to `limit` new records (n,) of CYCLE in their order, possibly none; never waits."""
        slots = self._slots
        found: list[bytes] = []
        for _ in range(limit):  # a bound on all steps, also over lost records: a faster writer cannot block
            if self._next > slots.head:
                break
            data = slots.fetch(self._next)
            if data is not None:
                found.append(data)
                self._next += 1
                continue
            oldest = slots.head - self.capacity + 1
            if oldest < self._next:
                break  # announced, but not all of it is visible yet (ARM): next time
            # Overwritten; the oldest itself when the writer is just there.
            follower = max(oldest, self._next + 1)
            self.lost += follower - self._next
            self._next = follower
        return np.frombuffer(bytearray().join(found), CYCLE)

    def newest(self) -> np.ndarray[Any, Any] | None:
        """Return the newest record as a one-element array of CYCLE; None before the first. Never waits."""
        record = np.zeros(1, CYCLE)
        return record if self._newest.read(record) else None

    def close(self) -> None:
        """Unmap; the file stays. Allowed twice."""
        self._slots.close()


@contextmanager
def _refusing() -> Iterator[None]:
    """Raise errors of the mapped file as NoRing."""
    try:
        yield
    except SharedMemoryError as error:
        raise NoRing(*error.args) from error
