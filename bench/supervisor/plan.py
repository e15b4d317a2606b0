"""Parameters of the loop and the launch monitor processes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.base.lifecycle import Cause
from bench.config import Configuration
from bench.records.telemetry.encoder_preset import CalibratedShifts
from bench.swing.correction import Basis
from bench.swing.profile import Profile
from drivers.launch_monitor.settings import LaunchMonitorSettings
from sim.aerodynamics import Air
from sim.flight import Wind
from sim.ground import Turf
from sim.plant import PlantParameters

RING_FILE, TIMING_FILE, SNAPSHOT_FILE = "ring", "timing", "snapshot"
"""Names of the files written by the loop in the bench's folder."""


@dataclass(frozen=True)
class LoopPlan:
    """Parameters sent by the supervisor to the loop process."""

    configuration: Configuration
    """Configuration with the calibration applied."""
    profile: Profile
    basis: Basis
    """Basis of its corrections; passed, as computing it imports all of scipy's interpolation."""
    folder: Path
    """Shared-memory folder of the bench."""
    lock: int
    """Inherited descriptor of its locked file."""
    first_cause: Cause = Cause.POWER_UP
    """Cause of the initial ESTOP."""
    read_only: bool = False
    """Whether only the passive command is sent."""
    calibrated: CalibratedShifts | None = None
    """Zero shifts that the encoders reported at their calibration; None if not calibrated."""


@dataclass(frozen=True)
class LaunchMonitorPlan:
    """Parameters sent by the supervisor; a separate module, without the imports of the process."""

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
