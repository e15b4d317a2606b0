"""What compiled code does with addresses: access, order of stores and loads, calls, the kernel's clock.

Nothing here checks an address: a caller holds the arrays that it gives the addresses of.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.extending import intrinsic

from drivers.base.compiled import compiled

_CLOCK_MONOTONIC = 1
_SECOND = 1_000_000_000
_WORD, _NUMBER = ir.IntType(64), ir.DoubleType()

_clock_gettime = types.ExternalFunction("clock_gettime", types.intc(types.intc, types.intp))


@intrinsic  # type: ignore[untyped-decorator]
def pointer(typing: Any, address: Any) -> Any:
    """Return `address` as a pointer, for `numba.carray`."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.intp), generate


@intrinsic  # type: ignore[untyped-decorator]
def load_word(typing: Any, address: Any) -> Any:
    """Return the word at `address`; no later load or store comes before this load."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        location = builder.inttoptr(arguments[0], _WORD.as_pointer())
        return builder.load_atomic(location, "acquire", 8)

    return types.int64(types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def store_word(typing: Any, address: Any, value: Any) -> Any:
    """Store the word `value` at `address`; no earlier load or store comes after this store."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        location = builder.inttoptr(arguments[0], _WORD.as_pointer())
        builder.store_atomic(arguments[1], location, "release", 8)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), generate


@intrinsic  # type: ignore[untyped-decorator]
def fence(typing: Any) -> Any:
    """Let no load or store pass, in either direction, but a load before an earlier store."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        builder.fence("acq_rel")
        return context.get_dummy_value()

    return types.void(), generate


@intrinsic  # type: ignore[untyped-decorator]
def call_native(typing: Any, function: Any, block: Any, first: Any, second: Any, time: Any) -> Any:
    """Call the native function at the address `function`, see `drivers.base.native`."""
    kind = ir.FunctionType(_WORD, [_WORD, _WORD, _WORD, _NUMBER])

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])

    words = [types.int64] * 4
    return types.int64(*words, types.float64), generate


@compiled
def copy_bytes(source: int, target: int, size: int) -> None:
    """Copy `size` bytes from one address to another."""
    old, new = carray(pointer(source), size, np.uint8), carray(pointer(target), size, np.uint8)
    for k in range(size):
        new[k] = old[k]


@compiled
def monotonic_now(scratch: int) -> int:
    """Return CLOCK_MONOTONIC in ns; the kernel writes it to the address `scratch`, 16 bytes."""
    _clock_gettime(_CLOCK_MONOTONIC, scratch)
    t = carray(pointer(scratch), 2, np.int64)
    return t[0] * _SECOND + t[1]  # type: ignore[no-any-return]
