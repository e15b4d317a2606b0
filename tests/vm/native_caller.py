"""A driver called as the compiled tick calls it: its native functions first, Python where they decline."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from drivers.base import Command, Driver, Readings
from drivers.base.compiled import new_record
from drivers.base.native import DECLINED, NativeCall, NativeDriver
from drivers.base.records import COMMAND, READINGS, pack_command, unpack_command, unpack_readings

_WORDS = [ctypes.c_int64] * 4


class NativeCaller:
    """`read` and `write` of a driver; `declined` counts calls that were left to Python."""

    def __init__(self, driver: Driver) -> None:
        if not isinstance(driver, NativeDriver):
            raise TypeError(f"{driver!r} has no native functions")
        self._driver, calls = driver, driver.native_calls()
        self._read, self._write = self._function(calls.read), self._function(calls.write)
        self._readings, self._command, self._applied = map(new_record, (READINGS, COMMAND, COMMAND))
        self._places = [a.ctypes.data for a in (self._readings, self._command, self._applied)]
        self.declined = 0

    def _function(self, call: NativeCall) -> Any:
        if not call.function:
            return lambda *_: DECLINED
        function = ctypes.CFUNCTYPE(*_WORDS, ctypes.c_double)(call.function)
        return lambda first, second, time: function(call.block, first, second, time)

    def read_record(self, time: float) -> np.ndarray[Any, Any] | None:
        """Read into a record and return it; None where Python must."""
        answer = self._read(self._places[0], 0, time)
        return None if answer == DECLINED else self._readings

    def read(self, time: float) -> Readings:
        """Do what `Driver.read` does."""
        if (record := self.read_record(time)) is not None:
            return unpack_readings(record)
        self.declined += 1
        return self._driver.read(time)

    def write(self, command: Command) -> Command:
        """Do what `Driver.write` does."""
        pack_command(command, self._command)
        if self._write(*self._places[1:], 0.0) != DECLINED:
            return unpack_command(self._applied)
        self.declined += 1
        return self._driver.write(command)
