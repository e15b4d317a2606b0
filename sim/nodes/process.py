"""The bench's devices as CANopen nodes around the plant: a process of its own, in real time, on any CAN bus.

Three encoders (CiA 406) and a node of valves and interlocks (CiA 401) as their EDS files describe them. A
SYNC samples the shafts where they are at that instant: the plant's last tick, moved on with its speed. The
operator's actions and faults come by `sim.live.surroundings`; the plant reports as in `sim.live.process`.

`python -m sim.nodes.process` takes a pickled NodesPlan on stdin and reports "ready", "failed" or "stopped"
as a JSON line on stdout. It ends on SIGTERM, or when its parent is gone.
"""

from __future__ import annotations

import errno
import gc
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import can
import numpy as np

from drivers.base import Command, unpack_readings
from drivers.base.compiled import new_record
from drivers.base.shared_record import SharedMemoryError
from sim.live.exchange import PLANT_SURROUNDINGS
from sim.live.process import PlantFiles, ask_for_scheduling, tell
from sim.live.wall_grid import WallGrid
from sim.live.wall_plant import WallPlant
from sim.nodes.device import OPERATIONAL, CanopenDevice
from sim.nodes.encoder import EncoderNode
from sim.nodes.plan import NodesPlan
from sim.nodes.valves import ValveNode401

EDS = Path(__file__).resolve().parents[2] / "drivers" / "canopen"
"""Folder of the EDS files."""

_BETWEEN_LOOKS = 0.02
"""s between two looks at signals, parent and files."""
_BETWEEN_ATTEMPTS = 0.5
"""s between two attempts to open an interface that has gone."""
_LONGEST_EXTRAPOLATION = 0.005
"""s: a plant that stands still is not moved on for longer."""
_SYNC = 0x80
_LEAD, _PULL, _LONGEST_PULL = 0.3, 0.05, 20e-6
"""The plant's ticks are drawn to shortly before the SYNCs, so that little is left to extrapolate: share of a
tick before them, share of the distance that one SYNC draws, and at most so many s."""
_FRAMES_AT_ONCE = 64
"""Most frames taken between two ticks of the plant: a babbling participant does not stop it."""
_GONE = frozenset({errno.ENODEV, errno.ENXIO, errno.EBADF})


class NodeBus:
    """The bus as the nodes have it: what cannot be sent is lost, an interface that went is awaited."""

    def __init__(self, plan: NodesPlan) -> None:
        """Open it.

        Raises:
            OSError, can.CanError: that fails.
        """
        self._settings = {"interface": plan.interface, "channel": plan.channel, "bitrate": plan.bitrate}
        self._bus: can.BusABC | None = self._open()
        self._closed_at = 0.0
        self.unsent = 0

    def _open(self) -> can.BusABC:
        return can.Bus(**self._settings)  # type: ignore[arg-type]

    def send(self, identifier: int, data: bytes) -> None:
        """Send a data frame, or count it as unsent."""
        try:
            if self._bus is None:
                self.unsent += 1
            else:
                self._bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data))
        except can.CanError as error:
            self.unsent += 1
            self._note(error)

    def receive(self, timeout: float) -> can.Message | None:
        """Return the next frame, None when there is none for `timeout` s."""
        if self._bus is None:
            time.sleep(min(timeout, _BETWEEN_LOOKS))
            return None
        try:
            return self._bus.recv(timeout)
        except can.CanError as error:
            self._note(error)
            return None

    def mend(self, now: float) -> None:
        """Try at times to open an interface that has gone."""
        if self._bus is None and now - self._closed_at > _BETWEEN_ATTEMPTS:
            self._closed_at = now
            with suppress(OSError, can.CanError):
                self._bus = self._open()

    def close(self) -> None:
        """Close it. Allowed twice."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def _note(self, error: can.CanError) -> None:
        if error.error_code in _GONE:
            self.close()


class BenchNodes:
    """The devices around the plant: no clock, no bus."""

    def __init__(self, plan: NodesPlan, send: Callable[[int, bytes], None]) -> None:
        """Stand vented and without power; ValueError when the plan does not hold."""
        self.plant = plant = WallPlant(plan.plant_plan)

        def speak(identifier: int, data: bytes) -> None:
            if plant.link_up:
                send(identifier, data)

        self._latency = plan.plant.encoders.latency
        self._tick, resolution = plan.plant.tick, plan.plant.encoders.counts_per_revolution
        self._now = self.instant = 0.0
        """`instant` (s): the end of the plant's last tick."""
        self._frozen = False
        self._scale: list[float] = self.plant.plant.plant["encoder_scale"][0].tolist()
        self._speed = self._speed_before = [0.0, 0.0, 0.0]
        self.readings = unpack_readings(self.plant.report["readings"])
        self.encoders = [
            EncoderNode(number, EDS / "encoder.eds", speak, resolution, partial(self._count, joint))
            for joint, number in enumerate(plan.encoders)
        ]
        self.valve_node = ValveNode401(plan.valve_node, EDS / "valve_node.eds", speak, self._obey)
        self.devices: list[CanopenDevice] = [*self.encoders, self.valve_node]

    def boot(self, now: float) -> None:
        """Switch the power of all devices on at `now` (s)."""
        self._now = self.instant = now
        for device in self.devices:
            device.boot(now)
        self.valve_node.sense(self.readings)

    def hear(self, identifier: int, data: bytes, now: float) -> None:
        """Let the devices hear a frame."""
        self._now = now
        if not self.plant.link_up:
            return
        for device in self.devices:
            device.hear(identifier, data, now)

    def surround(self, record: np.ndarray[Any, Any]) -> None:
        """Take over a PLANT_SURROUNDINGS record."""
        self.plant.surround(record)
        self._frozen = bool(record["frozen"][0])

    def move(self, instant: float) -> None:
        """Move the plant on by one tick, which ends at `instant` (s)."""
        self.plant.move(instant)
        self.instant = instant
        self._speed_before, self._speed = self._speed, self.plant.state["speed"][0].tolist()

    def tell(self, now: float) -> None:
        """Show the devices what the plant has come to at `now` (s), and bring its report up to date."""
        node = self.plant.node
        node.operational = self.valve_node.state == OPERATIONAL
        if node.trips != self.valve_node.errors:
            node.trips, node.passive_tick = self.valve_node.errors, self.plant.ticks
        self.plant.tell()
        self.readings = unpack_readings(self.plant.report["readings"])
        for encoder, valid in zip(self.encoders, self.readings.encoder_valid, strict=True):
            encoder.set_health(valid)
        self.valve_node.sense(self.readings)

    def run_timers(self, now: float) -> None:
        """Let the devices do what is due."""
        for device in self.devices:
            if now >= device.next_due:
                device.run_timers(now)

    def _obey(self, command: Command) -> None:
        node = self.plant.node
        node.applied = command
        if self.valve_node.state == OPERATIONAL:
            node.command_tick = self.plant.ticks

    def _count(self, joint: int) -> int | None:
        """Return the joint's count now: the last tick's, moved on with its speed and acceleration."""
        if self._frozen:
            return None
        count = self.readings.encoder_count[joint]
        if not self.readings.encoder_valid[joint]:
            return count
        limit = _LONGEST_EXTRAPOLATION
        ahead = max(-limit, min(limit, self._now - self.instant)) + self._latency
        speed, before = self._speed[joint], self._speed_before[joint]
        turned = ahead * (speed + 0.5 * ahead * (speed - before) / self._tick)
        return count + round(turned * self._scale[joint])


# The process -----------------------------------------------------------------------------------------


def run_nodes(plan: NodesPlan, ready: Callable[[str], None], wants_end: Callable[[], bool]) -> None:
    """Be the nodes until `wants_end`, asked every 20 ms; `ready` is told the scheduling once they live.

    Raises:
        OSError, can.CanError: the bus cannot be opened.
        SharedMemoryError, ValueError: the plant's files cannot be made, the plan does not hold.
    """
    _warm_up(plan)
    with PlantFiles(plan.folder) as files, _open_bus(plan) as bus:
        nodes = BenchNodes(plan, bus.send)
        scheduling = ask_for_scheduling(plan.plant_plan)
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            nodes.boot(time.monotonic())
            ready(scheduling)
            _live(plan, nodes, bus, files, wants_end)
        finally:
            gc.enable()
            gc.unfreeze()


@contextmanager
def _open_bus(plan: NodesPlan) -> Iterator[NodeBus]:
    bus = NodeBus(plan)
    try:
        yield bus
    finally:
        bus.close()


def _warm_up(plan: NodesPlan) -> None:
    """Call everything once that a tick calls, on nodes without a bus."""
    nodes = BenchNodes(plan, lambda identifier, data: None)
    nodes.boot(0.0)
    nodes.surround(_quiet(new_record(PLANT_SURROUNDINGS)))
    for tick in (1, 2):
        nodes.move(tick * plan.plant.tick)
        nodes.tell(tick * plan.plant.tick)


def _quiet(surroundings: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    for name in ("emergency_stop_clear", "guard_closed", "encoder_valid"):
        surroundings[name] = 1
    return surroundings


def _live(
    plan: NodesPlan, nodes: BenchNodes, bus: NodeBus, files: PlantFiles, wants_end: Callable[[], bool]
) -> None:
    """Run plant and devices on the wall's clock."""
    surroundings, report, clock = new_record(PLANT_SURROUNDINGS), nodes.plant.report, time.monotonic
    looked, surrounded, tick = 0.0, 0, plan.plant.tick
    grid, offset = WallGrid(tick, clock(), plan.burst), 0.0
    while True:
        left = _FRAMES_AT_ONCE
        while left and (message := bus.receive(max(0.0, grid.instant + offset - clock()))) is not None:
            left -= 1
            if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                # The stamp of the bus, not this process' turn, is when a device latches its shaft at a SYNC.
                age = time.time() - message.timestamp
                heard = clock() - (age if 0.0 < age < _LONGEST_EXTRAPOLATION else 0.0)
                nodes.hear(message.arbitration_id, bytes(message.data), heard)
                if message.arbitration_id == _SYNC:
                    apart = (heard - nodes.instant - _LEAD * tick + tick / 2) % tick - tick / 2
                    offset += max(-_LONGEST_PULL, min(_LONGEST_PULL, _PULL * apart))
        now = clock()
        late = now - offset - grid.instant
        if late < 0.0:
            continue
        if (version := files.surroundings.read(surroundings)) != surrounded:
            surrounded = version
            nodes.surround(surroundings)
        for _ in range(grid.take_due(now - offset)):
            nodes.move(grid.instant + offset)
            grid.line += 1
        nodes.tell(now)
        nodes.run_timers(now)
        report["lateness"] = late
        report["greatest_lateness"] = max(report["greatest_lateness"][0], late)
        report["plant_slips"], report["slipped_ticks"] = grid.slips, grid.slipped_ticks
        files.report.write(report)
        if now - looked > _BETWEEN_LOOKS:
            looked = now
            bus.mend(now)
            if wants_end() or not files.are_there:
                return


class StopRequest:
    """The wish to end: a signal, or the parent's death."""

    def __init__(self, *signals: int) -> None:
        self._parent, self._heard = os.getppid(), False
        for number in signals:
            signal.signal(number, self._note)

    def __call__(self) -> bool:
        """Tell whether there is one."""
        return self._heard or os.getppid() != self._parent

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._heard = True


def main() -> int:
    """Be the nodes that the plan on stdin describes; return the exit code."""
    wish = StopRequest(signal.SIGTERM)
    for number in (signal.SIGINT, signal.SIGABRT):  # they go to all processes at once; the parent decides
        signal.signal(number, signal.SIG_IGN)
    try:
        plan = pickle.load(sys.stdin.buffer)  # noqa: S301 - the parent's own data
        if not isinstance(plan, NodesPlan):
            raise TypeError(f"plan: found {type(plan).__name__}, expected a NodesPlan")
        run_nodes(plan, lambda scheduling: tell("ready", pid=os.getpid(), scheduling=scheduling), wish)
        tell("stopped", reason="SIGTERM, or the parent or the plant's files are gone")
        return 0
    except (
        ValueError,
        TypeError,
        pickle.UnpicklingError,
        EOFError,
        OSError,
        can.CanError,
        SharedMemoryError,
    ) as error:
        tell("failed", reason=f"{error}")
    return 1


if __name__ == "__main__":
    sys.exit(main())
