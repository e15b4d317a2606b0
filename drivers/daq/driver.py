"""The bench's hardware on a data-acquisition card behind the driver contract.

Three counters read the quadrature encoders, which count from power-up until their index has passed. They are
preset to PRESET, far from any count of the travel, and the index resets them to 0: so the count itself shows
whether it is absolute. Three analogue outputs drive the valves; a command is written in the tick in which it
is decided. Digital lines carry interlocks, air and tee.

The card's watchdog centres the valves and sets every line low when commands stop; `open` reads its settings
back and lets it trip once. A card without a watchdog is refused unless an external relay is configured. The
watchdog starts with the first command. 0 V is full stroke and never used as a safe value: closing writes the
centre first, or waits for the watchdog if that fails.

A counter that does not answer keeps its last sample, which ages. After an input or output error, or a tripped
watchdog, the driver is no longer `operational`, `fault` gives the reason, and the watchdog is no longer
fed. A broken wire between encoder and card cannot be detected here.
"""

from __future__ import annotations

import math
import time as wall
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

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
    check_open,
    check_time,
    device_limited,
)
from drivers.daq.settings import DaqSettings
from drivers.daq.watchdog import CardWatchdog, error_text, load_nidaqmx

PRESET = 1 << 30
"""Initial count of the counters; the index resets them to 0."""
FULL_SCALE = 10.0
"""Range of the analogue channels, V."""
_WRAP = 1 << 32


class DaqDriver:
    """The hardware on a card; `fault`, `missing` and `hardware_timed` are public for diagnosis."""

    def __init__(
        self,
        settings: DaqSettings | None = None,
        *,
        period: float = 0.001,
        watchdog: float = 0.02,
        counts_per_revolution: int = 2**17,
        clock: Callable[[], float] = wall.monotonic,
        sleep: Callable[[float], None] = wall.sleep,
    ) -> None:
        """Set the loop `period` (s) and the `watchdog` time (s) after which the card goes passive.

        `counts_per_revolution` of the encoders is four times their number of lines.

        Raises:
            DriverError: `counts_per_revolution` is not a multiple of four.
        """
        if counts_per_revolution % 4 or not 4 <= counts_per_revolution < PRESET // 4:
            raise DriverError(
                f"daq: {counts_per_revolution} counts per revolution, expected a multiple of four below "
                f"{PRESET // 4}: quadrature counts each line four times; correct "
                "plant.encoders.counts_per_revolution"
            )
        self.settings = settings or DaqSettings()
        self.period, self.watchdog = period, watchdog
        self.clock, self._sleep, self._counts = clock, sleep, counts_per_revolution
        self.fault = ""
        """Why it is not operational; empty while operational."""
        self.missing = 0
        """Number of missing samples."""
        self.hardware_timed = False
        """Whether one edge latches all counters."""
        self.applied = PASSIVE
        """Last command written."""
        self._tasks: list[Any] = []
        self._watchdog: CardWatchdog | None = None
        self._is_open = False
        self._daq: Any = None
        self._forget()

    def _forget(self) -> None:
        """Clear the stored state of the card."""
        s = self.settings
        self._time = -math.inf
        self._count, self._indexed = [0, 0, 0], [False] * 3
        self._sampled: list[float] = [ABSENT] * 3
        self._ticks = 0
        self._inputs = np.zeros(len(s.input_lines), bool)
        self._voltages = np.full(len(s.analogue_inputs), np.nan)
        self._volts = np.array(s.centre)
        self._lines = np.zeros(len(s.output_lines), bool)
        self._has_spools = any(s.spool_positions)
        own = len(vars(s.outputs))
        self._sync = own if s.sync_line else -1
        self._beat = own + bool(s.sync_line) if s.watchdog_line else -1
        self.hardware_timed, self.fault, self.applied = False, "", PASSIVE

    @property
    def operational(self) -> bool:
        """Whether the device follows commands, as far as is known."""
        return self._is_open and not self.fault

    # Opening and closing -------------------------------------------------------------------------

    def open(self) -> None:
        """Find the card, test its watchdog, set all outputs passive, read all inputs once.

        Raises:
            DriverError: already open, package or NI driver missing, card not found or unsuitable; the message
                names the cause and the action.
        """
        if self._is_open:
            raise DriverError("daq driver: open() while already open; call close() first")
        self._daq = load_nidaqmx()
        self._forget()
        try:
            device = self._find_device()
            self._prove_watchdog()
            self._make_outputs()
            self._make_inputs(device)
            self._first_reading()
        except BaseException as error:
            self._detach()
            if isinstance(error, self._daq.errors.Error):
                raise DriverError(
                    f"daq: {self.settings.device}: {error_text(error)}; check the channels in [daq]"
                ) from error
            raise
        self._is_open = True

    def _find_device(self) -> Any:
        """Return the card.

        Raises:
            DriverError: NI's driver or the card is missing, or its serial number differs.
        """
        errors, s = self._daq.errors, self.settings
        try:
            devices = self._daq.system.System.local().devices
            names = list(devices.device_names)
        except (errors.DaqNotFoundError, errors.DaqNotSupportedError) as error:
            raise DriverError(
                f"daq driver: found no NI-DAQmx driver on this machine ({error_text(error)}); "
                "install it from ni.com/downloads (in addition to the Python package)"
            ) from error
        if s.device not in names:
            known = ", ".join(names) or "none"
            raise DriverError(
                f"daq: found the devices {known}, expected {s.device}; correct daq.device, or check NI MAX"
            )
        device = devices[s.device]
        if s.serial not in (0, device.serial_num):
            raise DriverError(
                f"daq: {s.device}: found serial number {device.serial_num}, expected {s.serial}; "
                "correct daq.device or daq.serial"
            )
        return device

    def _full(self, channel: str) -> str:
        return f"{self.settings.device}/{channel}"

    def _prove_watchdog(self) -> None:
        """Set up the card's watchdog and let it trip once.

        Raises:
            DriverError: the card has no watchdog that centres the valves, and no relay is configured.
        """
        s = self.settings
        valves = [(self._full(channel), centre) for channel, centre in zip(s.valves, s.centre, strict=True)]
        try:
            self._watchdog = CardWatchdog(
                self._daq, s.device, self.watchdog, valves, [self._full(line) for line in s.output_lines]
            )
            self._watchdog.prove(self.clock, self._sleep)
        except (self._daq.errors.Error, DriverError) as error:
            watchdog, self._watchdog = self._watchdog, None
            if watchdog is not None:
                watchdog.close()
            if s.watchdog_relay:
                return
            raise DriverError(
                f"daq: {s.device}: found no watchdog that centres the valves ({error_text(error)}): "
                "0 V is full stroke; use a card with fallback voltages, or fit an external watchdog relay "
                "and name it in daq.watchdog_relay"
            ) from error

    def _task(self) -> Any:
        task = self._daq.Task()
        self._tasks.append(task)
        return task

    def _make_outputs(self) -> None:
        writers, s = self._daq.stream_writers, self.settings
        valves = self._task()
        for channel in s.valves:
            valves.ao_channels.add_ao_voltage_chan(self._full(channel), min_val=0.0, max_val=FULL_SCALE)
        self._valves = writers.AnalogMultiChannelWriter(valves.out_stream, auto_start=False)
        lines = self._task()
        for line in s.output_lines:
            lines.do_channels.add_do_chan(self._full(line))
        self._outputs = writers.DigitalMultiChannelWriter(lines.out_stream, auto_start=False)
        for task in (valves, lines):
            task.start()
        self._write(PASSIVE)  # checks the shapes once, with the passive command
        self._valves.verify_array_shape = self._outputs.verify_array_shape = False

    def _make_inputs(self, device: Any) -> None:
        readers, s = self._daq.stream_readers, self.settings
        single_point = self._daq.constants.AcquisitionType.HW_TIMED_SINGLE_POINT
        self.hardware_timed = bool(
            s.sync_line and device.ci_samp_clk_supported and single_point in device.ci_samp_modes
        )
        phase = "A" + s.index_phase.upper().replace(" ", "_B")
        self._counters, self._counter_tasks = [], []
        for counter in s.counters:
            task = self._task()
            self._counter_tasks.append(task)
            task.ci_channels.add_ci_ang_encoder_chan(
                self._full(counter),
                decoding_type=self._daq.constants.EncoderType.X_4,
                zidx_enable=True,
                zidx_val=0.0,
                zidx_phase=self._daq.constants.EncoderZIndexPhase[phase],
                units=self._daq.constants.AngleUnits.TICKS,
                pulses_per_rev=self._counts // 4,
                initial_angle=float(PRESET),
            )
            if self.hardware_timed:
                task.timing.cfg_samp_clk_timing(
                    1.0 / self.period, source=f"/{self._full(s.sync_terminal)}", sample_mode=single_point
                )
            task.start()
            self._counters.append(readers.CounterReader(task.in_stream))
        lines = self._task()
        for line in s.input_lines:
            lines.di_channels.add_di_chan(self._full(line))
        lines.start()
        self._interlocks = readers.DigitalMultiChannelReader(lines.in_stream)
        self._analogue = None
        if s.analogue_inputs:
            voltages = self._task()
            for channel in s.analogue_inputs:
                voltages.ai_channels.add_ai_voltage_chan(self._full(channel), min_val=0.0, max_val=FULL_SCALE)
            voltages.start()
            self._analogue = readers.AnalogMultiChannelReader(voltages.in_stream)

    def _first_reading(self) -> None:
        """Read every input once.

        Raises:
            DriverError: a counter does not answer.
        """
        self._read_inputs()
        self._read_voltages()
        self._interlocks.verify_array_shape = False
        if self._analogue is not None:
            self._analogue.verify_array_shape = False
        self._read_counters(0.0)
        for joint, sampled in enumerate(self._sampled):
            if math.isnan(sampled):
                cause = " after an edge at the sync line; check its wire" if self.hardware_timed else ""
                raise DriverError(
                    f"daq: {self._full(self.settings.counters[joint])} (encoder of the {JOINTS[joint]}): "
                    f"found no count{cause}; check the counter in NI MAX"
                )
        self._sampled = [ABSENT] * 3  # loop time has not started

    def close(self) -> None:
        """Make the outputs passive and release the card. Allowed in any state, also twice."""
        self._detach()
        self._is_open = False
        self.applied = PASSIVE

    def _detach(self) -> None:
        """Write the passive command or wait for the watchdog, then close all tasks."""
        watchdog, self._watchdog = self._watchdog, None
        if not self._try_passive() and watchdog is not None:
            with suppress(Exception):
                watchdog.await_strike(self.clock, self._sleep)
        tasks, self._tasks = self._tasks, []
        for task in reversed(tasks):
            with suppress(Exception):  # whatever the state of the card
                task.close()
        if watchdog is not None:
            with suppress(Exception):
                watchdog.close()

    def make_passive(self) -> None:
        """Write the passive command if the card is open; otherwise already passive. Never raises."""
        self.applied = PASSIVE
        if self._is_open and not self._try_passive():
            self.fault = self.fault or "the passive command could not be written"

    def _try_passive(self) -> bool:
        """Write the passive command, valves first; return whether all of it was written."""
        if len(self._tasks) < 2:
            return True
        written = True
        for write in (self._write_valves, self._write_lines):
            try:
                write(PASSIVE)
            except Exception:  # whatever the state of the card
                written = False
        return written

    # The tick ------------------------------------------------------------------------------------

    def read(self, time: float) -> Readings:
        """Read counters and inputs at `time` (s), pressures every few ticks.

        A sample is stamped with the time of its reading, or of the edge that latched it, on the clock of
        `time`.

        Raises:
            DriverError: not open, or `time` is not finite or earlier than the last.
        """
        check_open(self._is_open, "daq", "read")
        check_time(time, self._time, "daq")
        self._time = time
        try:
            self._read_counters(time)
            self._read_inputs()
            if self._has_spools or self._ticks % self.settings.pressure_ticks == 0:
                self._read_voltages()
        except self._daq.errors.Error as error:
            self._inputs[:] = False
            self._voltages[:] = np.nan
            self._note_fault(f"reading failed: {error_text(error)}")
        self._ticks += 1
        return self._readings(time)

    def write(self, command: Command) -> Command:
        """Apply `command` within the card's limits; return the applied one, PASSIVE if not operational.

        Raises:
            DriverError: not open.
        """
        check_open(self._is_open, "daq", "write")
        applied = PASSIVE if self.fault else device_limited(command)
        if self._beat >= 0 and not self.fault:
            self._lines[self._beat] ^= True
        try:
            if applied.search_index and not self.applied.search_index:
                self._forget_index()
            self._write(applied)
            if self._watchdog is not None and not self.fault and not self._watchdog.feed():
                self._note_fault("the card's watchdog has tripped: no command within its time")
        except self._daq.errors.Error as error:
            self._note_fault(f"writing failed: {error_text(error)}")
            self._try_passive()
        self.applied = PASSIVE if self.fault else applied
        return self.applied

    def _forget_index(self) -> None:
        """Let counters whose index has passed begin at their preset again, until it passes the next time."""
        for joint, task in enumerate(self._counter_tasks):
            if self._indexed[joint]:
                task.stop()
                task.start()

    def _note_fault(self, text: str) -> None:
        """Ignore commands from now on; keep the first reason."""
        self.fault = self.fault or text

    def _write(self, command: Command) -> None:
        self._write_valves(command)
        self._write_lines(command)

    def _write_valves(self, command: Command) -> None:
        volts, (a, b, c), s = self._volts, command.valve, self.settings
        first, second, third = s.centre
        volts[0], volts[1], volts[2] = first + s.span * a, second + s.span * b, third + s.span * c
        self._valves.write_one_sample(volts, s.sync_timeout)

    def _write_lines(self, command: Command) -> None:
        lines = self._lines
        lines[0], lines[1] = command.supply_enable, command.exhaust_closed
        lines[2], lines[3], lines[4] = not command.guard_lock, command.beacon, command.tee
        if self._sync >= 0:
            lines[self._sync] = False
        self._outputs.write_one_sample_one_line(lines, self.settings.sync_timeout)

    def _read_counters(self, time: float) -> None:
        """Sample each encoder; a missing sample leaves the last one."""
        clock, timeout = self.clock, self.settings.sync_timeout
        begin = latched = clock()
        if self.hardware_timed:
            if self._lines[self._sync]:  # no command was written since
                self._lines[self._sync] = False
                self._outputs.write_one_sample_one_line(self._lines, timeout)
            self._lines[self._sync] = True
            self._outputs.write_one_sample_one_line(self._lines, timeout)
            latched = clock()
        for joint, counter in enumerate(self._counters):
            try:
                value = counter.read_one_sample_double(timeout)
            except self._daq.errors.DaqError:
                self.missing += 1
                continue
            if not abs(value) < _WRAP:
                self.missing += 1
                continue
            # Counters have 32 bits; cards differ in whether they report negative counts.
            count = (round(value) + _WRAP // 2) % _WRAP - _WRAP // 2
            self._indexed[joint] = abs(count) < PRESET // 2
            self._count[joint] = count % self._counts
            self._sampled[joint] = time + ((latched if self.hardware_timed else clock()) - begin)

    def _read_inputs(self) -> None:
        self._interlocks.read_one_sample_one_line(self._inputs, self.settings.sync_timeout)

    def _read_voltages(self) -> None:
        if self._analogue is not None:
            self._analogue.read_one_sample(self._voltages, self.settings.sync_timeout)

    def _readings(self, time: float) -> Readings:
        s, inputs = self.settings, self._inputs.tolist()
        scale = (s.pressure_at_full_scale - s.pressure_at_zero) / FULL_SCALE
        voltages = iter(self._voltages.tolist())
        supply, p1, p2, p3, p4, p5, p6 = (
            believed(s.pressure_at_zero + scale * next(voltages), s.lowest_pressure, s.highest_pressure)
            if name
            else ABSENT
            for name in (s.supply_pressure, *s.chamber_pressures)
        )
        scale = (s.spool_at_full_scale - s.spool_at_zero) / FULL_SCALE
        s1, s2, s3 = (
            believed(s.spool_at_zero + scale * next(voltages), *SPOOL_RANGE) if name else ABSENT
            for name in s.spool_positions
        )
        fed_back = iter(inputs[len(vars(s.inputs)) :])
        # Inputs that were not read are False, which is also a valve's position.
        one, two, shut_off = (
            ABSENT if not name else INVALID if self.fault else float(next(fed_back))
            for name in (*s.vent_feedback, s.shut_off_feedback)
        )
        a, b, c = self._sampled
        return Readings(
            time,
            (self._count[0], self._count[1], self._count[2]),
            (a, b, c),
            (not math.isnan(a), not math.isnan(b), not math.isnan(c)),
            (time - a, time - b, time - c),
            inputs[0],
            inputs[1],
            inputs[2],
            supply,
            inputs[3],
            inputs[4],
            (p1, p2, p3, p4, p5, p6),
            (self._indexed[0], self._indexed[1], self._indexed[2]),
            (one, two),
            shut_off,
            (s1, s2, s3),
        )
