"""Parameters of the loop process."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.config import Configuration
from bench.lifecycle import Cause
from bench.swing.profile import Profile
from bench.telemetry.zero_shift import CalibratedShifts

RING_FILE, TIMING_FILE, SNAPSHOT_FILE = "ring", "timing", "snapshot"
"""Names of the files written by the loop in the bench's folder."""


@dataclass(frozen=True)
class LoopPlan:
    """Parameters sent by the supervisor to the loop process."""

    configuration: Configuration
    """Configuration with the calibration applied."""
    profile: Profile
    folder: Path
    """Shared-memory folder of the bench."""
    lock: int
    """Inherited descriptor of its locked file."""
    first_cause: Cause = Cause.POWER_UP
    """Cause of the initial ESTOP."""
    read_only: bool = False
    """Whether only the passive command is sent."""
    calibrated: CalibratedShifts | None = None
    """What the encoders said of their zeros at their calibration; None without one."""
