"""Driver and simulated nodes in one process, in step: the wire is a queue, the clock counts.

Every SYNC is a tick: the plant moves on by one period. Waiting for a frame that does not come takes its time.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from drivers.base import Command
from drivers.can_bus import FRAME
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
from sim.node_plan import NodesPlan
from sim.nodes import BenchNodes
from sim.plant import PlantParameters

PERIOD = 0.001
PLANT = PlantParameters()
START = (0.2, 4.3, 6.0)
SETTINGS = CanopenSettings(interface="local_socket")

Meddler = Callable[[int, bytes], list[tuple[int, bytes]]]
"""What becomes of a node's frame on its way to the driver."""


class Wire:
    """The `drivers.canopen.link.FrameLink` of the driver, nodes behind it.

    `meddle` changes what nodes send, `sent` holds what the driver sent, `refuse` makes its sending fail.
    """

    def __init__(self, plan: NodesPlan | None = None) -> None:
        self.now = 0.0
        self.queue: deque[bytes] = deque()
        self.sent: list[tuple[int, bytes]] = []
        self.frame_time = 0.0
        """s that taking a frame lasts."""
        self.deaf = False
        """The driver's frames do not reach the nodes."""
        self.refuse: OSError | None = None
        self.break_receiving: OSError | None = None
        self.meddle: Meddler = lambda identifier, data: [(identifier, data)]
        self.open = False
        self.nodes = BenchNodes(plan or nodes_plan(), self._from_node)
        self.nodes.boot(self.now)

    # The driver's side

    def send_frame(self, frame: bytes) -> None:
        if self.refuse is not None:
            raise self.refuse
        identifier, length, data = FRAME.unpack(frame)
        self.sent.append((identifier, data[:length]))
        if identifier == 0x80:
            self.pass_time(PERIOD)
        if not self.deaf:
            self.nodes.hear(identifier, data[:length], self.now)

    def receive_frame(self, timeout: float) -> bytes | None:
        if self.break_receiving is not None:
            raise self.break_receiving
        self.now += self.frame_time
        if not self.queue and timeout:
            self.pass_time(max(timeout, 1e-6))
        return self.queue.popleft() if self.queue else None

    def shutdown(self) -> None:
        self.open = False

    # The world's side

    def pass_time(self, duration: float) -> None:
        """Let the plant move and the nodes' timers run."""
        end = self.now + duration
        while self.now < end - 1e-9:
            self.now = min(end, self.now + PERIOD)
            self.nodes.move(self.now)
            self.nodes.tell(self.now)
            self.nodes.run_timers(self.now)

    def put(self, identifier: int, data: bytes = b"", length: int | None = None) -> None:
        """Put a frame on the wire, past all nodes."""
        self.queue.append(FRAME.pack(identifier, len(data) if length is None else length, data[:8]))

    def order(self, command: int, node: int) -> None:
        """Let another master command a node."""
        self.nodes.hear(0, bytes([command, node]), self.now)

    @property
    def in_force(self) -> Command:
        """The command that the valves obey, to the output's resolution."""
        command = self.nodes.plant.node.applied
        a, b, c = (round(opening, 4) + 0.0 for opening in command.valve)
        return command._replace(valve=(a, b, c))

    @property
    def commands(self) -> list[tuple[float, float, float, int]]:
        """What the driver commanded: three voltages and the outputs."""
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


def nodes_plan(plant: PlantParameters = PLANT, settings: CanopenSettings = SETTINGS) -> NodesPlan:
    """Return the plan of nodes that need no folder."""
    return NodesPlan(
        settings.interface, settings.channel, settings.bitrate, settings.encoders.nodes,
        settings.valve_node.node, plant, Path("/nowhere"), angle=START,
    )  # fmt: skip


def make(settings: CanopenSettings = SETTINGS, **changes: object) -> tuple[CanopenDriver, Wire]:
    """Return a closed driver and its wire."""
    wire = Wire()
    driver = CanopenDriver(
        replace(settings, **changes),  # type: ignore[arg-type]
        period=PERIOD,
        clock=lambda: wire.now,
        open_bus=lambda settings, identifiers: _opened(wire),
    )
    return driver, wire


def _opened(wire: Wire) -> Wire:
    wire.open = True
    wire.queue.clear()
    return wire
