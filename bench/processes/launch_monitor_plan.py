"""Parameters of the launch monitor process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.air import Air
from sim.flight import Wind
from sim.plant import PlantParameters
from sim.turf import Turf


@dataclass(frozen=True)
class LaunchMonitorPlan:
    """Parameters sent by the supervisor; a module of its own, without the imports of the process."""

    run: str
    """Id of the bench's run."""
    ring: Path
    heartbeat: Path
    """File of the HEARTBEAT record."""
    settings: LaunchMonitorSettings
    plant: PlantParameters
    air: Air
    wind: Wind
    turf: Turf
    club: str = "DR"
    """Code of the club in the player message to monitors."""
    wall: bool = True
    """Whether loop time is CLOCK_MONOTONIC; otherwise virtual."""
