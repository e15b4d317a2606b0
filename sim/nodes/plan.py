"""Parameters of the process of the simulated nodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.base import Triple
from sim.faults import Fault
from sim.nodes.personality import Personality
from sim.plant import PlantParameters


@dataclass(frozen=True)
class NodesPlan:
    """Parameters of the process."""

    interface: str
    """python-can interface name."""
    channel: str
    bitrate: int
    encoders: tuple[int, int, int]
    """Node numbers in the order of the joints."""
    valve_node: int
    plant: PlantParameters
    folder: Path
    """Folder of the plant's shared records, see `sim.live.exchange`."""
    angle: Triple | None = None
    """Joint angles at the start, rad; None for the hanging pose."""
    priority: int = 0
    """Requested SCHED_FIFO priority; 0 for none."""
    cpu: int = -1
    """Processor core; -1 for any."""
    max_catch_up: int = 25
    """Max plant ticks caught up at once after a stall: more than a valve node's watchdog time."""
    faults: tuple[Fault, ...] = ()
    """Faults; no onset by phase."""
    encoder_personality: Personality | None = None
    """Device family that all encoders play; None for the plain one of the EDS file."""
    io_personality: Personality | None = None
    """Device family that the valve node plays; None for the plain one of the EDS file."""
