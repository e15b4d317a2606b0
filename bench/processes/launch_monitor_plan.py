"""What the launch monitor's process is started with."""

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
    """Made by the supervisor, sent to the process; it does not share its many imports."""

    run: str
    """Id of the bench's run."""
    ring: Path
    heartbeat: Path
    """Shared record of HEARTBEAT."""
    settings: LaunchMonitorSettings
    plant: PlantParameters
    air: Air
    wind: Wind
    turf: Turf
    wall: bool = True
    """The loop's time is CLOCK_MONOTONIC; otherwise virtual."""
