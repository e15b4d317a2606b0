"""The bench's hardware on CANopen behind the driver contract.

A tick: send SYNC, receive three positions, decide, send one command. Frames have precomputed identifiers and
are received and sent in the loop's own thread; `read` waits at most `sync_timeout` for positions. The startup
(`drivers.canopen.setup`) may take some tenths of a second.

Errors are counted (`counters`) and have one of three outcomes:

- a sample is missing, late, duplicated or of the wrong length: the encoder keeps its last sample, which ages;
- an encoder reports an error: its channel is invalid until it reports the error reset;
- a node is lost, restarts, leaves the operational state, the valve node reports an error, the bus is off or
  the interface is down: the driver is no longer `operational`, `fault` gives the reason, and every further
  command is the passive one. Only `close` and `open` clear that. Inputs keep their last values.

A frame that finds the queue full is not retried: the next tick sends a new one. If that lasts, the node's own
watchdog trips.
"""

from __future__ import annotations

import errno
import math
import struct
import time as wall
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from drivers.base import (
    ABSENT,
    INVALID,
    JOINTS,
    PASSIVE,
    SPOOL_RANGE,
    Command,
    DriverError,
    Readings,
    believed,
    check_time,
    device_limited,
)
from drivers.base.native import NativeCalls
from drivers.can_bus import ERROR, FRAME
from drivers.canopen.frames import (
    COMMAND,
    COMMAND_LENGTH,
    EMERGENCY,
    EMERGENCY_LENGTH,
    HEARTBEAT,
    INPUTS_LENGTH,
    MAX_LOAD,
    NMT,
    POSITION_LENGTH,
    RPDO1,
    SDO_RESPONSE,
    SYNC,
    TPDO1,
    TPDO2,
    AnalogueGroup,
    analogue_groups,
    beat_period,
    bus_load,
    frame,
    max_rate,
)
from drivers.canopen.link import BusCounters, FrameLink, SocketcanLink, open_link, whole_frame
from drivers.canopen.native_tick import FIXED, MAX_WAITING, SHARED, NativeState, failure, words_of
from drivers.canopen.scaling import read_zero_shift
from drivers.canopen.services import Node
from drivers.canopen.settings import FULL_SCALE, CanopenSettings, ValveNodeSettings
from drivers.canopen.setup import set_up_encoder, set_up_valve_node

_START, _STOP, _ENTER_PRE_OPERATIONAL = 1, 2, 128
"""NMT commands."""
_BOOT_UP, _STOPPED, _OPERATIONAL, _PRE_OPERATIONAL = 0, 4, 5, 127
"""States in a heartbeat."""
_ALL = 0b111
"""Bit mask: samples of all encoders are expected."""
_MISSED = 3.0
"""Periods without a frame after which a node is lost."""
_MAX_STEP = 5.0
"""Maximum loop periods that one tick adds to the time without frames: a stalled loop received none."""
_MAX_NO_ROOM = 0.5
"""Share of the watchdog time for which the queue may be full before the driver reports a fault."""

_BUS_OFF, _CONTROLLER = 0x40, 0x04
"""Error classes of an error frame (linux/can/error.h); the second one explains itself in byte 1."""
_OVERFLOW, _PASSIVE_BUS = 0x03, 0x30

_VALVE_NODE = 3
"""Index of the valve node among the nodes, after the encoders."""

_Opened = Callable[[CanopenSettings, list[int]], FrameLink]


def _left_for(state: int) -> str:
    """Return the NMT state of a node that this bench has not commanded, why it is in it, and the action."""
    if state == _STOPPED:
        return (
            f"NMT state {state} (stopped): another master has commanded it; end that program or take it off "
            "the bus, then reset"
        )
    return (
        f"NMT state {state}{' (pre-operational)' if state == _PRE_OPERATIONAL else ''}: another master has "
        "commanded it, or its error behaviour (1029h); end that program or look at the node, then reset"
    )


class CanopenDriver:
    """The CANopen hardware; `counters`, `fault` and `load` are public for diagnosis."""

    def __init__(
        self,
        settings: CanopenSettings | None = None,
        *,
        period: float = 0.001,
        watchdog: float = 0.02,
        counts_per_revolution: int = 2**17,
        clock: Callable[[], float] = wall.monotonic,
        open_bus: _Opened = open_link,
    ) -> None:
        """Set the loop `period` (s) and the `watchdog` time (s) after which the valve node goes passive.

        `counts_per_revolution` is the required resolution of the encoders. `clock` only bounds waiting. Loop
        and bus use CLOCK_MONOTONIC.
        """
        self.settings = settings or CanopenSettings()
        self.period, self.watchdog = period, watchdog
        self._counters = BusCounters()
        self.fault = ""
        """Why it is not operational; empty while operational."""
        self._has_failed = False
        """A fault occurred that reopening has not cleared yet."""
        self.zero_shifts: tuple[str, str, str] = "", "", ""
        """Sources of a shift of the zero inside each encoder (`read_zero_shift`), as read by the last
        `open`."""
        self.load = bus_load(self.settings, period, watchdog)
        """Maximum bus load as a share."""
        self._applied = PASSIVE
        self._counts_per_revolution, self.clock, self._open_bus = counts_per_revolution, clock, open_bus
        self._link: FrameLink | None = None
        encoders, valve_node = self.settings.encoders, self.settings.valve_node
        self._nodes = (*encoders.nodes, valve_node.node)
        self._roles = (*(f"encoder of the {joint}" for joint in JOINTS), "valves and interlocks")
        self._range = [counts_per_revolution] * 3
        self._max_step = _MAX_STEP * period
        """Max time that one tick adds to the time without frames, s."""
        self._sync = frame(SYNC)
        self._beat = frame(HEARTBEAT + self.settings.master, bytes([_OPERATIONAL]))
        self._beat_period = beat_period(watchdog)
        self._command_identifier = RPDO1 + valve_node.node
        self._set_scales(valve_node)
        self._max_silence = _MISSED * self.settings.heartbeat
        self._max_input_gap = _MISSED * self.settings.interlock_period
        slow = _MISSED * self.settings.pressure_ticks * period
        self._max_gaps = slow, slow, _MISSED * period
        self._takers = self._make_takers()
        self._native = NativeState(self.settings)
        self._pending: deque[bytes] = deque()
        """Frames received by compiled code and not taken."""
        self._forget()

    def _set_scales(self, valve_node: ValveNodeSettings) -> None:
        """Compute bits and scales of the valve node's channels."""
        scale = FULL_SCALE / valve_node.full_scale
        self._valve_span = valve_node.span * scale
        a, b, c = (centre * scale + 0.5 for centre in valve_node.centre)
        self._valve_centre = (a, b, c)
        # In the order of the settings; a bit that is not fitted has no mask.
        self._output_bits = tuple(1 << bit for bit in vars(valve_node.outputs).values())
        self._passive_frame = self._packed(PASSIVE)
        inputs = tuple(1 << bit if bit >= 0 else 0 for bit in vars(valve_node.inputs).values())
        self._input_bits, self._vent_bits, self._shut_off_bit = inputs[:5], inputs[5:7], inputs[7]
        self._groups = analogue_groups(self.settings)
        # Per analogue group (two of pressures, one of spools): value at count 0, per count, plausible range.
        pressure, spool = valve_node.pressure_at_zero, valve_node.spool_at_zero
        self._zeros = pressure, pressure, spool
        per_count = (valve_node.pressure_at_full_scale - pressure) / FULL_SCALE
        self._scales = per_count, per_count, (valve_node.spool_at_full_scale - spool) / FULL_SCALE
        believable = valve_node.lowest_pressure, valve_node.highest_pressure
        self._believable = believable, believable, SPOOL_RANGE
        self._supply, self._chambers = valve_node.supply_pressure, valve_node.chamber_pressures
        self._spools = valve_node.spool_positions

    def _forget(self) -> None:
        """Reset everything known about the bus."""
        self._time = -math.inf
        self._counts = [0, 0, 0]
        self._sampled: list[float] = [ABSENT] * 3
        self._seen, self._faulty = [False] * 3, [False] * 3
        self._awaited = self._came = 0
        """Encoders (bits) that have not answered the last SYNC; encoders that answered since."""
        self._owed = [0, 0, 0]
        """Number of late answers to earlier SYNCs that each encoder may still send."""
        self._sync_time = ABSENT
        self._in_time = False
        """Whether answers received now belong to this tick's SYNC."""
        self._inputs = 0
        self._analogue = dict.fromkeys(self.settings.valve_node.analogue_inputs, INVALID) | {0: ABSENT}
        """Analogue inputs by sub-index; 0 where nothing is fitted."""
        self._analogue_received = [-math.inf] * len(self._groups)
        self._last_heard = [0.0] * 4
        self._listened = 0.0
        """Time for which the loop has received frames (s); the clock for detecting lost nodes."""
        self._inputs_received = 0.0
        self._states = [-1] * 4
        self._beaten = -math.inf
        self._room_since = ABSENT
        self._pending.clear()
        self._waiting_until = math.nan
        """Time-out of the answers to a SYNC that compiled code has sent, s."""
        self._receive_error = self._send_error = 0
        """Failures (errno) that compiled code has met."""
        self._answer: tuple[int, bytes] | None = None
        self._listening = False
        """Startup is complete: state and error reports of nodes are evaluated."""

    @property
    def counters(self) -> BusCounters:
        """Counters of frames and failures."""
        self._take_over()
        return self._counters

    @property
    def applied(self) -> Command:
        """Last command sent."""
        self._take_over()
        return self._applied

    @property
    def operational(self) -> bool:
        """Whether the device follows commands, as far as is known."""
        return self._link is not None and not self.fault

    # Opening and closing -------------------------------------------------------------------------

    def open(self) -> None:
        """Configure the nodes, read the settings back and start them with the passive command.

        Raises:
            DriverError: already open, bus load too high, no interface, or a node that is missing, unsuitable
                or refuses a setting; the message names the cause and the action.
        """
        if self._link is not None:
            raise DriverError("canopen driver: open() while already open; call close() first")
        self._check_load()
        self._has_failed |= bool(self.fault)
        self._forget()
        self.fault, self._applied = "", PASSIVE
        self._link = self._open_bus(self.settings, sorted(self._takers))
        try:
            self._begin()
        except OSError as error:
            self._detach()
            raise DriverError(
                f"canopen: channel {self.settings.channel!r}: {error}; check that the interface is up"
            ) from error
        except BaseException:
            self._detach()
            raise
        self._counters.recoveries += self._has_failed
        self._has_failed = False

    def _check_load(self) -> None:
        if self.load > MAX_LOAD:
            rate = int(max_rate(self.settings, self.watchdog))
            raise DriverError(
                f"canopen: bus load {self.load:.0%} at {1.0 / self.period:.0f} Hz and "
                f"{self.settings.bitrate} bit/s, expected at most {MAX_LOAD:.0%}; lower loop.rate to "
                f"{rate} Hz, raise canopen.bitrate or raise canopen.pressure_ticks"
            )

    def _begin(self) -> None:
        """Run the startup sequence."""
        nodes = [
            Node(number, role, self._put, self._next, self.clock, self.settings.sdo_timeout)
            for number, role in zip(self._nodes, self._roles, strict=True)
        ]
        for node in nodes:
            self._order(_ENTER_PRE_OPERATIONAL, node.number)
        valve_node = nodes[_VALVE_NODE]
        set_up_valve_node(valve_node, self.settings, self.watchdog)
        for joint in range(3):
            self._range[joint] = set_up_encoder(nodes[joint], self.settings, self._counts_per_revolution)
            # An error that was already present is not reported again.
            self._faulty[joint] = nodes[joint].read(0x1001, 0, "error register") != 0
        # After the settings: a device may compute its offset from them.
        shoulder, arm, wrist = (read_zero_shift(node) for node in nodes[:_VALVE_NODE])
        self.zero_shifts = shoulder, arm, wrist
        self._inputs = valve_node.read(0x6000, 1, "inputs")
        for group in self._groups:
            for channel in group.channels:
                count = valve_node.read(0x6401, channel, group.name)
                self._analogue[channel] = self._value_of(group, count - (count >> 15 << 16))
        self._analogue_received = [0.0] * len(self._groups)
        self._states = [-1] * 4
        for node in nodes:
            self._order(_START, node.number)
        self._put(self._beat)
        self._put(self._passive_frame)
        self._await_states()
        self._listening = True
        self._await_samples()
        if self.fault:
            raise DriverError(f"canopen: {self.fault}; correct the fault of that node, then restart")

    def _await_states(self) -> None:
        """Wait until every node has reported that it is operational.

        Raises:
            DriverError: a node has not within the time-out.
        """
        longest = _MISSED * self.settings.heartbeat + self.settings.sdo_timeout
        end = self.clock() + longest
        while (left := end - self.clock()) > 0.0 and any(state != _OPERATIONAL for state in self._states):
            self._next(min(left, self._beat_period))
            self._put(self._passive_frame)  # the node's watchdog starts with the first command
            self._put(self._beat)
        for number, role, state in zip(self._nodes, self._roles, self._states, strict=True):
            if state != _OPERATIONAL:
                found = "no heartbeat" if state < 0 else f"state {state} in its heartbeat"
                raise DriverError(
                    f"canopen: node {number} ({role}), heartbeat: found {found} within "
                    f"{longest:g} s after its start, expected 5 (operational); "
                    "check its display, its number and whether another master commands it"
                )

    def _await_samples(self) -> None:
        """Send one SYNC and require an answer from every encoder.

        Raises:
            DriverError: an encoder does not answer.
        """
        self._awaited, self._in_time = _ALL, True
        self._put(self._sync)
        end = self.clock() + self.settings.sdo_timeout
        while self._awaited and (left := end - self.clock()) > 0.0:
            self._next(min(left, self._beat_period))
            self._put(self._passive_frame)
        for joint in range(3):
            if self._awaited >> joint & 1:
                raise DriverError(
                    f"canopen: {self._name_of(joint)}, object "
                    f"{self.settings.encoders.position:04X}h in "
                    f"TPDO{self.settings.encoders.position_pdo - 0x17FF}: found no answer to SYNC within "
                    f"{self.settings.sdo_timeout:g} s, expected one; check that its SYNC identifier (1005h) "
                    "is 080h"
                )
        self._sampled, self._seen = [ABSENT] * 3, [False] * 3  # loop time has not started

    def close(self) -> None:
        """Make the device passive, stop its nodes and close the bus. Allowed in any state, also twice."""
        self._take_over()
        if self._link is not None:
            self.make_passive()
            with suppress(Exception):  # whatever the state of the bus
                self._order(_STOP, self._nodes[_VALVE_NODE])
                for number in self._nodes[:_VALVE_NODE]:
                    self._order(_ENTER_PRE_OPERATIONAL, number)
        self._detach()
        self._applied = PASSIVE

    def _detach(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with suppress(Exception):
                link.shutdown()

    def make_passive(self) -> None:
        """Send the passive command if the bus is open; otherwise already passive. Never raises."""
        self._take_over()
        self._applied = PASSIVE
        if self._link is not None:
            with suppress(Exception):
                self._link.send_frame(self._passive_frame)

    # The tick ------------------------------------------------------------------------------------

    def read(self, time: float) -> Readings:
        """Trigger the encoders with SYNC and return all readings at `time` (s).

        Takes up to `sync_timeout` when a sample is missing. The time stamp of a sample is the transmission
        time of its SYNC, slightly after `time`: microseconds matter for velocity and acceleration.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        self._take_over()
        link = self._link
        if link is None:
            raise DriverError("canopen driver: read() while closed; call open() first")
        check_time(time, self._time, "canopen")
        self._listened += min(time - self._time, self._max_step)
        self._time = time
        counters, clock = self._counters, self.clock
        try:
            if math.isnan(self._waiting_until):
                self._in_time = False
                for _ in range(MAX_WAITING):  # received since the last tick
                    waiting = self._receive(link, 0.0)
                    if waiting is None:
                        break
                    self._take(waiting)
                else:
                    counters.floods += 1
                if self._awaited:
                    self._note_missing()
                sent = self._send(link, self._sync)
                if not math.isnan(sent):
                    counters.syncs += 1
                    self._sync_time, self._awaited, self._came, self._in_time = sent, _ALL, 0, True
                    self._waiting_until = clock() + self.settings.sync_timeout
            if not math.isnan(self._waiting_until):
                while self._awaited and (left := self._waiting_until - clock()) > 0.0:
                    waiting = self._receive(link, left)
                    if waiting is None:
                        break
                    self._take(waiting)
                sent = self._sync_time
                if (on_wire := link.sync_time(sent)) != sent:
                    self._sync_time = on_wire
                    for joint in range(3):
                        if self._sampled[joint] == sent:
                            self._sampled[joint] = on_wire
        except OSError as error:
            counters.receive_failures += 1
            self._note_fault(f"receiving failed: {error}")
        self._waiting_until = math.nan
        self._supervise()
        return self._readings(time)

    def write(self, command: Command) -> Command:
        """Send `command` within the device's limits; return the applied one, PASSIVE if not operational.

        Raises:
            DriverError: not open.
        """
        self._take_over()
        link = self._link
        if link is None:
            raise DriverError("canopen driver: write() while closed; call open() first")
        applied = PASSIVE if self.fault else device_limited(command)
        if self._time - self._beaten >= self._beat_period:
            self._beaten = self._time
            self._send(link, self._beat)
        sent = self._send(link, self._passive_frame if applied is PASSIVE else self._packed(applied))
        if not math.isnan(sent):
            self._applied, self._room_since = applied, ABSENT
        elif math.isnan(self._room_since):
            self._room_since = self._time
        elif self._time - self._room_since > _MAX_NO_ROOM * self.watchdog:
            self._note_fault("the interface's transmit queue is full")
        self._hand_over(link)
        return PASSIVE if self.fault else self._applied

    def _packed(self, command: Command) -> bytes:
        """Return the frame of `command`, already limited."""
        (a, b, c), supply, closed, lock, beacon, tee = command[
            :6
        ]  # absolute encoders have no index to search
        first, second, third = self._valve_centre
        span, bits = self._valve_span, self._output_bits
        return COMMAND.pack(
            self._command_identifier,
            COMMAND_LENGTH,
            int(first + span * a),
            int(second + span * b),
            int(third + span * c),
            (bits[0] if supply else 0)
            | (bits[1] if closed else 0)
            | (0 if lock else bits[2])
            | (bits[3] if beacon else 0)
            | (bits[4] if tee else 0),
        )

    def _send(self, link: FrameLink, whole: bytes) -> float:
        """Send a frame; return the send time (s), NaN on failure."""
        try:
            if self._send_error:
                number, self._send_error = self._send_error, 0
                raise failure(number)
            return link.send_frame(whole)
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                self._counters.no_room += 1
            else:
                self._counters.send_failures += 1
                self._note_fault(f"sending failed: {error}")
            return math.nan

    def _receive(self, link: FrameLink, timeout: float) -> bytes | None:
        """Return the next frame, or None after `timeout` s; OSError on failure."""
        if self._pending:
            return whole_frame(self._pending.popleft())
        if self._receive_error:
            number, self._receive_error = self._receive_error, 0
            raise failure(number)
        return link.receive_frame(timeout)

    def _readings(self, time: float) -> Readings:
        inputs, bits, analogue = self._inputs, self._input_bits, self._analogue
        seen, faulty = self._seen, self._faulty
        a, b, c = self._sampled
        one, two = self._vent_bits
        p1, p2, p3, p4, p5, p6 = self._chambers
        s1, s2, s3 = self._spools
        return Readings(
            time,
            (self._counts[0], self._counts[1], self._counts[2]),
            (a, b, c),
            (seen[0] and not faulty[0], seen[1] and not faulty[1], seen[2] and not faulty[2]),
            (time - a, time - b, time - c),
            inputs & bits[0] != 0,
            inputs & bits[1] != 0,
            inputs & bits[2] != 0,
            analogue[self._supply],
            inputs & bits[3] != 0,
            inputs & bits[4] != 0,
            (analogue[p1], analogue[p2], analogue[p3], analogue[p4], analogue[p5], analogue[p6]),
            vent_open=(self._valve_position(one), self._valve_position(two)),
            shut_off_open=self._valve_position(self._shut_off_bit),
            spool_position=(analogue[s1], analogue[s2], analogue[s3]),
        )

    def _valve_position(self, mask: int) -> float:
        """Return the state of the position switch with the input `mask`; inputs keep their last values."""
        if not mask:
            return ABSENT
        return INVALID if self.fault else float(self._inputs & mask != 0)

    # Received frames -----------------------------------------------------------------------------

    def _make_takers(self) -> dict[int, Callable[[bytes], None]]:
        """Return the handler of each identifier; each counts its frame."""
        takers: dict[int, Callable[[bytes], None]] = {}
        for joint, number in enumerate(self.settings.encoders.nodes):
            takers[TPDO2 + number] = partial(self._take_position, joint)
        for index, number in enumerate(self._nodes):
            takers[HEARTBEAT + number] = partial(self._take_heartbeat, index)
            takers[EMERGENCY + number] = partial(self._take_emergency, index)
            takers[SDO_RESPONSE + number] = partial(self._take_answer, number)
        node = self.settings.valve_node
        takers[TPDO1 + node.node] = self._take_inputs
        for n, group in enumerate(self._groups):
            packed = struct.Struct(f"<{len(group.channels)}h")
            takers[group.base + node.node] = partial(self._take_analogue, n, group, packed)
        return takers

    def _take(self, whole: bytes) -> None:
        """Process one received frame."""
        counters = self._counters
        counters.frames += 1
        identifier, length, data = FRAME.unpack(whole)
        taker = self._takers.get(identifier)  # identifiers with flags are foreign
        if taker is not None:
            taker(data[:length])
        elif identifier & ERROR:
            self._take_error(identifier, data)
        else:
            counters.foreign += 1

    def _note_missing(self) -> None:
        """Count the answers missing before the next SYNC; they may still arrive late.

        A late answer must not count as the answer to a later SYNC, so each encoder's outstanding answers are
        counted. Once it has answered again, its other outstanding answers are lost.
        """
        for joint in range(3):
            if self._awaited >> joint & 1:
                self._counters.missing += 1
                self._owed[joint] = 0 if self._came >> joint & 1 else self._owed[joint] + 1
        self._awaited = 0

    def _take_position(self, joint: int, data: bytes) -> None:
        counters, bit = self._counters, 1 << joint
        if len(data) != POSITION_LENGTH:
            counters.wrong_length += 1
            return
        self._came |= bit
        if self._owed[joint]:  # answers keep their order: this one belongs to an earlier SYNC
            self._owed[joint] -= 1
            counters.late += 1
            return
        if not self._awaited & bit:
            counters.duplicates += 1
            return
        self._awaited &= ~bit
        if self._in_time:
            counters.positions += 1
        else:
            counters.late += 1
        position = int.from_bytes(data, "little")
        # A count outside the range is passed on: the bench rejects it as implausible.
        self._counts[joint] = (
            position % self._counts_per_revolution if position < self._range[joint] else position
        )
        self._sampled[joint], self._seen[joint] = self._sync_time, True

    def _take_inputs(self, data: bytes) -> None:
        if len(data) != INPUTS_LENGTH:
            self._counters.wrong_length += 1
            return
        self._counters.inputs += 1
        self._inputs, self._inputs_received = data[0], self._listened

    def _take_analogue(self, n: int, group: AnalogueGroup, packed: struct.Struct, data: bytes) -> None:
        if len(data) != packed.size:
            self._counters.wrong_length += 1
            return
        self._counters.analogue += 1
        self._analogue_received[n] = self._listened
        for channel, count in zip(group.channels, packed.unpack(data), strict=True):
            self._analogue[channel] = self._value_of(group, count)

    def _value_of(self, group: AnalogueGroup, count: int) -> float:
        """Return the value of a `count` in `group`, Pa absolute or share; INVALID if it is not believable."""
        k = group.number - 1
        return believed(self._zeros[k] + self._scales[k] * count, *self._believable[k])

    def _take_heartbeat(self, index: int, data: bytes) -> None:
        if len(data) != 1:
            self._counters.wrong_length += 1
            return
        state = data[0] & 0x7F
        self._last_heard[index], self._states[index] = self._listened, state
        who = self._name_of(index)
        if state == _BOOT_UP:
            self._counters.boot_ups += 1
            self._note_fault(
                f"{who} has restarted: its supply failed, or another master has reset it; check both, then "
                "reset"
            )
        else:
            self._counters.heartbeats += 1
            if state != _OPERATIONAL:
                self._note_fault(f"{who} has left the operational state for {_left_for(state)}")

    def _take_emergency(self, index: int, data: bytes) -> None:
        if len(data) != EMERGENCY_LENGTH:
            self._counters.wrong_length += 1
            return
        self._counters.emergencies += 1
        code = data[0] | data[1] << 8
        if index < _VALVE_NODE:
            self._faulty[index] = code != 0
        elif code:
            who = self._name_of(index)
            self._note_fault(f"{who} reports error {code:04X}h, register {data[2]:02X}h")

    def _take_answer(self, number: int, data: bytes) -> None:
        self._counters.services += 1
        self._answer = SDO_RESPONSE + number, data

    def _take_error(self, identifier: int, data: bytes) -> None:
        """Process an error frame of the interface (linux/can/error.h)."""
        counters = self._counters
        counters.error_frames += 1
        if identifier & _BUS_OFF:
            counters.bus_off += 1
            self._note_fault("the controller is bus-off: check wiring, terminators and bit rates")
        if identifier & _CONTROLLER:
            counters.overruns += bool(data[1] & _OVERFLOW)
            counters.error_passive += bool(data[1] & _PASSIVE_BUS)

    def _name_of(self, index: int) -> str:
        return f"node {self._nodes[index]} ({self._roles[index]})"

    def _note_fault(self, text: str) -> None:
        """Ignore commands from now on; keep the first reason."""
        if self._listening:
            self.fault = self.fault or text

    def _supervise(self) -> None:
        """Detect nodes and inputs that have been silent too long."""
        now = self._listened
        if now - min(self._last_heard) > self._max_silence:
            index = self._last_heard.index(min(self._last_heard))
            who = self._name_of(index)
            self._note_fault(f"{who} has sent no heartbeat for {self._max_silence:g} s")
        if now - self._inputs_received > self._max_input_gap:
            self._note_fault("the interlocks have not been received for three of their periods")
        for n, (group, received) in enumerate(zip(self._groups, self._analogue_received, strict=True)):
            if now - received > self._max_gaps[group.number - 1] and received > -math.inf:
                self._analogue_received[n] = -math.inf
                for channel in group.channels:
                    self._analogue[channel] = INVALID

    # Ticks in compiled code ----------------------------------------------------------------------

    def native_calls(self) -> NativeCalls:
        """Return the native functions; they decline on anything but a raw SocketCAN socket."""
        return self._native.calls()

    def _hand_over(self, link: FrameLink) -> None:
        """Let compiled code run the next ticks if it can."""
        if (
            not (self._native.is_wanted and isinstance(link, SocketcanLink) and self._listening)
            or (self.fault or self._pending or self._receive_error or self._send_error)
            or not math.isnan(self._room_since)
            or self.clock is not wall.monotonic
        ):
            return
        values = {name: getattr(self, f"_{name}") for name in (*SHARED, *FIXED)}
        values |= {"sync": words_of(self._sync), "beat": words_of(self._beat), "applied": self._applied}
        values |= {"descriptor": link.descriptor, "echoed": link.echoed, "ahead": link.wall.ns}
        values["sync_timeout"] = self.settings.sync_timeout
        self._native.store(values, self._analogue, self._analogue_received)

    def _take_over(self) -> None:
        """Continue in Python from the state of compiled code, if that is the newest."""
        if not self._native.leads[0]:
            return
        values = self._native.load()
        for name in SHARED:
            setattr(self, f"_{name}", values[name])
        self._analogue |= values["analogue"]
        self._analogue_received, self._applied = values["analogue_received"], values["applied"]
        for name, count in values["counters"].items():
            setattr(self._counters, name, getattr(self._counters, name) + count)
        self._waiting_until = values["end"] if values["waiting"] else math.nan
        self._pending.extend(values["pending"])
        self._receive_error, self._send_error = values["receive_error"], values["send_error"]
        if isinstance(self._link, SocketcanLink):
            self._link.echoed, self._link.wall.ns = values["echoed"], values["ahead"]

    # Bus access during startup -------------------------------------------------------------------

    def _put(self, whole: bytes) -> None:
        """Send a frame; OSError on failure."""
        if self._link is not None:
            self._link.send_frame(whole)

    def _order(self, command: int, number: int) -> None:
        self._put(frame(NMT, bytes([command, number])))

    def _next(self, timeout: float) -> tuple[int, bytes] | None:
        """Process the next frame; return it if it is an SDO response."""
        whole = None if self._link is None else self._link.receive_frame(timeout)
        self._answer = None
        if whole is not None:
            self._take(whole)
        return self._answer
