"""Compiled native functions (`drivers.base.native_calls`), and what they need of a command."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numba
from numba import types
from numba.core import sigutils
from numba.core.ccallback import CFunc

from drivers.base.compiled import compiled, keep_code

_SIGNATURE = types.int64(types.int64, types.int64, types.int64, types.float64)


class NativeFunction:
    """A function that becomes a C function when its address is first read, cached on disk."""

    def __init__(self, function: Callable[[int, int, int, float], int]) -> None:
        self._function = function
        self._made: Any = None

    @property
    def address(self) -> int:
        """Address of the C function; 0 where nothing is compiled."""
        if numba.config.DISABLE_JIT:
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
