"""Driver and simulated nodes in one process, in step: the wire is a queue, the clock counts.

Before every reading time moves on to the loop's next tick, and with it the plant on its own grid.
Waiting for a frame that does not come takes its time.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from drivers.base import Command, Readings
from drivers.can_bus import FRAME
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
from sim.nodes._device import CanopenDevice
from sim.nodes.process import BenchNodes
from sim.nodes.wall_plant import NodesPlan
from sim.plant import PlantParameters

PERIOD = 0.001
PLANT = PlantParameters()
START = (0.2, 4.3, 6.0)
SETTINGS = CanopenSettings(interface="local_socket")
WITH_SPOOLS = replace(SETTINGS, valve_node=replace(SETTINGS.valve_node, spool_positions=(8, 9, 10)))
"""With feedback of the spools, as the simulated valve node sends it."""
_NEAR = 1e-9
"""s within which two instants are one, for rounding."""

Meddler = Callable[[int, bytes], list[tuple[int, bytes]]]
"""What becomes of a node's frame on its way to the driver."""


class Wire:
    """The `drivers.canopen._link.FrameLink` of the driver, nodes behind it.

    `meddle` changes the nodes' frames, `sent` holds the driver's, `refuse` makes its sending fail.
    """

    def __init__(self, plan: NodesPlan | None = None) -> None:
        self.now = 0.0
        self.queue: deque[bytes] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.frame_time = 0.0
        """s that taking a frame lasts."""
        self.lead = 0.0
        """s by which the plant's ticks come before the loop's."""
        self.delay = 0.0
        """s from the driver's sending to the nodes' hearing."""
        self.stamp_error: Callable[[], float] = lambda: 0.0
        """s by which the driver mistakes the instant of its sending."""
        self.each_tick: Callable[[Wire], None] = lambda wire: None
        """Called at the start of every tick."""
        self._tick = (0.0, 0.0)
        """When the loop's last tick began, s: as it calls that instant, and on the wire's clock."""
        self._ticks = 0
        """Ticks of the plant."""
        self._under_way: deque[tuple[float, int, bytes]] = deque()
        self.deaf = False
        """The driver's frames do not reach the nodes."""
        self.refuse: OSError | None = None
        self.break_receiving: OSError | None = None
        self.meddle: Meddler = lambda identifier, data: [(identifier, data)]
        self.open = False
        self.nodes = BenchNodes(plan or nodes_plan(), self._from_node)
        self.nodes.boot(self.now)

    # The driver's side

    def send_frame(self, frame: bytes) -> float:
        if self.refuse is not None:
            raise self.refuse
        identifier, length, data = FRAME.unpack(frame)
        self.sent.append((identifier, data[:length]))
        if not self.deaf:
            self._under_way.append((self.now + self.delay, identifier, data[:length]))
            self._deliver()
        called, begun = self._tick
        return called + (self.now - begun) + self.stamp_error()

    def receive_frame(self, timeout: float) -> bytes | None:
        if self.break_receiving is not None:
            raise self.break_receiving
        self.now += self.frame_time
        end = self.now + max(timeout, 1e-6)
        while timeout and not self.queue and self.now < end - _NEAR:
            self._pass_until(end)
        return self.queue.popleft() if self.queue else None

    def sync_time(self, sent: float) -> float:
        return sent

    def shutdown(self) -> None:
        self.open = False

    def opened(self, settings: CanopenSettings, identifiers: list[int]) -> Wire:
        """Be the link that the driver asks for."""
        self.open = True
        self.queue.clear()
        return self

    # The world's side

    def wait(self, time: float) -> None:
        """Let time pass until the loop's next tick, which it calls `time` (s)."""
        self.pass_time(PERIOD - (self.now - self.lead + _NEAR) % PERIOD + _NEAR)
        self._tick = time, self.now
        self.each_tick(self)

    def pass_time(self, duration: float) -> None:
        """Let the plant move, frames arrive and the nodes' timers run."""
        end = self.now + duration
        while self.now < end - _NEAR:
            self._pass_until(end)

    def _pass_until(self, end: float) -> None:
        """Let time pass up to what happens next, at the longest until `end`."""
        tick = (self._ticks + 1) * PERIOD
        arrival = max(self._under_way[0][0], self.now) if self._under_way else end
        self.now = min(end, tick, arrival)
        if self.now == tick:
            self._ticks += 1
            self.nodes.move(tick)
            self.nodes.update_report()
        self.nodes.run_timers(self.now)
        self._deliver()

    def _deliver(self) -> None:
        """Deliver the arrived frames to the nodes."""
        while self._under_way and self._under_way[0][0] <= self.now:
            _, identifier, data = self._under_way.popleft()
            self.nodes.receive(identifier, data, self.now)

    def put(self, identifier: int, data: bytes = b"", length: int | None = None) -> None:
        """Put a frame on the wire, past all nodes."""
        self.queue.append(FRAME.pack(identifier, len(data) if length is None else length, data[:8]))

    def order(self, command: int, node: int) -> None:
        """Let another master command a node."""
        self.nodes.receive(0, bytes([command, node]), self.now)

    @property
    def in_force(self) -> Command:
        """The command that the valves obey, to the output's resolution."""
        command = self.nodes.plant.applied
        a, b, c = (round(opening, 4) + 0.0 for opening in command.valve)
        return command._replace(valve=(a, b, c))

    @property
    def commands(self) -> list[tuple[float, float, float, int]]:
        """Commands of the driver: three voltages and the outputs."""
        found = []
        for identifier, data in self.sent:
            if identifier == 0x20A:
                *counts, outputs = struct.unpack("<3hB", data)
                a, b, c = (count / 3276.7 for count in counts)
                found.append((a, b, c, outputs))
        return found

    def _from_node(self, identifier: int, data: bytes) -> None:
        for changed, content in self.meddle(identifier, data):
            self.put(changed, content)


def nodes_plan(
    plant: PlantParameters = PLANT, settings: CanopenSettings = SETTINGS, folder: Path = Path("/nowhere")
) -> NodesPlan:
    """Return the plan of nodes with `settings`; those in step need no folder."""
    s = settings
    return NodesPlan(
        s.interface, s.channel, s.bitrate, s.encoders.nodes, s.valve_node.node, plant, folder, START
    )


class DriverInStep(CanopenDriver):
    """The driver, waiting for its tick when it is read."""

    def __init__(self, wire: Wire, settings: CanopenSettings, counts_per_revolution: int = 2**17) -> None:
        super().__init__(
            settings,
            period=PERIOD,
            counts_per_revolution=counts_per_revolution,
            clock=lambda: wire.now,
            open_bus=wire.opened,
        )
        self.wire = wire

    def read(self, time: float) -> Readings:
        if self.operational or self.fault:
            self.wire.wait(time)
        return super().read(time)


def make(settings: CanopenSettings = SETTINGS, **changes: object) -> tuple[CanopenDriver, Wire]:
    """Return a closed driver and its wire."""
    wire = Wire()
    return DriverInStep(wire, replace(settings, **changes)), wire  # type: ignore[arg-type]


def settings_of(device: CanopenDevice) -> dict[tuple[int, int], bytes]:
    """Return the objects written by a master."""
    values, objects = device._values.items(), device._objects
    return {key: value for key, value in values if objects[key].writable and not objects[key].pdo_mappable}
