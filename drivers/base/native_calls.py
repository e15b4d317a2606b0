"""Native functions: C functions by address, through which a compiled tick calls a driver or publisher.

A native function takes the address of its block of memory, two addresses of records and the time (s), and
returns a word. One that returns DECLINED has done nothing: the caller then runs the Python code, which
handles every case and raises any error. Both give bit-identical results. `drivers.base.native` compiles them;
here is nothing that needs a compiler.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

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
