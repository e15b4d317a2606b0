"""A tick of the CANopen driver on a raw SocketCAN socket, in compiled code: no object of Python is made.

Frames are received in batches (`recvmmsg`) into one block of memory, parsed there, and packed there. The rest
is left to `drivers.canopen.driver`: error frames, emergencies, SDO answers, unknown identifiers, wrong
lengths, frames cut short, nodes that are not operational, silence, failures of the socket. The native
function then stops in front of that frame or failure and declines. The driver continues from exactly
that state (`NativeState`), including frames already received, and hands it back at the end of its tick.
"""

from __future__ import annotations

import errno
import math
import os
import struct
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numba import carray, types

from drivers.base import ABSENT, INVALID
from drivers.base.clocks import MAX_READ
from drivers.base.compiled import IS_PLAIN, compiled, compiled_with_arrays, fields, new_record, numbers
from drivers.base.native import (
    CLOCK_REALTIME,
    DECLINED,
    DONE,
    OPERATIONAL,
    NativeCall,
    NativeCalls,
    clock_now,
    compiled_call,
    copy_bytes,
    limit_command,
    monotonic_now,
    pointer,
)
from drivers.base.records import COMMAND, READINGS, unpack_command
from drivers.can_bus import FRAME
from drivers.canopen.frames import (
    ANALOGUE_IN_ONE,
    COMMAND_LENGTH,
    HEARTBEAT,
    INPUTS_LENGTH,
    MAX_ECHO_DELAY,
    POSITION_LENGTH,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO4,
    analogue_groups,
)
from drivers.canopen.settings import CanopenSettings

IS_SUPPORTED = sys.platform == "linux" and sys.byteorder == "little" and struct.calcsize("P") == 8
"""Whether the structures of the kernel have the layout that is compiled in."""

FRAME_SIZE = FRAME.size
BATCH = 16
"""Frames received by one system call."""
MAX_WAITING = 64
"""Max frames taken before the SYNC."""
ALL = 0b111
OPERATIONAL_STATE = 5
NOWHERE = 12
"""Index of an analogue input that is not fitted."""

COUNTED = (
    *("frames", "positions", "late", "duplicates", "inputs", "analogue", "heartbeats"),
    *("syncs", "missing", "floods"),
)
"""Counters of `BusCounters` that compiled code raises."""
_FRAMES, _POSITIONS, _LATE, _DUPLICATES, _INPUTS, _ANALOGUE, _HEARTBEATS, _SYNCS, _MISSING, _FLOODS = range(
    10
)

_CONTROL_SIZE = 32
"""Bytes for the time stamp of a frame: `CMSG_SPACE` of a timespec."""
_HEADER_WORDS = 8
"""Words of a `struct mmsghdr`: name, its length, vector, 1, control, its size, flags, bytes received."""
_SIZE_MASK = 0xFFFFFFFF
"""Mask of the bytes received in their word; the rest is padding."""
_DONT_WAIT, _CONFIRM, _INTERRUPTED = 0x40, 0x800, errno.EINTR
_NOTHING_THERE = errno.EAGAIN
_READABLE = 1
_SCM_TIMESTAMPNS = 35
_SECOND = 1_000_000_000

LINK_STATE = np.dtype(
    [
        *fields("i8", "leads waiting"),
        ("end", "f8"),
        *fields("i8", "at count receive_error send_error"),
        *fields("f8", "time listened sync_time"),
        *fields("i8", "awaited came in_time"),
        *fields("i8", "owed counts", (3,)),
        ("sampled", "f8", (3,)),
        *fields("i8", "seen faulty", (3,)),
        ("inputs", "i8"),
        ("inputs_received", "f8"),
        ("analogue", "f8", (13,)),
        ("analogue_received", "f8", (3,)),
        ("last_heard", "f8", (4,)),
        *fields("f8", "beaten echoed"),
        ("ahead", "i8"),
        ("applied", COMMAND),
        ("counters", "i8", (len(COUNTED),)),
        # Settings
        ("descriptor", "i8"),
        ("nodes", "i8", (4,)),
        ("counts_per_revolution", "i8"),
        *fields("i8", "range group_sizes", (3,)),
        ("supply", "i8"),
        ("chambers", "i8", (6,)),
        ("spools", "i8", (3,)),
        ("input_bits", "i8", (5,)),
        ("vent_bits", "i8", (2,)),
        ("shut_off_bit", "i8"),
        ("output_bits", "i8", (5,)),
        ("valve_centre", "f8", (3,)),
        ("valve_span", "f8"),
        *fields("f8", "zeros scales", (3,)),
        ("believable", "f8", (3, 2)),
        *fields("f8", "max_step sync_timeout beat_period max_silence max_input_gap"),
        ("max_gaps", "f8", (3,)),
        ("command_identifier", "i8"),
        # Memory for the kernel
        *fields("i8", "sync beat command", (2,)),
        ("frames", "i8", (2 * BATCH,)),
        ("headers", "i8", (_HEADER_WORDS * BATCH,)),
        ("vectors", "i8", (2 * BATCH,)),
        ("control", "i8", (_CONTROL_SIZE // 8 * BATCH,)),
        ("poll", "i8"),
        *fields("i8", "left clock", (2,)),
    ],
    align=True,
)
"""All that a tick works on. `leads`: compiled code has the newest state, not Python. `waiting`: the SYNC was
sent, its answers are waited for until `end` (s). The frames from `at` to `count` of the batch are still to be
taken. `receive_error` and `send_error` (errno) are for Python to act on. The other names are
those in `CanopenDriver`."""


def _offset(name: str) -> int:
    return int(LINK_STATE.fields[name][1])  # type: ignore[index]


_AT_SYNC, _AT_BEAT, _AT_COMMAND, _AT_APPLIED = map(_offset, ("sync", "beat", "command", "applied"))
_AT_FRAMES, _AT_HEADERS, _AT_VECTORS = map(_offset, ("frames", "headers", "vectors"))
_AT_CONTROL, _AT_POLL, _AT_LEFT, _AT_CLOCK = map(_offset, ("control", "poll", "left", "clock"))
_COMMAND_SIZE = COMMAND.itemsize

_recvmmsg = types.ExternalFunction(
    "recvmmsg", types.intc(types.intc, types.intp, types.uintc, types.intc, types.intp)
)
_send = types.ExternalFunction("send", types.intp(types.intc, types.intp, types.uintp, types.intc))
_ppoll = types.ExternalFunction("ppoll", types.intc(types.intp, types.uintp, types.intp, types.intp))
_errno_location = types.ExternalFunction("__errno_location", types.intp())


def prepare(state: np.ndarray[Any, Any]) -> None:
    """Fill the structures of the kernel in a LINK_STATE (one-element array), whose address may not change."""
    base, s = state.ctypes.data, state[0]
    for k in range(BATCH):
        s["vectors"][2 * k : 2 * k + 2] = base + _AT_FRAMES + FRAME.size * k, FRAME.size
        header = s["headers"][_HEADER_WORDS * k : _HEADER_WORDS * (k + 1)]
        header[:] = 0
        header[2:5] = base + _AT_VECTORS + 16 * k, 1, base + _AT_CONTROL + _CONTROL_SIZE * k


def words_of(frame: bytes) -> tuple[int, ...]:
    """Return a frame (FRAME) as its two words."""
    return struct.unpack("=qq", frame)


def left_over(state: np.ndarray[Any, Any]) -> list[bytes]:
    """Return the frames of the batch that were not taken, as received, without echoes; empty the batch."""
    s = state[0]
    begin, end = int(s["at"]), int(s["count"])
    frames = [
        s["frames"][2 * k : 2 * k + 2].tobytes()[: s["headers"][_HEADER_WORDS * k + 7] & _SIZE_MASK]
        for k in range(begin, end)
        if not s["headers"][_HEADER_WORDS * k + 6] & _CONFIRM
    ]
    s["at"] = s["count"] = 0
    return frames


def failure(number: int) -> OSError:
    """Return the exception of errno `number`."""
    return OSError(number, os.strerror(number))


@compiled_with_arrays
def _last_error() -> int:
    return int(carray(pointer(_errno_location()), 1, np.int32)[0])


@compiled
def _receive(states: Any, block: int) -> int:
    """Receive all frames that wait, up to a batch; return how many, -1 on failure."""
    s = states[0]
    s.at = s.count = 0
    for k in range(BATCH):
        s.headers[_HEADER_WORDS * k + 5], s.headers[_HEADER_WORDS * k + 6] = _CONTROL_SIZE, 0
    n = int(_recvmmsg(s.descriptor, block + _AT_HEADERS, BATCH, _DONT_WAIT, 0))
    if n < 0:
        error = _last_error()
        if error in (_NOTHING_THERE, _INTERRUPTED):
            return 0
        s.receive_error = error
        return -1
    s.count = n
    return n


@compiled
def _wait(states: Any, block: int) -> int:
    """Receive a batch by `end`; return the number of its frames, 0 after the time, -1 on failure."""
    s = states[0]
    while True:
        left = math.floor((s.end - monotonic_now(block + _AT_CLOCK) / 1e9) * 1e9)
        if left <= 0.0:
            return 0
        s.poll = s.descriptor | _READABLE << 32
        s.left[0], s.left[1] = np.int64(left) // _SECOND, np.int64(left) % _SECOND
        ready = _ppoll(block + _AT_POLL, 1, block + _AT_LEFT, 0)
        if ready == 0:
            return 0
        if ready < 0:
            error = _last_error()
            if error == _INTERRUPTED:
                continue
            s.receive_error = error
            return -1
        n = _receive(states, block)
        if n != 0:
            return n


@compiled
def _note_echo(states: Any, block: int, k: int) -> None:
    """Record the transmission time of the own SYNC, frame `k` of the batch, as `SocketcanLink` does."""
    s = states[0]
    scratch = block + _AT_CLOCK
    before = monotonic_now(scratch)
    now = clock_now(CLOCK_REALTIME, scratch)
    after = monotonic_now(scratch)
    if after - before < MAX_READ:
        s.ahead = now - (before + after) // 2
    at = _CONTROL_SIZE // 8 * k
    size, kind = s.headers[_HEADER_WORDS * k + 5], s.control[at + 1] >> 32
    if size >= _CONTROL_SIZE and kind == _SCM_TIMESTAMPNS:
        s.echoed = 1e-9 * (s.control[at + 2] * _SECOND + s.control[at + 3] - s.ahead)


@compiled
def _take_position(states: Any, joint: int, position: int) -> None:
    s, bit = states[0], 1 << joint
    s.came |= bit
    if s.owed[joint] != 0:
        s.owed[joint] -= 1
        s.counters[_LATE] += 1
        return
    if s.awaited & bit == 0:
        s.counters[_DUPLICATES] += 1
        return
    s.awaited &= ~bit
    s.counters[_POSITIONS if s.in_time != 0 else _LATE] += 1
    s.counts[joint] = position % s.counts_per_revolution if position < s.range[joint] else position
    s.sampled[joint], s.seen[joint] = s.sync_time, 1


@compiled
def _take_analogue(states: Any, group: int, data: int) -> None:
    s = states[0]
    s.counters[_ANALOGUE] += 1
    s.analogue_received[group] = s.listened
    for k in range(s.group_sizes[group]):
        count = data >> 16 * k & 0xFFFF
        value = s.zeros[group] + s.scales[group] * (count - (count >> 15 << 16))
        believed = s.believable[group, 0] <= value <= s.believable[group, 1]
        s.analogue[4 * group + k] = value if believed else INVALID


@compiled
def _take(states: Any, k: int) -> bool:
    """Process frame `k` of the batch; False, and nothing done, where Python must."""
    s = states[0]
    if s.headers[_HEADER_WORDS * k + 7] & _SIZE_MASK != FRAME_SIZE:
        return False
    first, data = s.frames[2 * k], s.frames[2 * k + 1]
    identifier, length = first & 0xFFFFFFFF, first >> 32 & 0xFF
    valve_node = s.nodes[3]
    for joint in range(3):
        if identifier == TPDO2 + s.nodes[joint] and length == POSITION_LENGTH:
            s.counters[_FRAMES] += 1
            _take_position(states, joint, data & 0xFFFFFFFF)
            return True
    for group in range(3):
        base = TPDO2 if group == 0 else TPDO3 if group == 1 else TPDO4
        size = s.group_sizes[group]
        if identifier == base + valve_node and size > 0 and length == 2 * size:
            s.counters[_FRAMES] += 1
            _take_analogue(states, group, data)
            return True
    if identifier == TPDO1 + valve_node and length == INPUTS_LENGTH:
        s.counters[_FRAMES] += 1
        s.counters[_INPUTS] += 1
        s.inputs, s.inputs_received = data & 0xFF, s.listened
        return True
    for node in range(4):
        if identifier == HEARTBEAT + s.nodes[node] and length == 1 and data & 0x7F == OPERATIONAL_STATE:
            s.counters[_FRAMES] += 1
            s.counters[_HEARTBEATS] += 1
            s.last_heard[node] = s.listened
            return True
    return False


@compiled
def _take_batch(states: Any, block: int, most: int, until_all: bool) -> int:
    """Take the frames of the batch, at most `most`; return how many, -1 where Python must continue.

    `until_all`: only as long as samples are awaited.
    """
    s, taken = states[0], 0
    while s.at < s.count and taken < most and not (until_all and s.awaited == 0):
        if s.headers[_HEADER_WORDS * s.at + 6] & _CONFIRM != 0:
            _note_echo(states, block, s.at)
        elif _take(states, s.at):
            taken += 1
        else:
            return -1
        s.at += 1
    return taken


@compiled
def _drain(states: Any, block: int) -> bool:
    """Take the frames received since the last tick; False where Python must continue."""
    s, taken, got = states[0], 0, BATCH
    while True:
        n = _take_batch(states, block, MAX_WAITING - taken, False)
        if n < 0:
            return False
        taken += n
        if taken >= MAX_WAITING:
            s.counters[_FLOODS] += 1
            return True
        if got < BATCH:  # it has emptied the queue
            return True
        got = _receive(states, block)
        if got <= 0:
            return got == 0


@compiled
def _synchronise(states: Any, block: int) -> bool:
    """Send the SYNC; False where Python must continue."""
    s = states[0]
    for joint in range(3):
        if s.awaited >> joint & 1:
            s.counters[_MISSING] += 1
            s.owed[joint] = 0 if s.came >> joint & 1 else s.owed[joint] + 1
    s.awaited = 0
    sent = monotonic_now(block + _AT_CLOCK) / 1e9
    if _send(s.descriptor, block + _AT_SYNC, FRAME_SIZE, _DONT_WAIT) < 0:
        s.send_error = _last_error()
        return False
    s.counters[_SYNCS] += 1
    s.sync_time, s.awaited, s.came, s.in_time = sent, ALL, 0, 1
    s.end, s.waiting = monotonic_now(block + _AT_CLOCK) / 1e9 + s.sync_timeout, 1
    return True


@compiled
def _await(states: Any, block: int) -> bool:
    """Take the answers to the SYNC; False where Python must continue."""
    s = states[0]
    while s.awaited != 0:
        if _take_batch(states, block, MAX_WAITING, True) < 0:
            return False
        if s.awaited != 0:
            n = _wait(states, block)
            if n < 0:
                return False
            if n == 0:
                break
    sent = s.sync_time
    if sent <= s.echoed < sent + MAX_ECHO_DELAY and s.echoed != sent:
        s.sync_time = s.echoed
        for joint in range(3):
            if s.sampled[joint] == sent:
                s.sampled[joint] = s.echoed
    return True


@compiled
def _supervise(states: Any) -> bool:
    """Invalidate overdue analogue inputs; return False if a node or the interlocks are overdue."""
    s = states[0]
    now, silent = s.listened, s.last_heard[0]
    for node in range(1, 4):
        silent = min(silent, s.last_heard[node])
    if now - silent > s.max_silence or now - s.inputs_received > s.max_input_gap:
        return False
    for group in range(3):
        received = s.analogue_received[group]
        if now - received > s.max_gaps[group] and received > -np.inf:
            s.analogue_received[group] = -np.inf
            for k in range(s.group_sizes[group]):
                s.analogue[4 * group + k] = INVALID
    return True


@compiled
def _fill(states: Any, readings: Any, time: float) -> None:
    """Write the READINGS at `time` (s)."""
    s, out = states[0], readings[0]
    out.time = time
    for i in range(3):
        out.encoder_count[i], out.encoder_time[i] = s.counts[i], s.sampled[i]
        out.encoder_valid[i] = s.seen[i] != 0 and s.faulty[i] == 0
        out.encoder_age[i] = time - s.sampled[i]
        out.encoder_indexed[i] = True
    out.emergency_stop_clear = s.inputs & s.input_bits[0] != 0
    out.guard_closed = s.inputs & s.input_bits[1] != 0
    out.guard_locked = s.inputs & s.input_bits[2] != 0
    out.local_reset = s.inputs & s.input_bits[3] != 0
    out.ball_present = s.inputs & s.input_bits[4] != 0
    out.supply_pressure = s.analogue[s.supply]
    for i in range(6):
        out.chamber_pressure[i] = s.analogue[s.chambers[i]]
    for i in range(3):
        out.spool_position[i] = s.analogue[s.spools[i]]
    for i in range(2):
        bit = s.vent_bits[i]
        out.vent_open[i] = ABSENT if bit == 0 else 1.0 if s.inputs & bit != 0 else 0.0
    bit = s.shut_off_bit
    out.shut_off_open = ABSENT if bit == 0 else 1.0 if s.inputs & bit != 0 else 0.0


@compiled_call
def read_native(block: int, record: int, _: int, time: float) -> int:
    """Do what `CanopenDriver.read` does."""
    states = carray(pointer(block), 1, LINK_STATE)
    s = states[0]
    if s.leads == 0 or not s.time <= time < np.inf:
        return DECLINED
    s.listened += min(time - s.time, s.max_step)
    s.time, s.in_time = time, 0
    if not (_drain(states, block) and _synchronise(states, block)):
        return DECLINED
    if not (_await(states, block) and _supervise(states)):
        return DECLINED
    s.waiting = 0
    _fill(states, carray(pointer(record), 1, READINGS), time)
    return DONE | OPERATIONAL


@compiled
def _pack(states: Any, command: Any) -> bool:
    """Pack the frame of `command`, already limited; False if a value exceeds its field."""
    s, c = states[0], command[0]
    data = (
        (s.output_bits[0] if c.supply_enable else 0)
        | (s.output_bits[1] if c.exhaust_closed else 0)
        | (0 if c.guard_lock else s.output_bits[2])
        | (s.output_bits[3] if c.beacon else 0)
        | (s.output_bits[4] if c.tee else 0)
    )
    if data > 0xFF:
        return False
    for i in range(2, -1, -1):
        count = int(s.valve_centre[i] + s.valve_span * c.valve[i])
        if not -0x8000 <= count <= 0x7FFF:
            return False
        data = data << 16 | count & 0xFFFF
    s.command[0], s.command[1] = s.command_identifier | COMMAND_LENGTH << 32, data
    return True


@compiled_call
def write_native(block: int, command: int, applied: int, time: float) -> int:
    """Do what `CanopenDriver.write` does."""
    states = carray(pointer(block), 1, LINK_STATE)
    s = states[0]
    limited = carray(pointer(applied), 1, COMMAND)
    if s.leads == 0 or s.waiting != 0:
        return DECLINED
    limit_command(carray(pointer(command), 1, COMMAND), limited)
    if not _pack(states, limited):
        return DECLINED
    if s.time - s.beaten >= s.beat_period:
        if _send(s.descriptor, block + _AT_BEAT, FRAME_SIZE, _DONT_WAIT) < 0:
            s.send_error = _last_error()
            return DECLINED
        s.beaten = s.time
    if _send(s.descriptor, block + _AT_COMMAND, FRAME_SIZE, _DONT_WAIT) < 0:
        s.send_error = _last_error()
        return DECLINED
    copy_bytes(applied, block + _AT_APPLIED, _COMMAND_SIZE)
    return DONE


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
        if not IS_SUPPORTED or IS_PLAIN:
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
