"""A stand-in for NI's driver below the real package `nidaqmx`: its interpreter, with cards made of values.

The package checks each call and its arguments on the way here; here they are checked again for what NI's C
interface takes (types and layout of arrays, states of tasks, order in which a watchdog can be had).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import nidaqmx._base_interpreter as base
import numpy as np
from nidaqmx.constants import (
    AcquisitionType,
    AngleUnits,
    Edge,
    EncoderType,
    FillMode,
    Level,
    LineGrouping,
    TaskMode,
    WatchdogAOExpirState,
    WDTTaskAction,
)
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError
from nidaqmx.utils import flatten_channel_string, unflatten_channel_string

from drivers.base import Command
from drivers.daq.driver import DaqDriver
from drivers.daq.settings import DaqSettings

_PRODUCT_SERIAL, _CI_CLOCK, _CI_MODES, _NAMES = 0x632, 0x299E, 0x2FDE, 0x193B
_TASK_NAME, _TASK_CHANNELS = 0x1276, 0x1273
_READ_CHANNELS, _READ_LINES, _WRITE_CHANNELS, _WRITE_LINES = 0x217B, 0x217C, 0x217E, 0x217F
_EXPIRED, _TIMEOUT, _AO_TYPE, _AO_STATE, _DO_STATE = 0x21A8, 0x21A9, 0x305E, 0x305F, 0x21A7


@dataclass
class Card:
    """A card: its terminals' signals and its features."""

    serial: int = 4711
    has_watchdog: bool = True
    watchdog_works: bool = True
    single_point: bool = True
    wire: str = "port0/line5"
    """Line that is wired to PFI12."""
    now: float = 0.0
    """s, the card's clock."""
    volts: dict[str, float] = field(default_factory=lambda: {f"ao{n}": 0.0 for n in range(4)})
    """Outputs; switched on they are at 0 V, which is full stroke."""
    lines: dict[str, bool] = field(default_factory=lambda: {f"port0/line{n}": False for n in range(16)})
    levels: dict[str, float] = field(default_factory=lambda: {f"ai{n}": 0.5 for n in range(8)})
    """V at the analogue inputs."""
    motion: dict[str, int] = field(default_factory=lambda: {f"ctr{n}": 0 for n in range(4)})
    """Counts that each encoder has moved since the index, or since switching on."""
    indexed: dict[str, bool] = field(default_factory=lambda: {f"ctr{n}": True for n in range(4)})
    unsigned: bool = False
    """Counts below zero are reported as large ones."""
    coarse: float = 0.0
    """V that a fallback voltage is off."""
    stuck: set[str] = field(default_factory=set)
    """Counters that do not answer."""
    gone: bool = False
    """Unplugged."""
    calls: list[str] = field(default_factory=list)
    watchdog: Task | None = None
    written: list[tuple[float, ...]] = field(default_factory=list)
    """Voltages written, in order."""

    def expired(self) -> bool:
        """Whether the watchdog has struck; strikes when it is time."""
        w = self.watchdog
        if w is None or w.state != "running":
            return False
        if not w.expired and self.watchdog_works and self.now - w.fed > w.timeout:
            w.expired = True
            for channel, volts in w.fallback.items():
                self.volts[channel.split("/", 1)[1]] = volts
            for line in w.low:
                self.lines[line.split("/", 1)[1]] = False
        return w.expired


@dataclass
class Task:
    """A task; channels are full names."""

    name: str
    card: Card | None = None
    kind: str = ""
    channels: list[str] = field(default_factory=list)
    state: str = "idle"
    arguments: dict[str, Any] = field(default_factory=dict)
    source: str = ""
    latched: int | None = None
    fallback: dict[str, float] = field(default_factory=dict)
    low: list[str] = field(default_factory=list)
    timeout: float = 0.0
    fed: float = 0.0
    expired: bool = False
    committed: bool = False


def fail(code: DAQmxErrors, text: str) -> DaqError:
    return DaqError(f"{text}\n\nStatus Code: {code.value}", code.value)


class System(base.BaseInterpreter):  # type: ignore[misc]  # the package has no types
    """NI's driver with some cards."""

    def __init__(self) -> None:
        self.cards: dict[str, Card] = {}
        self.tasks: list[Task] = []
        self._numbers = itertools.count()

    def card(self, name: str) -> Card:
        if name not in self.cards or self.cards[name].gone:
            raise fail(DAQmxErrors.INVALID_DEVICE_ID, f"Device identifier is invalid.\n\nDevice: {name}")
        return self.cards[name]

    def _of(self, task: Task, call: str, kind: str = "", state: str = "") -> Card:
        assert task in self.tasks, f"{call} on a task that was cleared"
        assert not kind or task.kind == kind, f"{call} on a task of {task.kind}"
        assert not state or task.state == state, f"{call} on a task that is {task.state}"
        card = task.card
        assert card is not None, f"{call} on a task without channels"
        card.calls.append(call)
        if card.gone:
            raise fail(DAQmxErrors.DEVICE_REMOVED, "The device is not ready or no longer present.")
        return card

    def _add(self, task: Task, names: str, kind: str, known: Callable[[Card], Any], call: str) -> Card:
        assert task in self.tasks
        assert task.kind in ("", kind), "one kind of channel a task"
        for name in unflatten_channel_string(names):
            device, channel = name.split("/", 1)
            card = self.card(device)
            if channel not in known(card):
                raise fail(DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST, f"Physical channel not found: {name}")
            for other in self.tasks:
                if name in other.channels and other.kind != "watchdog":
                    raise fail(
                        DAQmxErrors.PAL_RESOURCE_RESERVED, f"The specified resource is reserved: {name}"
                    )
            task.card, task.kind = card, kind
            task.channels.append(name)
            card.calls.append(call)
        assert task.card is not None
        return task.card

    # Tasks

    def create_task(self, session_name: str) -> Any:
        task = Task(session_name or f"_unnamedTask<{next(self._numbers)}>")
        self.tasks.append(task)
        return task, True

    def create_watchdog_timer_task_ex(self, device_name: str, session_name: str, timeout: float) -> Any:
        card = self.card(device_name)
        if not card.has_watchdog:
            raise fail(
                DAQmxErrors.WATCHDOG_TIMER_NOT_SUPPORTED, "Watchdog timer is not supported on this device."
            )
        task = Task(session_name or f"_watchdog<{next(self._numbers)}>", card, "watchdog", timeout=timeout)
        self.tasks.append(task)
        card.watchdog = task
        return task, True

    def clear_task(self, task: Task) -> None:
        assert task in self.tasks, "cleared twice"
        self.tasks.remove(task)
        if task.card is not None and task.card.watchdog is task:
            task.card.watchdog = None

    def start_task(self, task: Task) -> None:
        card = self._of(task, "start_task")
        assert task.state != "running", "started twice"
        if task.kind == "watchdog":
            self._reserve(task)
            task.fed = card.now
        task.state = "running"

    def stop_task(self, task: Task) -> None:
        card = self._of(task, "stop_task", state="running")
        task.state = "idle"
        if task.kind == "ci":  # the next start loads the initial count
            card.indexed[task.channels[0].split("/", 1)[1]] = False

    def task_control(self, task: Task, action: int) -> None:
        self._of(task, "task_control", "watchdog", "idle")
        assert action == TaskMode.TASK_COMMIT.value
        self._reserve(task)
        task.committed = True

    def _reserve(self, watchdog: Task) -> None:
        others = [
            t for t in self.tasks if t.card is watchdog.card and t.state == "running" and t is not watchdog
        ]
        if others and not watchdog.committed:
            code = DAQmxErrors.CANT_RESERVE_WATCHDOG_TASK_WHILE_OTHER_TASKS_RESERVED
            raise fail(code, "Watchdog task cannot be reserved while other tasks are.")

    def get_task_attribute_string(self, task: Task, attribute: int) -> str:
        if attribute == _TASK_NAME:
            return task.name
        assert attribute == _TASK_CHANNELS
        return str(flatten_channel_string(task.channels))

    def internal_get_last_created_chan(self) -> str:
        return self.tasks[-1].channels[-1]

    def hash_task_handle(self, task_handle: Task) -> int:
        return id(task_handle)

    # Devices

    def get_system_info_attribute_string(self, attribute: int) -> str:
        assert attribute == _NAMES
        return ", ".join(name for name, card in self.cards.items() if not card.gone)

    def get_device_attribute_uint32(self, device_name: str, attribute: int) -> int:
        assert attribute == _PRODUCT_SERIAL
        return self.card(device_name).serial

    def get_device_attribute_bool(self, device_name: str, attribute: int) -> bool:
        assert attribute == _CI_CLOCK
        return self.card(device_name).single_point

    def get_device_attribute_int32_array(self, device_name: str, attribute: int) -> list[int]:
        assert attribute == _CI_MODES
        kinds = [AcquisitionType.CONTINUOUS, AcquisitionType.HW_TIMED_SINGLE_POINT]
        return [kind.value for kind in kinds[: 1 + self.card(device_name).single_point]]

    # Channels

    def create_ao_voltage_chan(
        self,
        task: Task,
        physical_channel: str,
        name_to_assign_to_channel: str,
        min_val: float,
        max_val: float,
        units: int,
        custom_scale_name: str,
    ) -> None:
        assert (min_val, max_val) == (0.0, 10.0)
        self._add(task, physical_channel, "ao", lambda card: card.volts, "create_ao")

    def create_do_chan(
        self, task: Task, lines: str, name_to_assign_to_lines: str, line_grouping: int
    ) -> None:
        assert line_grouping in {grouping.value for grouping in LineGrouping}
        assert "," not in lines
        self._add(task, lines, "do", lambda card: card.lines, "create_do")

    def create_di_chan(
        self, task: Task, lines: str, name_to_assign_to_lines: str, line_grouping: int
    ) -> None:
        assert "," not in lines
        self._add(task, lines, "di", lambda card: card.lines, "create_di")

    def create_ai_voltage_chan(
        self,
        task: Task,
        physical_channel: str,
        name_to_assign_to_channel: str,
        terminal_config: int,
        min_val: float,
        max_val: float,
        units: int,
        custom_scale_name: str,
    ) -> None:
        assert (min_val, max_val) == (0.0, 10.0)
        self._add(task, physical_channel, "ai", lambda card: card.levels, "create_ai")

    def create_ci_ang_encoder_chan(
        self,
        task: Task,
        counter: str,
        name_to_assign_to_channel: str,
        decoding_type: int,
        zidx_enable: bool,
        zidx_val: float,
        zidx_phase: int,
        units: int,
        pulses_per_rev: int,
        initial_angle: float,
        custom_scale_name: str,
    ) -> None:
        assert not task.channels, "one counter a task"
        assert (decoding_type, units) == (EncoderType.X_4.value, AngleUnits.TICKS.value)
        assert isinstance(pulses_per_rev, int)
        assert isinstance(zidx_val, float)
        self._add(task, counter, "ci", lambda card: card.motion, "create_ci")
        task.arguments = {
            "index": zidx_enable,
            "value": zidx_val,
            "phase": zidx_phase,
            "pulses": pulses_per_rev,
            "initial": initial_angle,
        }

    def cfg_samp_clk_timing(
        self, task: Task, rate: float, source: str, active_edge: int, sample_mode: int, samps_per_chan: int
    ) -> None:
        card = self._of(task, "cfg_samp_clk_timing", "ci", "idle")
        assert sample_mode == AcquisitionType.HW_TIMED_SINGLE_POINT.value
        assert active_edge == Edge.RISING.value
        assert source.startswith("/")
        assert rate > 0
        if not card.single_point:
            raise fail(DAQmxErrors.INVALID_ATTRIBUTE_VALUE, "Requested value is not supported: SampleMode.")
        task.source = source

    # Reading and writing

    def get_read_attribute_uint32(self, task: Task, attribute: int) -> int:
        assert attribute in (_READ_CHANNELS, _READ_LINES)
        return len(task.channels) if attribute == _READ_CHANNELS else 1

    def get_write_attribute_uint32(self, task: Task, attribute: int) -> int:
        assert attribute in (_WRITE_CHANNELS, _WRITE_LINES)
        return len(task.channels) if attribute == _WRITE_CHANNELS else 1

    def _guard(self, card: Card) -> None:
        if card.expired():
            code = DAQmxErrors.WRITE_FAILED_BECAUSE_WATCHDOG_EXPIRED
            raise fail(code, "Write cannot be performed, because the watchdog timer has expired.")

    def write_analog_f64(
        self,
        task: Task,
        num_samps_per_chan: int,
        auto_start: bool,
        timeout: float,
        data_layout: int,
        write_array: Any,
    ) -> int:
        card = self._of(task, "write_analog", "ao", "running")
        assert (num_samps_per_chan, auto_start, data_layout) == (1, False, FillMode.GROUP_BY_CHANNEL.value)
        assert (write_array.dtype, write_array.shape) == (np.float64, (len(task.channels),))
        assert write_array.flags.c_contiguous
        self._guard(card)
        if not np.all((write_array >= 0.0) & (write_array <= 10.0)):
            raise fail(DAQmxErrors.INVALID_AO_DATA_WRITE, "Voltage outside 0 to 10 V.")
        card.written.append(tuple(write_array.tolist()))
        for name, volts in zip(task.channels, write_array.tolist(), strict=True):
            card.volts[name.split("/", 1)[1]] = volts
        return 1

    def write_digital_lines(
        self,
        task: Task,
        num_samps_per_chan: int,
        auto_start: bool,
        timeout: float,
        data_layout: int,
        write_array: Any,
    ) -> int:
        card = self._of(task, "write_digital", "do", "running")
        assert (num_samps_per_chan, auto_start, data_layout) == (1, False, FillMode.GROUP_BY_CHANNEL.value)
        assert (write_array.dtype, write_array.shape) == (np.bool_, (len(task.channels),))
        self._guard(card)
        for name, level in zip(task.channels, write_array.tolist(), strict=True):
            line = name.split("/", 1)[1]
            if line == card.wire and level and not card.lines[line]:
                for other in self.tasks:
                    if other.card is card and other.source.endswith("/PFI12"):
                        other.latched = self._counted(card, other)
            card.lines[line] = level
        return 1

    def read_digital_lines(
        self, task: Task, num_samps_per_chan: int, timeout: float, fill_mode: int, read_array: Any
    ) -> Any:
        card = self._of(task, "read_digital", "di", "running")
        assert (read_array.dtype, read_array.shape) == (np.bool_, (len(task.channels),))
        read_array[:] = [card.lines[name.split("/", 1)[1]] for name in task.channels]
        return read_array, 1, 1

    def read_analog_f64(
        self, task: Task, num_samps_per_chan: int, timeout: float, fill_mode: int, read_array: Any
    ) -> Any:
        card = self._of(task, "read_analog", "ai", "running")
        assert (read_array.dtype, read_array.shape) == (np.float64, (len(task.channels),))
        read_array[:] = [card.levels[name.split("/", 1)[1]] for name in task.channels]
        return read_array, 1

    def _counted(self, card: Card, task: Task) -> int:
        counter = task.channels[0].split("/", 1)[1]
        start = task.arguments["value"] if card.indexed[counter] else task.arguments["initial"]
        count = int(start) + card.motion[counter]
        return count % 2**32 if card.unsigned else count

    def read_counter_scalar_f64(self, task: Task, timeout: float) -> float:
        card = self._of(task, "read_counter", "ci", "running")
        late = task.source and task.latched is None
        if late or task.channels[0].split("/", 1)[1] in card.stuck:
            raise fail(
                DAQmxErrors.SAMPLES_NOT_YET_AVAILABLE, "Some or all of the samples requested are not there."
            )
        if task.source:
            latched, task.latched = task.latched, None
            assert latched is not None
            return float(latched)
        return float(self._counted(card, task))

    # Watchdog

    def cfg_watchdog_ao_expir_states(
        self, task: Task, channel_names: str, expir_state_array: Any, output_type_array: Any
    ) -> None:
        card = self._of(task, "cfg_watchdog_ao", "watchdog", "idle")
        assert (expir_state_array.dtype, output_type_array.dtype) == (np.float64, np.int32)
        assert set(output_type_array.tolist()) == {WatchdogAOExpirState.VOLTAGE.value}
        for name in unflatten_channel_string(channel_names):
            if name.split("/", 1)[1] not in card.volts:
                raise fail(DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST, f"Physical channel not found: {name}")
        volts = [v + card.coarse for v in expir_state_array.tolist()]
        task.fallback = dict(zip(unflatten_channel_string(channel_names), volts, strict=True))

    def cfg_watchdog_do_expir_states(self, task: Task, channel_names: str, expir_state_array: Any) -> None:
        self._of(task, "cfg_watchdog_do", "watchdog", "idle")
        assert set(expir_state_array.tolist()) == {Level.LOW.value}
        task.low = unflatten_channel_string(channel_names)

    def get_watchdog_attribute_int32(self, task: Task, lines: str, attribute: int) -> int:
        if attribute == _AO_TYPE:
            kinds = WatchdogAOExpirState
            return int((kinds.VOLTAGE if lines in task.fallback else kinds.NO_CHANGE).value)
        assert attribute == _DO_STATE
        return int((Level.LOW if lines in task.low else Level.NO_CHANGE).value)

    def get_watchdog_attribute_double(self, task: Task, lines: str, attribute: int) -> float:
        assert attribute in (_AO_STATE, _TIMEOUT)
        return task.fallback[lines] if attribute == _AO_STATE else task.timeout

    def get_watchdog_attribute_bool(self, task: Task, lines: str, attribute: int) -> bool:
        card = self._of(task, "expired", "watchdog", "running")
        assert attribute == _EXPIRED
        return card.expired()

    def control_watchdog_task(self, task: Task, action: int) -> None:
        card = self._of(task, "control_watchdog", "watchdog", "running")
        if action == WDTTaskAction.CLEAR_EXPIRATION.value:
            task.expired = False
        elif card.expired():
            raise fail(DAQmxErrors.CANT_RESET_EXPIRED_WATCHDOG, "The watchdog has expired.")
        task.fed = card.now


def driver_on(system: System, settings: DaqSettings | None = None, **more: Any) -> DaqDriver:
    """Return a driver on a new card of `system`, whose clock is the card's."""
    card, name = Card(), f"Dev{len(system.cards) + 1}"
    system.cards[name] = card

    def sleep(duration: float) -> None:
        card.now += duration

    settings = replace(settings or DaqSettings(), device=name)
    return DaqDriver(settings, clock=lambda: card.now, sleep=sleep, **more)


def command_of(card: Card, settings: DaqSettings) -> Command:
    """Return the command at the outputs of `card`."""
    a, b, c = (
        (card.volts[channel] - centre) / settings.span
        for channel, centre in zip(settings.valves, settings.centre, strict=True)
    )
    supply, closed, release, beacon, tee = (card.lines[line] for line in vars(settings.outputs).values())
    return Command((a, b, c), supply, closed, not release, beacon, tee)


def _not_expected(name: str) -> Callable[..., Any]:
    def method(self: System, *arguments: Any, **_: Any) -> Any:
        raise AssertionError(f"{name}{arguments} was not expected")

    return method


for _name in sorted(base.BaseInterpreter.__abstractmethods__ - set(vars(System))):
    setattr(
        System, _name, property(lambda self: (24, 8)) if _name == "driver_version" else _not_expected(_name)
    )
System.__abstractmethods__ = frozenset()
