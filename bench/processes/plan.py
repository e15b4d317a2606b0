"""What the loop process is started with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bench.config import Configuration
from bench.lifecycle import Cause
from bench.swing.profile import Profile

RING_FILE, TIMING_FILE, SNAPSHOT_FILE = "ring", "timing", "snapshot"
"""Names of the files that the loop writes in the bench's folder."""


@dataclass(frozen=True)
class LoopPlan:
    """Made by the supervisor, sent to the loop process."""

    configuration: Configuration
    """With the calibration applied."""
    profile: Profile
    folder: Path
    """The bench's, of shared memory."""
    lock: int
    """Descriptor of its locked file, inherited."""
    first_cause: Cause = Cause.POWER_UP
    """Why the bench begins in ESTOP."""
    read_only: bool = False
    """Nothing but the passive command is given."""
