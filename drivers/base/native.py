"""How compiled code uses addresses: native functions, access, order of loads and stores, calls, the clock.

Native functions are C functions by address, through which a compiled tick calls a driver or publisher. A
native function takes the address of its block of memory, two addresses of records and the time (s), and
returns an integer. If it returns DECLINED, it has done nothing: the caller then runs the Python code, which
handles every case and raises any error. Both give bit-identical results.

Nothing here checks an address: a caller holds the arrays that it gives the addresses of.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from llvmlite import ir
from numba import carray, types
from numba.core import sigutils
from numba.core.ccallback import CFunc
from numba.extending import intrinsic

from drivers.base.compiled import IS_PLAIN, compiled, compiled_with_arrays
from drivers.base.kept_code import keep_code

DECLINED = 0
DONE = 1
OPERATIONAL = 2
"""Bit of a read's answer: `Driver.operational` after it."""


class NativeCall(NamedTuple):
    """A native function and its block; function 0 where Python does it."""

    function: int = 0
    block: int = 0


class NativeCalls(NamedTuple):
    """The native functions of a driver."""

    read: NativeCall = NativeCall()
    """READINGS at the first address; returns DONE, with OPERATIONAL, or DECLINED."""
    write: NativeCall = NativeCall()
    """COMMAND at the first address; the applied one is written to the second. Returns DONE or DECLINED."""
    note_truth: NativeCall = NativeCall()
    """TRUTH is written to the first address. Returns DONE or DECLINED."""


@runtime_checkable
class NativeDriver(Protocol):
    """A driver that can also be called from compiled code."""

    def native_calls(self) -> NativeCalls:
        """Return the native functions; their blocks live as long as the driver."""


_SIGNATURE = types.int64(types.int64, types.int64, types.int64, types.float64)


class NativeFunction:
    """A function that becomes a C function when its address is first read, cached on disk."""

    def __init__(self, function: Callable[[int, int, int, float], int]) -> None:
        self._function = function
        self._made: Any = None

    @property
    def address(self) -> int:
        """Address of the C function; 0 where nothing is compiled."""
        if IS_PLAIN:
            return 0
        if self._made is None:
            # What `numba.cfunc` does, with the cache of `compiled`: its own is that of the last module.
            signature = sigutils.normalize_signature(_SIGNATURE)
            self._made = CFunc(self._function, signature, {}, {"error_model": "numpy"})
            keep_code(self._made, self._function.__module__)
            self._made.compile()
        return cast(int, self._made.address)


def compiled_call(function: Callable[[int, int, int, float], int]) -> NativeFunction:
    """Make `function(block, first, second, time)` a native function, arithmetic as of `compiled`."""
    return NativeFunction(function)


@compiled
def limit_command(command: Any, applied: Any) -> None:
    """Write `command` as a device applies it into `applied` (COMMAND), as `device_limited` does."""
    given, out = command[0], applied[0]
    finite = True
    for i in range(3):
        finite = finite and math.isfinite(given.valve[i])
    if not finite:
        rest_command(applied)
        return
    for i in range(3):
        least = given.valve[i] if given.valve[i] < 1.0 else 1.0
        out.valve[i] = least if least > -1.0 else -1.0
    out.supply_enable, out.exhaust_closed = given.supply_enable, given.exhaust_closed
    out.guard_lock, out.beacon = given.guard_lock, given.beacon
    out.tee, out.search_index = given.tee, given.search_index


@compiled
def rest_command(applied: Any) -> None:
    """Write PASSIVE into `applied` (COMMAND)."""
    out = applied[0]
    for i in range(3):
        out.valve[i] = 0.0
    out.supply_enable = out.exhaust_closed = False
    out.guard_lock = True
    out.beacon = out.tee = out.search_index = False


CLOCK_REALTIME, CLOCK_MONOTONIC = 0, 1
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


@compiled_with_arrays
def copy_bytes(source: int, target: int, size: int) -> None:
    """Copy `size` bytes from one address to another."""
    old, new = carray(pointer(source), size, np.uint8), carray(pointer(target), size, np.uint8)
    for k in range(size):
        new[k] = old[k]


@compiled
def monotonic_now(scratch: int) -> int:
    """Return CLOCK_MONOTONIC, ns; arguments as `clock_now`."""
    return clock_now(CLOCK_MONOTONIC, scratch)


@compiled_with_arrays
def clock_now(clock: int, scratch: int) -> int:
    """Return a clock of the kernel, ns, which the kernel writes to the address `scratch`, 16 bytes."""
    _clock_gettime(clock, scratch)
    t = carray(pointer(scratch), 2, np.int64)
    return t[0] * _SECOND + t[1]  # type: ignore[no-any-return]
