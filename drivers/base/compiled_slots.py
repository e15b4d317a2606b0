"""Writer and reader of a mapped file of records (`drivers.base.shared_memory`) in compiled code.

The same bytes as by Python, copied once, and the same rules. Fences keep the order; they cost nothing on a
processor that keeps it without them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import carray

from drivers.base.compiled import compiled, compiled_with_arrays
from drivers.base.native import (
    DECLINED,
    DONE,
    compiled_call,
    copy_bytes,
    fence,
    load_word,
    pointer,
    store_word,
)
from drivers.base.shared_memory import ADDRESS, FIRST, HEAD, MASK, READ, SIZE, STRIDE, WRITTEN

_ATTEMPTS = 16
"""Copies tried before the last value stays."""


def _crc_tables() -> np.ndarray[Any, Any]:
    """Return the tables (8, 256) of CRC-32 for eight bytes at a time."""
    tables = np.zeros((8, 256), np.uint32)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = value >> 1 ^ (0xEDB88320 if value & 1 else 0)
        tables[0, byte] = value
    for k in range(1, 8):
        tables[k] = tables[k - 1] >> 8 ^ tables[0][tables[k - 1] & 0xFF]
    return tables


_TABLES = _crc_tables()


@compiled_with_arrays
def copy_words(source: int, target: int, size: int, start: int) -> int:
    """Copy `size` bytes, a multiple of 8; return their CRC-32, started with `start` as in `zlib.crc32`."""
    old, new = carray(pointer(source), size // 8, np.int64), carray(pointer(target), size // 8, np.int64)
    crc: Any = start & 0xFFFFFFFF ^ 0xFFFFFFFF
    for k in range(size // 8):
        word = old[k]
        new[k] = word
        low, high = word & 0xFFFFFFFF ^ crc, word >> 32 & 0xFFFFFFFF
        crc = (
            np.int64(_TABLES[7, low & 0xFF])
            ^ np.int64(_TABLES[6, low >> 8 & 0xFF])
            ^ np.int64(_TABLES[5, low >> 16 & 0xFF])
            ^ np.int64(_TABLES[4, low >> 24])
            ^ np.int64(_TABLES[3, high & 0xFF])
            ^ np.int64(_TABLES[2, high >> 8 & 0xFF])
            ^ np.int64(_TABLES[1, high >> 16 & 0xFF])
            ^ np.int64(_TABLES[0, high >> 24])
        )
    return crc ^ 0xFFFFFFFF  # type: ignore[no-any-return]


@compiled_with_arrays
def slots_at(block: int) -> Any:
    """Return the block of a `MappedSlots` at its address."""
    return carray(pointer(block), 6, np.int64)


@compiled
def put_record(slots: Any, source: int) -> bool:
    """Write the record at the address `source` as the next; False, and nothing done, where Python must.

    That is the first record, one of odd size, and a file that is closed.
    """
    sequence, size = slots[WRITTEN] + 1, slots[SIZE]
    if slots[ADDRESS] == 0 or sequence == 1 or size % 8 != 0:
        return False
    start = slots[ADDRESS] + FIRST + (sequence & slots[MASK]) * slots[STRIDE]
    store_word(start, sequence)
    fence()
    check = copy_words(source, start + 16, size, sequence)
    store_word(start + 8, check)
    store_word(start + 16 + size, sequence)
    store_word(slots[ADDRESS] + HEAD, sequence)
    slots[WRITTEN] = sequence
    return True


@compiled
def newest_record(slots: Any) -> int:
    """Return the number of the newest record, 0 before the first; -1 if the file is closed."""
    return load_word(slots[ADDRESS] + HEAD) if slots[ADDRESS] != 0 else -1


@compiled
def fetch_record(slots: Any, target: int, scratch: int) -> bool:
    """Copy the newest record to `target` if it is new; False, and nothing done, where Python must.

    `scratch` is the address of a record's size of memory. A copy that the writer has overtaken is dropped:
    `target` then keeps the record before.
    """
    size = slots[SIZE]
    if slots[ADDRESS] == 0 or size % 8 != 0:
        return False
    for _ in range(_ATTEMPTS):
        newest = newest_record(slots)
        if newest == slots[READ]:
            return True
        start = slots[ADDRESS] + FIRST + (newest & slots[MASK]) * slots[STRIDE]
        if load_word(start + 16 + size) != newest:
            continue
        check = copy_words(start + 16, scratch, size, newest)
        fence()
        if load_word(start + 8) == check and load_word(start) == newest:
            copy_bytes(scratch, target, size)
            slots[READ] = newest
            return True
    return True


@compiled_call
def put_native(block: int, record: int, _: int, time: float) -> int:
    """Write the record at the address `record` into the slots of `block`."""
    return DONE if put_record(slots_at(block), record) else DECLINED
