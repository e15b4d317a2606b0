"""What the process of the simulated nodes is started with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.base import Triple
from sim.faults import Fault
from sim.live.exchange import PlantPlan
from sim.plant import PlantParameters


@dataclass(frozen=True)
class NodesPlan:
    """What the process is started with."""

    interface: str
    """python-can's name of it."""
    channel: str
    bitrate: int
    encoders: tuple[int, int, int]
    """Node numbers, joints in their usual order."""
    valve_node: int
    plant: PlantParameters
    folder: Path
    """Of the plant's shared records, see `sim.live.exchange`."""
    angle: Triple | None = None
    """Joint angles at the start, rad; as the robot hangs when None."""
    priority: int = 0
    """SCHED_FIFO priority asked for; 0: none."""
    cpu: int = -1
    """The core it stays on; -1: any."""
    burst: int = 5
    """Most ticks of the plant made up at once after a stall."""
    faults: tuple[Fault, ...] = ()
    """What breaks; no onset by phase."""

    @property
    def plant_plan(self) -> PlantPlan:
        """What the plant is started with; its own valve node is out of work."""
        return PlantPlan(
            self.folder, self.plant, 1.0, self.angle, self.priority, self.cpu, self.burst, faults=self.faults
        )
