"""What a tick of the CANopen driver costs, beside the same tick written with the libraries' own means.

Blocks of each in turn, in one run, at 1 kHz on the wall clock. "In memory": the wire is a list, so that what
is left is Python; "local bus": simulated nodes answer in a process of their own, and the time of a tick is
from before SYNC until the command is sent, the wait for the encoders in it.
"""

from __future__ import annotations

import gc
import os
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from statistics import median

import can
import numpy as np

from bench.processes.child import Child
from drivers.base import Command
from drivers.can_bus import FRAME, LocalSocketBus, message_of
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.frames import frame
from drivers.canopen.link import FrameLink
from drivers.canopen.settings import CanopenSettings
from sim.nodes.plan import NodesPlan
from sim.plant import PlantParameters
from tests.benchmarks.can_bits import bits_of
from tests.benchmarks.naive_canopen import NaiveTick
from tests.benchmarks.row import Row

PERIOD, WATCHDOG = 0.001, 0.1
BLOCK, ROUNDS, LOAD_TICKS = 500, 8, 3000
PRIORITY = 80
PROMISED_MEDIAN = 100.0
"""us of the driver's own Python in a tick."""
COMMAND = Command((0.1, -0.1, 0.2), beacon=True)
_TITLE = "a tick on CANopen"
_ANSWERS = [frame(0x280 + number, bytes([7, number, 1, 0])) for number in (1, 2, 3)]

Tick = Callable[[float], object]


class MemoryLink:
    """A wire that answers a SYNC at once."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    def send_frame(self, whole: bytes) -> float:
        if FRAME.unpack(whole)[0] == 0x80:
            self.frames = _ANSWERS.copy()
        return time.monotonic()

    def receive_frame(self, timeout: float) -> bytes | None:
        return self.frames.pop() if self.frames else None

    def sync_time(self, sent: float) -> float:
        return sent

    def shutdown(self) -> None:
        self.frames.clear()


class MemoryBus(can.BusABC):
    """The same for python-can."""

    def __init__(self) -> None:
        self._messages: list[can.Message] = []
        super().__init__(channel="memory")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if msg.arbitration_id == 0x80:
            self._messages = [message_of(answer, "memory") for answer in _ANSWERS]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self._messages.pop() if self._messages else None), True


class SkippedSetup(CanopenDriver):
    """The driver on a wire without nodes to set up."""

    def _begin(self) -> None:
        self._listening = False


def run() -> list[Row]:
    """Measure both in memory and over the local bus."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="golfbench-can-")))
        settings = CanopenSettings("local_socket", str(folder / "can"), service_time=1.0)
        in_memory = SkippedSetup(
            settings, period=PERIOD, watchdog=WATCHDOG, open_bus=lambda *_: _memory_link()
        )
        in_memory.open()
        memory_bus = MemoryBus()
        stack.callback(memory_bus.shutdown)
        wall, processor = _measure(
            {"in memory, driver": _tick_of(in_memory), "in memory, naive": _naive(memory_bus, settings)}
        )
        plan = NodesPlan(
            settings.interface,
            settings.channel,
            settings.bitrate,
            settings.encoders.nodes,
            settings.valve_node.node,
            PlantParameters(),
            folder,
            priority=PRIORITY - 1,
        )
        nodes = Child.start("nodes", "sim.nodes.process", plan)
        stack.callback(nodes.end, 5.0)
        nodes.wait_until_ready(200.0)
        bus = can.Bus(
            interface="local_socket",
            channel=settings.channel,
            can_filters=[{"can_id": base + n, "can_mask": 0x7FF} for base, n in _heard(settings)],
        )
        stack.callback(bus.shutdown)
        naive = _naive(bus, settings)
        driver = CanopenDriver(settings, period=PERIOD, watchdog=WATCHDOG)
        driver.open()
        stack.callback(driver.close)
        more = _measure(
            {"local bus, driver": _tick_of(driver), "local bus, naive": naive},
            before_block=lambda: _empty(bus),
        )
        wall, processor = wall | more[0], processor | more[1]
        frames, load = _count_load(driver, settings)
        missing, trouble = driver.counters.missing, driver.trouble
    rows = []
    for name in wall:
        p99, used = np.quantile(wall[name], 0.99), median(processor[name])
        note = f"p99 {p99:.0f}, processor time of the thread {used:.0f} us"
        promise = PROMISED_MEDIAN if name == "in memory, driver" else None
        rows.append(Row(_TITLE, f"{name}, median", median(wall[name]), "us", at_most=promise, note=note))
    for place in ("in memory", "local bus"):
        ratio = median(wall[f"{place}, naive"]) / median(wall[f"{place}, driver"])
        rows.append(Row(_TITLE, f"{place}, naive over driver", ratio, "", note="same run, blocks in turn"))
    rows.append(
        Row(
            _TITLE,
            "bus load, frames really sent",
            100.0 * load,
            "%",
            at_most=100.0 * driver.load,
            note=f"{frames:.0f} frames a second, stuff bits counted; computed at most {driver.load:.1%}",
        )
    )
    rows.append(Row(_TITLE, "local bus, samples missing", missing, f"of {3 * BLOCK * ROUNDS}", note=trouble))
    return rows


def _count_load(driver: CanopenDriver, settings: CanopenSettings) -> tuple[float, float]:
    """Return frames per second and load (0 … 1) of what everybody sends during ticks at PERIOD."""
    with LocalSocketBus(settings.channel) as listener:
        start, frames, bits = time.monotonic(), 0, 0
        for k in range(LOAD_TICKS):
            while (early := start + k * PERIOD - time.monotonic()) > 0.0:
                time.sleep(early)
            driver.read(time.monotonic())
            driver.write(COMMAND)
            while (whole := listener.receive_frame(0.0)) is not None:
                identifier, length, data = FRAME.unpack(whole)
                frames, bits = frames + 1, bits + bits_of(identifier, data[:length])
        duration = time.monotonic() - start
    return frames / duration, bits / duration / settings.bitrate


def _memory_link() -> FrameLink:
    return MemoryLink()


def _heard(settings: CanopenSettings) -> list[tuple[int, int]]:
    node = settings.valve_node.node
    return [(0x280, n) for n in (*settings.encoders.nodes, node)] + [(0x180, node), (0x380, node)]


def _tick_of(driver: CanopenDriver) -> Tick:
    def tick(now: float) -> object:
        readings = driver.read(now)
        driver.write(COMMAND)
        return readings

    return tick


def _naive(bus: can.BusABC, settings: CanopenSettings) -> Tick:
    naive = NaiveTick(bus, settings, PERIOD, WATCHDOG)

    def tick(now: float) -> object:
        return naive.run(COMMAND)

    return tick


def _empty(bus: can.BusABC) -> None:
    """Take what waits: frames of the other's blocks would be answers without waiting."""
    while bus.recv(0.0) is not None:
        pass


def _measure(
    ways: dict[str, Tick], before_block: Callable[[], None] = lambda: None
) -> tuple[dict[str, list[float]], dict[str, list[float]]]:
    """Return the times (us) of every tick of each way: on the wall, and of the thread on the processor."""
    wall: dict[str, list[float]] = {name: [] for name in ways}
    processor: dict[str, list[float]] = {name: [] for name in ways}
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except PermissionError:
        pass
    gc.collect()
    gc.disable()
    try:
        for round_ in range(ROUNDS + 1):
            for name, tick in ways.items():
                before_block()
                start = time.monotonic() + PERIOD
                for k in range(BLOCK if round_ else 50):
                    while (early := start + k * PERIOD - time.monotonic()) > 0.0:
                        time.sleep(early)
                    began, used = time.perf_counter_ns(), time.thread_time_ns()
                    tick(time.monotonic())
                    used, ended = time.thread_time_ns() - used, time.perf_counter_ns()
                    if round_:
                        wall[name].append(1e-3 * (ended - began))
                        processor[name].append(1e-3 * used)
    finally:
        gc.enable()
        os.sched_setscheduler(0, *before)
    return wall, processor
