"""The bench's hardware on CANopen behind the driver contract.

A tick: send SYNC, receive three positions, decide, send one command. Frames have precomputed identifiers and
are received and sent in the loop's own thread; `read` waits at most `sync_timeout` for positions. The startup
(`drivers.canopen._setup`) may take some tenths of a second.

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
import time as wall
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from drivers.base import (
    JOINTS,
    PASSIVE,
    Command,
    DriverError,
    Readings,
    check_open,
    check_time,
    device_limited,
)
from drivers.base.compiled import IS_PLAIN, new_record, numbers
from drivers.base.native import NativeCall, NativeCalls
from drivers.base.records import COMMAND, READINGS, pack_command, unpack_command, unpack_readings
from drivers.can_bus import ERROR, FRAME
from drivers.canopen._link import BusCounters, FrameLink, SocketcanLink, open_link, whole_frame
from drivers.canopen._native_tick import (
    ALL,
    COUNTED,
    IS_SUPPORTED,
    MAX_WAITING,
    MISSED,
    OPERATIONAL_STATE,
    analogue_places,
    begin_sync,
    correct_sync_time,
    drop_overdue_analogue,
    failure,
    fill,
    left_over,
    new_state,
    note_missing,
    pack,
    read_native,
    set_analogue,
    take_frame,
    warm_up,
    words_of,
    write_native,
)
from drivers.canopen._scaling import read_zero_shift
from drivers.canopen._services import Node
from drivers.canopen._setup import set_up_encoder, set_up_valve_node
from drivers.canopen.frames import (
    EMERGENCY,
    EMERGENCY_LENGTH,
    HEARTBEAT,
    MAX_LOAD,
    NMT,
    SDO_RESPONSE,
    TPDO1,
    TPDO2,
    analogue_groups,
    beat_period,
    bus_load,
    frame,
    max_rate,
)
from drivers.canopen.settings import CanopenSettings

_START, _STOP, _ENTER_PRE_OPERATIONAL = 1, 2, 128
"""NMT commands."""
_BOOT_UP, _STOPPED, _PRE_OPERATIONAL = 0, 4, 127
"""States in a heartbeat."""
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
        self.clock, self._open_bus = clock, open_bus
        self._counts_per_revolution = counts_per_revolution
        self._link: FrameLink | None = None
        self._nodes = (*self.settings.encoders.nodes, self.settings.valve_node.node)
        self._roles = (*(f"encoder of the {joint}" for joint in JOINTS), "valves and interlocks")
        self._state = s = new_state(self.settings, period, watchdog, counts_per_revolution)
        self._pristine = s.copy()
        self._readings, self._command = new_record(READINGS), new_record(COMMAND)
        self._leads, self._waiting, self._awaited = (
            numbers(s[name]) for name in ("leads", "waiting", "awaited")
        )
        self._time, self._listened, self._end, self._beaten = (
            numbers(s[name]) for name in ("time", "listened", "end", "beaten")
        )
        self._sync, self._beat = s["sync"].tobytes(), s["beat"].tobytes()
        self._beat_period = beat_period(watchdog)
        self._passive_frame = self._packed(PASSIVE)
        self._takers = self._make_takers()
        self._is_native = False
        """Whether the native functions were requested."""
        self._pending: deque[bytes] = deque()
        """Frames received by compiled code and not taken."""
        self._forget()

    def _forget(self) -> None:
        """Reset everything known about the bus."""
        self._add_counts()
        self._state[:] = self._pristine
        self._room_since = math.nan
        self._pending.clear()
        self._answer: tuple[int, bytes] | None = None
        self._listening = False
        """Startup is complete: state and error reports of nodes are evaluated."""

    @property
    def counters(self) -> BusCounters:
        """Counters of frames and failures."""
        self._add_counts()
        return self._counters

    def _add_counts(self) -> None:
        """Move the record's counts into the counters."""
        counters, counted = self._counters, self._state["counters"]
        for name, count in zip(COUNTED, counted[0].tolist(), strict=True):
            setattr(counters, name, getattr(counters, name) + count)
        counted[:] = 0

    @property
    def applied(self) -> Command:
        """Last command sent."""
        return unpack_command(self._state["applied"])

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
        self.fault = ""
        warm_up(self._state, self._readings)
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
            self._state["range"][0, joint] = set_up_encoder(
                nodes[joint], self.settings, self._counts_per_revolution
            )
            # An error that was already present is not reported again.
            self._state["faulty"][0, joint] = nodes[joint].read(0x1001, 0, "error register") != 0
        # After the settings: a device may compute its offset from them.
        shoulder, arm, wrist = (read_zero_shift(node) for node in nodes[:_VALVE_NODE])
        self.zero_shifts = shoulder, arm, wrist
        self._state["inputs"] = valve_node.read(0x6000, 1, "inputs") & 0xFF
        places = analogue_places(self.settings)
        for group in analogue_groups(self.settings):
            for channel in group.channels:
                count = valve_node.read(0x6401, channel, group.name)
                set_analogue(self._state, places[channel], count - (count >> 15 << 16))
        self._state["analogue_received"] = 0.0
        self._state["states"] = -1
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
        longest = MISSED * self.settings.heartbeat + self.settings.sdo_timeout
        end = self.clock() + longest
        while (left := end - self.clock()) > 0.0 and (self._state["states"] != OPERATIONAL_STATE).any():
            self._next(min(left, self._beat_period))
            self._put(self._passive_frame)  # the node's watchdog starts with the first command
            self._put(self._beat)
        for number, role, state in zip(self._nodes, self._roles, self._state["states"][0], strict=True):
            if state != OPERATIONAL_STATE:
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
        self._awaited[0], self._state["in_time"] = ALL, 1
        self._put(self._sync)
        end = self.clock() + self.settings.sdo_timeout
        while self._awaited[0] and (left := end - self.clock()) > 0.0:
            self._next(min(left, self._beat_period))
            self._put(self._passive_frame)
        for joint in range(3):
            if self._awaited[0] >> joint & 1:
                raise DriverError(
                    f"canopen: {self._name_of(joint)}, object "
                    f"{self.settings.encoders.position:04X}h in "
                    f"TPDO{self.settings.encoders.position_pdo - 0x17FF}: found no answer to SYNC within "
                    f"{self.settings.sdo_timeout:g} s, expected one; check that its SYNC identifier (1005h) "
                    "is 080h"
                )
        self._state["sampled"], self._state["seen"] = math.nan, 0  # loop time has not started

    def close(self) -> None:
        """Make the device passive, stop its nodes and close the bus. Allowed in any state, also twice."""
        self.make_passive()
        if self._link is not None:
            with suppress(Exception):  # whatever the state of the bus
                self._order(_STOP, self._nodes[_VALVE_NODE])
                for number in self._nodes[:_VALVE_NODE]:
                    self._order(_ENTER_PRE_OPERATIONAL, number)
        self._detach()

    def _detach(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            with suppress(Exception):
                link.shutdown()

    def make_passive(self) -> None:
        """Send the passive command if the bus is open; otherwise already passive. Never raises."""
        self._take_over()
        pack_command(PASSIVE, self._state["applied"])
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
        link = self._opened("read")
        check_time(time, self._time[0], "canopen")
        state, counters, clock = self._state, self._counters, self.clock
        self._listened[0] += min(time - self._time[0], state["max_step"][0])
        self._time[0] = time
        try:
            if not self._waiting[0]:
                state["in_time"] = 0
                for _ in range(MAX_WAITING):  # received since the last tick
                    whole = self._receive(link, 0.0)
                    if whole is None:
                        break
                    self._take(whole)
                else:
                    counters.floods += 1
                note_missing(state)
                sent = self._send(link, self._sync)
                if not math.isnan(sent):
                    begin_sync(state, sent, clock())
            if self._waiting[0]:
                while self._awaited[0] and (left := self._end[0] - clock()) > 0.0:
                    whole = self._receive(link, left)
                    if whole is None:
                        break
                    self._take(whole)
                correct_sync_time(state, link.sync_time(float(state["sync_time"][0])))
        except OSError as error:
            counters.receive_failures += 1
            self._note_fault(f"receiving failed: {error}")
        self._waiting[0] = 0
        self._supervise()
        fill(state, self._readings, time, bool(self.fault))
        return unpack_readings(self._readings)

    def write(self, command: Command) -> Command:
        """Send `command` within the device's limits; return the applied one, PASSIVE if not operational.

        Raises:
            DriverError: not open.
        """
        link = self._opened("write")
        applied = PASSIVE if self.fault else device_limited(command)
        now = self._time[0]
        if now - self._beaten[0] >= self._beat_period:
            self._state["beaten"] = now
            self._send(link, self._beat)
        sent = self._send(link, self._passive_frame if applied is PASSIVE else self._packed(applied))
        if not math.isnan(sent):
            pack_command(applied, self._state["applied"])
            self._room_since = math.nan
        elif math.isnan(self._room_since):
            self._room_since = now
        elif now - self._room_since > _MAX_NO_ROOM * self.watchdog:
            self._note_fault("the interface's transmit queue is full")
        self._hand_over(link)
        return PASSIVE if self.fault else self.applied

    def _opened(self, call: str) -> FrameLink:
        """Continue in Python; return the link, DriverError without one."""
        self._take_over()
        check_open(self._link is not None, "canopen", call)
        return self._link  # type: ignore[return-value]

    def _packed(self, command: Command) -> bytes:
        """Return the frame of `command`, already limited."""
        pack_command(command, self._command)
        pack(self._state, self._command)
        return self._state["command"].tobytes()

    def _send(self, link: FrameLink, whole: bytes) -> float:
        """Send a frame; return the send time (s), NaN on failure."""
        try:
            self._raise_failure("send_error")
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
        self._raise_failure("receive_error")
        return link.receive_frame(timeout)

    def _raise_failure(self, name: str) -> None:
        """Raise OSError if compiled code has met a failure."""
        if number := int(self._state[name][0]):
            self._state[name] = 0
            raise failure(number)

    # Received frames -----------------------------------------------------------------------------

    def _make_takers(self) -> dict[int, Callable[[bytes], None]]:
        """Return the handler of each identifier; each counts its frame."""
        takers: dict[int, Callable[[bytes], None]] = {}
        valve_node = self.settings.valve_node.node
        taken = [TPDO2 + number for number in self.settings.encoders.nodes]
        taken += [group.base + valve_node for group in analogue_groups(self.settings)]
        for identifier in (*taken, TPDO1 + valve_node):
            takers[identifier] = self._note_wrong_length  # else `take_frame` has processed it
        for index, number in enumerate(self._nodes):
            takers[HEARTBEAT + number] = partial(self._take_heartbeat, index)
            takers[EMERGENCY + number] = partial(self._take_emergency, index)
            takers[SDO_RESPONSE + number] = partial(self._take_answer, number)
        return takers

    def _take(self, whole: bytes) -> None:
        """Process one received frame."""
        if take_frame(self._state, *words_of(whole)):
            return
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

    def _note_wrong_length(self, _: bytes = b"") -> None:
        self._counters.wrong_length += 1

    def _take_heartbeat(self, index: int, data: bytes) -> None:
        if len(data) != 1:
            self._note_wrong_length()
            return
        state = data[0] & 0x7F
        self._state["last_heard"][0, index], self._state["states"][0, index] = self._listened[0], state
        who = self._name_of(index)
        if state == _BOOT_UP:
            self._counters.boot_ups += 1
            self._note_fault(
                f"{who} has restarted: its supply failed, or another master has reset it; check both, then "
                "reset"
            )
        else:
            self._counters.heartbeats += 1
            self._note_fault(f"{who} has left the operational state for {_left_for(state)}")

    def _take_emergency(self, index: int, data: bytes) -> None:
        if len(data) != EMERGENCY_LENGTH:
            self._note_wrong_length()
            return
        self._counters.emergencies += 1
        code = data[0] | data[1] << 8
        if index < _VALVE_NODE:
            self._state["faulty"][0, index] = code != 0
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
        now, state = self._listened[0], self._state
        heard, longest = state["last_heard"][0].tolist(), state["max_silence"][0]
        if now - min(heard) > longest:
            who = self._name_of(heard.index(min(heard)))
            self._note_fault(f"{who} has sent no heartbeat for {longest:g} s")
        if now - state["inputs_received"][0] > state["max_input_gap"][0]:
            self._note_fault("the interlocks have not been received for three of their periods")
        drop_overdue_analogue(state)

    # Ticks in compiled code ----------------------------------------------------------------------

    def native_calls(self) -> NativeCalls:
        """Return the native functions; none on a system with another layout of kernel structures.

        They decline on anything but a raw SocketCAN socket.
        """
        self._is_native = IS_SUPPORTED and not IS_PLAIN
        if not self._is_native:
            return NativeCalls()
        block = self._state.ctypes.data
        return NativeCalls(NativeCall(read_native.address, block), NativeCall(write_native.address, block))

    def _hand_over(self, link: FrameLink) -> None:
        """Let compiled code run the next ticks if it can."""
        state = self._state
        if (
            not (self._is_native and isinstance(link, SocketcanLink) and self._listening)
            or (self.fault or self._pending or state["receive_error"][0] or state["send_error"][0])
            or not math.isnan(self._room_since)
            or self.clock is not wall.monotonic
        ):
            return
        state["descriptor"], state["echoed"], state["ahead"] = link.descriptor, link.echoed, link.wall.ns
        self._leads[0] = 1

    def _take_over(self) -> None:
        """Continue in Python where compiled code has stopped."""
        if not self._leads[0]:
            return
        self._leads[0] = 0
        self._pending.extend(left_over(self._state))
        if isinstance(self._link, SocketcanLink):
            self._link.echoed = float(self._state["echoed"][0])
            self._link.wall.ns = int(self._state["ahead"][0])

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
