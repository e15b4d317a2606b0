"""A mapped file of numbered records: one process writes, any others read, no locks, no torn records.

A record with sequence number s (from 1 on) stands in slot s modulo the number of slots, laid out as

    begin | checksum | record, padded to 8 bytes | end        (words of 8 bytes; begin and end hold s)

and the header's head word holds the newest s. The writer stores begin, record, checksum, end, head, in this
order; a reader looks at end, copies, looks at begin. Where stores and loads of a processor keep their order
(x86), equal numbers alone prove a complete copy: no later write had started. Where they do not (ARM), the
checksum, a CRC-32 over record and number, stands in for the missing fences: a mixture passes it once in
four thousand million times, and only when it also slips through the numbers. A writer that dies or is
stopped in the middle of a write spoils the oldest slot alone, which the newest record does not use.

Files live in a folder of memory (/dev/shm, /run). multiprocessing.shared_memory will not do: an unrelated
reader's exit unlinks it.
"""

from __future__ import annotations

import mmap
import os
import secrets
import stat
import struct
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any, Self
from zlib import crc32

import numpy as np

_MAGIC = b"golfslot"
_VERSION = 1
_HEADER = struct.Struct("=8sI12sQQ16s")
"""Magic, layout version, kind of file, slots, bytes of a record, digest of the record's type."""

_SHARED = getattr(mmap, "MAP_SHARED", 0) | getattr(mmap, "MAP_POPULATE", 0)
"""Flags that map all pages at once, so that no tick has a page fault; only Linux uses them."""

HEAD, HEAD_WORD = 64, 8
"""Byte of the head word: on a separate cache line, as are the slots."""
FIRST = 128
"""Byte of slot 0."""
_LINE = 64
_BEGIN, _CHECK, _RECORD = 0, 1, 2
"""Words of a slot."""

ADDRESS, MASK, STRIDE, SIZE, WRITTEN, READ = range(6)
"""Words of `MappedSlots.block`: address of the file in memory (0 once it is closed), number of slots minus
one, bytes from slot to slot, bytes of a record, number of the last record put from here, and number of the
last one that compiled code has read here (0 before the first)."""


class SharedMemoryError(RuntimeError):
    """A shared file cannot be created or used: location, finding, expectation, action."""

    def __init__(self, location: str, found: str, expected: str, action: str) -> None:
        super().__init__(location, found, expected, action)

    def __str__(self) -> str:
        location, found, expected, action = self.args
        return f"{location}: found {found}, expected {expected}. {action}"


class MappedSlots:
    """The slots of one file. Only one of the processes that map it may `put`.

    `block` is what compiled code needs to do the same (`drivers.base.compiled_slots`).
    """

    def __init__(self, memory: mmap.mmap, slots: int, size: int) -> None:
        """Take over `memory`, a checked file with `slots` slots for records of `size` bytes."""
        self.slots = slots
        self.size = size
        self._memory = memory
        self._words = memoryview(memory).cast("Q")
        self._mask = slots - 1
        self._stride = _stride(size)
        self._end = (_RECORD * 8 + size + 7) // 8
        self.block = np.zeros(6, np.int64)
        self.block[:WRITTEN] = _address(memory), slots - 1, self._stride, size
        self._block = self.block.data

    @classmethod
    def create(cls, path: Path, kind: str, dtype: np.dtype[Any], slots: int) -> Self:
        """Make the file, all of its memory reserved, for `slots` (a power of two) records of `dtype`.

        It appears at `path` whole or not at all, readable by its owner only.

        Raises:
            ValueError: `slots` is not a power of two, or below 2.
            SharedMemoryError: `path` exists, or its folder is missing, read-only or full.
        """
        if slots < 2 or slots & (slots - 1):
            raise ValueError(f"{slots} slots, expected a power of two from 2 on")
        size = FIRST + slots * _stride(dtype.itemsize)
        partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
        try:
            descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            try:
                os.posix_fallocate(descriptor, 0, size)  # a full folder shows here, not as SIGBUS in a tick
                os.pwrite(descriptor, _header(kind, dtype, slots), 0)
                os.link(partial, path)
                return cls(mmap.mmap(descriptor, size, _SHARED), slots, dtype.itemsize)
            finally:
                os.close(descriptor)
                with suppress(OSError):
                    partial.unlink()
        except FileExistsError as error:
            raise SharedMemoryError(
                str(path),
                "a file of that name",
                "none",
                "Another process may use it; remove it when none does.",
            ) from error
        except OSError as error:
            raise SharedMemoryError(
                str(path),
                error.strerror or str(error),
                f"a folder in memory that can be written, with {size} bytes left",
                "Make the folder, or free some of its memory.",
            ) from error

    @classmethod
    def open(cls, path: Path, kind: str, dtype: np.dtype[Any], *, writable: bool) -> Self:
        """Map the file at `path` after checking that it is of this `kind` and holds records of `dtype`.

        Raises:
            SharedMemoryError: no such file, or one of another program or version, or a damaged one.
        """
        access = os.O_RDWR if writable else os.O_RDONLY
        try:
            descriptor = os.open(path, access | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
        except FileNotFoundError as error:
            raise SharedMemoryError(
                str(path), "no such file", f"a shared {kind}", "Start the bench that makes it."
            ) from error
        except OSError as error:
            raise SharedMemoryError(
                str(path),
                error.strerror or str(error),
                f"a shared {kind} that this user may open",
                "Run as the user of the bench.",
            ) from error
        try:
            slots = _checked(path, descriptor, kind, dtype)
            size = FIRST + slots * _stride(dtype.itemsize)
            protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
            return cls(mmap.mmap(descriptor, size, _SHARED, protection), slots, dtype.itemsize)
        finally:
            os.close(descriptor)  # the map keeps a duplicate

    @property
    def words(self) -> memoryview[Any]:
        """Content of the file as 64-bit words; valid until the file is closed."""
        return self._words

    @property
    def head(self) -> int:
        """Number of the newest record; 0 before the first."""
        return self._words[HEAD_WORD]

    def put(self, data: bytes) -> None:
        """Write the next record, in place of the oldest; a few us, never waits.

        Raises:
            ValueError: `data` has not the size of a record.
        """
        if len(data) != self.size:
            raise ValueError(f"a record of {len(data)} bytes, expected {self.size}")
        words = self._words
        sequence = (self._block[WRITTEN] or self._last_written()) + 1
        start = FIRST + (sequence & self._mask) * self._stride
        word = start >> 3
        words[word] = sequence
        start += _RECORD * 8
        self._memory[start : start + self.size] = data
        words[word + _CHECK] = crc32(data, sequence & 0xFFFFFFFF)
        words[word + self._end] = sequence
        words[HEAD_WORD] = sequence
        self._block[WRITTEN] = sequence

    def fetch(self, sequence: int) -> bytes | None:
        """Return record number `sequence`; None when it is gone, being overwritten or not there yet."""
        words = self._words
        start = FIRST + (sequence & self._mask) * self._stride
        word = start >> 3
        if words[word + self._end] != sequence:
            return None
        start += _RECORD * 8
        data = self._memory[start : start + self.size]
        check = words[word + _CHECK]
        if words[word + _BEGIN] != sequence or check != crc32(data, sequence & 0xFFFFFFFF):
            return None
        return data

    def close(self) -> None:
        """Unmap; the file stays. Allowed twice."""
        self._block[ADDRESS] = 0
        self._words.release()
        self._memory.close()

    def _last_written(self) -> int:
        """Return the last whole record's number: a writer before us may have died between end and head."""
        head = self.head
        return head if self.fetch(head + 1) is None else head + 1


def _address(memory: mmap.mmap) -> int:
    """Return the address of `memory` without keeping an array, which would prevent its closing."""
    return np.frombuffer(memory, np.uint8).ctypes.data


def _stride(size: int) -> int:
    """Return the bytes from slot to slot for records of `size` bytes."""
    return -(-(size + 4 * 8) // _LINE) * _LINE


def _digest(dtype: np.dtype[Any]) -> bytes:
    """Return the layout of a record type as text: names, types, shapes, order and offsets of its fields."""
    return sha256(repr((dtype.descr, dtype.itemsize)).encode()).digest()[:16]


def _header(kind: str, dtype: np.dtype[Any], slots: int) -> bytes:
    return _HEADER.pack(_MAGIC, _VERSION, kind.encode(), slots, dtype.itemsize, _digest(dtype))


def _checked(path: Path, descriptor: int, kind: str, dtype: np.dtype[Any]) -> int:
    """Return the number of slots in the file; SharedMemoryError unless it is whole and of our making."""
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode):
        raise SharedMemoryError(str(path), "no regular file", f"a shared {kind}", "Remove it.")
    start = os.pread(descriptor, _HEADER.size, 0)
    if len(start) < _HEADER.size or not start.startswith(_MAGIC):
        raise SharedMemoryError(
            str(path),
            f"{status.st_size} bytes that begin with {start[:8]!r}",
            f"a shared {kind}, which begins with {_MAGIC!r}",
            "Remove the file and restart the bench.",
        )
    _, version, padded, slots, size, digest = _HEADER.unpack(start)
    stored = padded.rstrip(b"\0")
    action = "Restart all processes of the bench from one installation."
    if version != _VERSION:
        raise SharedMemoryError(str(path), f"layout version {version}", f"version {_VERSION}", action)
    if stored != kind.encode():
        raise SharedMemoryError(str(path), f"kind {stored!r}", f"kind {kind.encode()!r}", action)
    if (size, digest) != (dtype.itemsize, _digest(dtype)):
        raise SharedMemoryError(
            str(path),
            f"records of other code: {size} bytes, type {digest.hex()}",
            f"{dtype.itemsize} bytes, type {_digest(dtype).hex()}",
            action,
        )
    whole = FIRST + slots * _stride(size)
    if slots < 2 or slots & (slots - 1) or status.st_size != whole:
        raise SharedMemoryError(
            str(path), f"{status.st_size} bytes with {slots} slots", f"{whole} bytes", "Restart the bench."
        )
    return int(slots)


_RECORD_SLOTS, _RECORD_KIND = 4, "record"
_ATTEMPTS = 16
"""Copies a reader tries before it stays with its previous value."""


class SharedRecord:
    """One structured record in a mapped file: one process writes, any others read its newest value.

    Four slots take the values in turn. A slot is not reused for three writes: a reader has that long to copy
    it. An interrupted write leaves the previous value readable.
    """

    def __init__(self, slots: MappedSlots) -> None:
        """Use `slots`; see `create` and `open`."""
        self.slots = slots
        """Slots of the values: their numbers are the versions, `slots.head` that of the newest."""
        self._version = 0
        self._value = b""

    @classmethod
    def create(cls, path: Path, dtype: np.dtype[Any]) -> Self:
        """Make the file at `path`, not yet written to; the writer may, or a reader.

        Raises:
            SharedMemoryError: `path` exists, or its folder is missing, read-only or full.
        """
        return cls(MappedSlots.create(path, _RECORD_KIND, dtype, _RECORD_SLOTS))

    @classmethod
    def open(cls, path: Path, dtype: np.dtype[Any]) -> Self:
        """Map the file at `path`, to write or to read it.

        Raises:
            SharedMemoryError: no such file, or no shared record, or damaged, or of other code: another
                layout or another `dtype`.
        """
        return cls(MappedSlots.open(path, _RECORD_KIND, dtype, writable=True))

    def write(self, record: np.ndarray[Any, Any]) -> None:
        """Make `record` (a one-element array of the dtype) the newest value; a few us, never waits.

        A writer that follows a dead one counts on from its last version.

        Raises:
            ValueError: `record` has not the size of the dtype.
        """
        self.slots.put(record.tobytes())

    def read(self, into: np.ndarray[Any, Any]) -> int:
        """Copy the newest whole value into `into` (a one-element array of the dtype); return its version.

        Versions count the writes. At version 0, nothing written yet, `into` stays as it is. If the writer
        overtakes each of a few attempts to copy, `into` gets the value of the last reading, and its version
        is returned again. Never waits.
        """
        slots = self.slots
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
        self.slots.close()
