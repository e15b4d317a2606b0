"""The state of a CANopen driver as memory of its compiled ticks, and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numba

from drivers.base.compiled import new_record, numbers
from drivers.base.native import NativeCall, NativeCalls
from drivers.base.records import unpack_command
from drivers.canopen.frames import ANALOGUE_IN_ONE, analogue_groups
from drivers.canopen.native_tick import (
    COUNTED,
    IS_SUPPORTED,
    LINK_STATE,
    NOWHERE,
    left_over,
    prepare,
    read_native,
    write_native,
)
from drivers.canopen.settings import CanopenSettings

SHARED = (
    *("time", "listened", "sync_time", "awaited", "came", "in_time", "owed", "counts", "sampled", "seen"),
    *("faulty", "inputs", "inputs_received", "last_heard", "beaten"),
)
"""Fields that compiled code changes; attributes of `CanopenDriver` of the same names, with an underscore."""
FIXED = (
    *("nodes", "counts_per_revolution", "range", "input_bits", "vent_bits", "shut_off_bit", "output_bits"),
    *(
        "valve_centre",
        "valve_span",
        "zeros",
        "scales",
        "believable",
        "max_step",
        "beat_period",
        "max_silence",
    ),
    *("max_input_gap", "max_gaps", "command_identifier"),
)
"""Fields that it only reads."""
LOADED = (*SHARED, "waiting", "end", "receive_error", "send_error", "echoed", "ahead")


class NativeState:
    """The record of a driver's compiled ticks."""

    def __init__(self, settings: CanopenSettings) -> None:
        self._settings = settings
        self._state = new_record(LINK_STATE)
        self._groups = analogue_groups(settings)
        self._location = {0: NOWHERE} | {
            channel: ANALOGUE_IN_ONE * (group.number - 1) + k
            for group in self._groups
            for k, channel in enumerate(group.channels)
        }
        self.leads = numbers(self._state["leads"])
        """Whether compiled code has the newest state (one number)."""
        self.is_wanted = False
        """Whether the native functions were requested."""

    def calls(self) -> NativeCalls:
        """Return the native functions; none on a system with another layout of kernel structures."""
        if not IS_SUPPORTED or numba.config.DISABLE_JIT:
            return NativeCalls()
        self.is_wanted = True
        block = self._state.ctypes.data
        return NativeCalls(NativeCall(read_native.address, block), NativeCall(write_native.address, block))

    def store(self, values: Mapping[str, Any], analogue: Mapping[int, float], received: list[float]) -> None:
        """Take the state, whose ticks are compiled from now on.

        `values` are fields of LINK_STATE; `analogue` are values keyed by analogue input, 0 where none is
        fitted, and `received` is when each of their groups came (s).
        """
        state, location, node = self._state[0], self._location, self._settings.valve_node
        for name in ("waiting", "receive_error", "send_error", "at", "count"):
            state[name] = 0
        for name, value in values.items():
            state[name] = value
        for channel, k in location.items():
            state["analogue"][k] = analogue[channel]
        state["supply"] = location[node.supply_pressure]
        state["chambers"] = [location[channel] for channel in node.chamber_pressures]
        state["spools"] = [location[channel] for channel in node.spool_positions]
        state["group_sizes"] = 0
        for group, time in zip(self._groups, received, strict=True):
            slot = group.number - 1
            state["group_sizes"][slot], state["analogue_received"][slot] = len(group.channels), time
        prepare(self._state)
        self.leads[0] = True

    def load(self) -> dict[str, Any]:
        """Return the state in plain values and let Python lead.

        `analogue` is keyed by analogue input, `counters` by name, as increments; `pending`
        are the frames received and not taken.
        """
        state = self._state[0]
        self.leads[0] = False
        values: dict[str, Any] = {name: state[name].tolist() for name in LOADED}
        for name in ("seen", "faulty"):
            values[name] = [one != 0 for one in values[name]]
        found, received = state["analogue"].tolist(), state["analogue_received"].tolist()
        values["analogue"] = {channel: found[k] for channel, k in self._location.items()}
        values["analogue_received"] = [received[group.number - 1] for group in self._groups]
        values["counters"] = dict(zip(COUNTED, state["counters"].tolist(), strict=True))
        state["counters"] = 0
        values["applied"] = unpack_command(self._state["applied"])
        values["pending"] = left_over(self._state)
        return values
