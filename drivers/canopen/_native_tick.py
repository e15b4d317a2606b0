"""State of the CANopen driver, its usual frames, and its tick on a raw SocketCAN socket, in compiled code.

`CanopenDriver` and the native functions work on one record, LINK_STATE, with the same functions. On the
socket, frames are received in batches (`recvmmsg`) into one block of memory, parsed there, and packed there:
no object of Python is made. The rest is left to the driver: error frames, emergencies, SDO answers, unknown
identifiers, wrong lengths, frames cut short, nodes that are not operational, silence, failures of the socket.
The native function then stops in front of that frame or failure and declines. The driver continues from
there, including frames already received, until the end of its tick.
"""

from __future__ import annotations

import errno
import math
import os
import struct
import sys
from typing import Any

import numpy as np
from numba import carray, types

from drivers.base import ABSENT, INVALID, SPOOL_RANGE
from drivers.base.clocks import MAX_READ
from drivers.base.compiled import compiled, compiled_with_arrays, fields, new_record
from drivers.base.native import (
    CLOCK_REALTIME,
    DECLINED,
    DONE,
    OPERATIONAL,
    clock_now,
    compiled_call,
    copy_bytes,
    limit_command,
    monotonic_now,
    pointer,
)
from drivers.base.records import COMMAND, READINGS
from drivers.can_bus import FRAME
from drivers.canopen.frames import (
    ANALOGUE_IN_ONE,
    COMMAND_LENGTH,
    HEARTBEAT,
    INPUTS_LENGTH,
    MAX_ECHO_DELAY,
    POSITION_LENGTH,
    RPDO1,
    SYNC,
    TPDO1,
    TPDO2,
    TPDO3,
    TPDO4,
    analogue_groups,
    beat_period,
    frame,
)
from drivers.canopen.settings import FULL_SCALE, CanopenSettings

IS_SUPPORTED = sys.platform == "linux" and sys.byteorder == "little" and struct.calcsize("P") == 8
"""Whether the structures of the kernel have the layout that is compiled in."""

FRAME_SIZE = FRAME.size
BATCH = 16
"""Frames received by one system call."""
MAX_WAITING = 64
"""Max frames taken before the SYNC."""
ALL = 0b111
"""Bit mask: samples of all encoders are expected."""
OPERATIONAL_STATE = 5
"""State in a heartbeat."""
MISSED = 3.0
"""Periods without a frame after which a node is lost."""
_MAX_STEP = 5.0
"""Maximum loop periods that one tick adds to the time without frames: a stalled loop received none."""
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
        # Who continues, and where
        *fields("i8", "leads waiting"),
        ("end", "f8"),
        *fields("i8", "at count receive_error send_error"),
        # State
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
        ("states", "i8", (4,)),
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
        ("input_bits", "i8", (8,)),
        ("output_bits", "i8", (5,)),
        ("valve_centre", "f8", (3,)),
        ("valve_span", "f8"),
        *fields("f8", "zeros scales", (3,)),
        ("believable", "f8", (3, 2)),
        *fields("f8", "max_step sync_timeout beat_period max_silence max_input_gap"),
        ("max_gaps", "f8", (3,)),
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
"""All that a tick works on; `new_state` makes one.

Who continues: `leads`: compiled code may run the tick, not only Python. `waiting`: the SYNC was sent, its
answers are waited for until `end` (s). The frames from `at` to `count` of the batch are still to be taken.
`receive_error` and `send_error` (errno) are for Python to act on.

State: `time` of the tick (s); `listened`, time for which the loop has received frames (s), the clock for
detecting lost nodes: `inputs_received`, `analogue_received` (by group) and `last_heard` (by node) are on it.
`sync_time` (s) of the last SYNC; encoders (bits) that have not answered it (`awaited`) and that answered
since (`came`); `in_time`: answers received now belong to it; `owed`: late answers to earlier SYNCs that each
encoder may still send. `counts`, `sampled` (s), `seen` and `faulty` by encoder. `inputs` are the bits of the
valve node; `analogue` the values of its inputs by group, the last one ABSENT. NMT `states` of the nodes, -1
before the first heartbeat; `beaten`: time of the own heartbeat (s); `echoed`, `ahead`: `SocketcanLink.echoed`
and its clock; `applied`: the last command sent; `counters`: COUNTED, added to those of the driver when read.

Settings: values by group of analogue inputs (two of pressures, one of spools) are `group_sizes`, `zeros` (at
count 0), `scales` (per count), `believable` and `max_gaps` (s); `supply`, `chambers` and `spools` are indices
into `analogue`. An input's bit is 0 if it is not fitted."""


def new_state(
    settings: CanopenSettings, period: float, watchdog: float, counts_per_revolution: int
) -> np.ndarray[Any, Any]:
    """Return the LINK_STATE of a driver before its first frame; its address must not change."""
    state, node = new_record(LINK_STATE), settings.valve_node
    at, groups = analogue_places(settings), analogue_groups(settings)
    scale, slow = FULL_SCALE / node.full_scale, MISSED * settings.pressure_ticks * period
    pressure, spool = node.pressure_at_zero, node.spool_at_zero
    per_count = (node.pressure_at_full_scale - pressure) / FULL_SCALE
    believable = node.lowest_pressure, node.highest_pressure
    for name, value in {
        "time": -math.inf,
        "sync_time": ABSENT,
        "sampled": ABSENT,
        "analogue": INVALID,
        "analogue_received": -math.inf,
        "states": -1,
        "beaten": -math.inf,
        "nodes": (*settings.encoders.nodes, node.node),
        "counts_per_revolution": counts_per_revolution,
        "range": counts_per_revolution,
        "supply": at[node.supply_pressure],
        "chambers": [at[channel] for channel in node.chamber_pressures],
        "spools": [at[channel] for channel in node.spool_positions],
        "input_bits": [1 << bit if bit >= 0 else 0 for bit in vars(node.inputs).values()],
        "output_bits": [1 << bit for bit in vars(node.outputs).values()],
        "valve_centre": [centre * scale + 0.5 for centre in node.centre],
        "valve_span": node.span * scale,
        "zeros": (pressure, pressure, spool),
        "scales": (per_count, per_count, (node.spool_at_full_scale - spool) / FULL_SCALE),
        "believable": (believable, believable, SPOOL_RANGE),
        "max_step": _MAX_STEP * period,
        "sync_timeout": settings.sync_timeout,
        "beat_period": beat_period(watchdog),
        "max_silence": MISSED * settings.heartbeat,
        "max_input_gap": MISSED * settings.interlock_period,
        "max_gaps": (slow, slow, MISSED * period),
        "sync": words_of(frame(SYNC)),
        "beat": words_of(frame(HEARTBEAT + settings.master, bytes([OPERATIONAL_STATE]))),
    }.items():
        state[name] = value
    state["analogue"][0, NOWHERE] = ABSENT
    state["applied"]["guard_lock"] = True
    for group in groups:
        state["group_sizes"][0, group.number - 1] = len(group.channels)
    prepare(state)
    return state


def analogue_places(settings: CanopenSettings) -> dict[int, int]:
    """Return the indices into `analogue` by sub-index of 6401h; 0 is a missing sensor."""
    return {0: NOWHERE} | {
        channel: ANALOGUE_IN_ONE * (group.number - 1) + k
        for group in analogue_groups(settings)
        for k, channel in enumerate(group.channels)
    }


def warm_up(state: np.ndarray[Any, Any], readings: np.ndarray[Any, Any]) -> None:
    """Compile the functions for the driver: during the startup that would hold it, or trip a watchdog."""
    scratch = state.copy()
    begin_sync(scratch, 0.0, 0.0)
    take_frame(scratch, 0, 0)
    correct_sync_time(scratch, 0.0)
    note_missing(scratch)
    drop_overdue_analogue(scratch)
    fill(scratch, readings, 0.0, False)


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
def note_missing(states: Any) -> None:
    """Count the answers missing before the next SYNC; they may still arrive late.

    A late answer must not count as the answer to a later SYNC, so each encoder's outstanding answers are
    counted. Once it has answered again, its other outstanding answers are lost.
    """
    s = states[0]
    for joint in range(3):
        if s.awaited >> joint & 1:
            s.counters[_MISSING] += 1
            s.owed[joint] = 0 if s.came >> joint & 1 else s.owed[joint] + 1
    s.awaited = 0


@compiled
def begin_sync(states: Any, sent: float, now: float) -> None:
    """Expect the answers to the SYNC that was `sent` (s), from `now` (s) for its time-out."""
    s = states[0]
    s.counters[_SYNCS] += 1
    s.sync_time, s.awaited, s.came, s.in_time = sent, ALL, 0, 1
    s.end, s.waiting = now + s.sync_timeout, 1


@compiled
def correct_sync_time(states: Any, on_wire: float) -> None:
    """Stamp the last SYNC and its samples with the time when it was `on_wire` (s)."""
    s = states[0]
    sent, s.sync_time = s.sync_time, on_wire
    for joint in range(3):
        if s.sampled[joint] == sent:
            s.sampled[joint] = on_wire


@compiled
def _take_position(states: Any, joint: int, position: int) -> None:
    s, bit = states[0], 1 << joint
    s.came |= bit
    if s.owed[joint] != 0:  # answers keep their order: this one belongs to an earlier SYNC
        s.owed[joint] -= 1
        s.counters[_LATE] += 1
        return
    if s.awaited & bit == 0:
        s.counters[_DUPLICATES] += 1
        return
    s.awaited &= ~bit
    s.counters[_POSITIONS if s.in_time != 0 else _LATE] += 1
    # A count outside the range is passed on: the bench rejects it as implausible.
    s.counts[joint] = position % s.counts_per_revolution if position < s.range[joint] else position
    s.sampled[joint], s.seen[joint] = s.sync_time, 1


@compiled
def set_analogue(states: Any, place: int, count: int) -> None:
    """Set the analogue value at `place` from its `count`; INVALID if it is not believable."""
    s, group = states[0], place // ANALOGUE_IN_ONE
    value = s.zeros[group] + s.scales[group] * count
    believed = s.believable[group, 0] <= value <= s.believable[group, 1]
    s.analogue[place] = value if believed else INVALID


@compiled
def _take_analogue(states: Any, group: int, data: int) -> None:
    s = states[0]
    s.counters[_ANALOGUE] += 1
    s.analogue_received[group] = s.listened
    for k in range(s.group_sizes[group]):
        count = data >> 16 * k & 0xFFFF
        set_analogue(states, ANALOGUE_IN_ONE * group + k, count - (count >> 15 << 16))


@compiled
def take_frame(states: Any, first: int, data: int) -> bool:
    """Process a frame of two words (FRAME); False, and nothing done, where Python must."""
    s = states[0]
    identifier, length = first & 0xFFFFFFFF, min(first >> 32 & 0xFF, 8)
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
            s.last_heard[node], s.states[node] = s.listened, OPERATIONAL_STATE
            return True
    return False


@compiled
def _take(states: Any, k: int) -> bool:
    """Process frame `k` of the batch; False, and nothing done, where Python must."""
    s = states[0]
    if s.headers[_HEADER_WORDS * k + 7] & _SIZE_MASK != FRAME_SIZE:
        return False
    return bool(take_frame(states, s.frames[2 * k], s.frames[2 * k + 1]))


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
    note_missing(states)
    sent = monotonic_now(block + _AT_CLOCK) / 1e9
    if _send(s.descriptor, block + _AT_SYNC, FRAME_SIZE, _DONT_WAIT) < 0:
        s.send_error = _last_error()
        return False
    begin_sync(states, sent, monotonic_now(block + _AT_CLOCK) / 1e9)
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
    if sent <= s.echoed < sent + MAX_ECHO_DELAY:
        correct_sync_time(states, s.echoed)
    return True


@compiled
def _is_overdue(states: Any) -> bool:
    """Return whether a node or the interlocks are overdue."""
    s = states[0]
    silent = s.last_heard[0]
    for node in range(1, 4):
        silent = min(silent, s.last_heard[node])
    return bool(s.listened - silent > s.max_silence or s.listened - s.inputs_received > s.max_input_gap)


@compiled
def drop_overdue_analogue(states: Any) -> None:
    """Invalidate overdue analogue inputs."""
    s = states[0]
    for group in range(3):
        received = s.analogue_received[group]
        if s.listened - received > s.max_gaps[group] and received > -np.inf:
            s.analogue_received[group] = -np.inf
            for k in range(s.group_sizes[group]):
                s.analogue[ANALOGUE_IN_ONE * group + k] = INVALID


@compiled
def _position_switch(inputs: int, bit: int, has_fault: bool) -> float:
    """Return the state of a valve's position switch with the input `bit`."""
    return ABSENT if bit == 0 else INVALID if has_fault else 1.0 if inputs & bit != 0 else 0.0


@compiled
def fill(states: Any, readings: Any, time: float, has_fault: bool) -> None:
    """Write the READINGS at `time` (s); after a fault inputs keep their last values."""
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
        out.vent_open[i] = _position_switch(s.inputs, s.input_bits[5 + i], has_fault)
    out.shut_off_open = _position_switch(s.inputs, s.input_bits[7], has_fault)


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
    if not _await(states, block) or _is_overdue(states):
        return DECLINED
    s.waiting = 0
    drop_overdue_analogue(states)
    fill(states, carray(pointer(record), 1, READINGS), time, False)
    return DONE | OPERATIONAL


@compiled
def pack(states: Any, command: Any) -> None:
    """Pack the frame of `command`, already limited; absolute encoders have no index to search."""
    s, c = states[0], command[0]
    data = (
        (s.output_bits[0] if c.supply_enable else 0)
        | (s.output_bits[1] if c.exhaust_closed else 0)
        | (0 if c.guard_lock else s.output_bits[2])
        | (s.output_bits[3] if c.beacon else 0)
        | (s.output_bits[4] if c.tee else 0)
    )
    for i in range(2, -1, -1):
        data = data << 16 | int(s.valve_centre[i] + s.valve_span * c.valve[i]) & 0xFFFF
    s.command[0], s.command[1] = RPDO1 + s.nodes[3] | COMMAND_LENGTH << 32, data


@compiled_call
def write_native(block: int, command: int, applied: int, time: float) -> int:
    """Do what `CanopenDriver.write` does."""
    states = carray(pointer(block), 1, LINK_STATE)
    s = states[0]
    limited = carray(pointer(applied), 1, COMMAND)
    if s.leads == 0 or s.waiting != 0:
        return DECLINED
    limit_command(carray(pointer(command), 1, COMMAND), limited)
    pack(states, limited)
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
