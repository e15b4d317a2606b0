"""Encoders whose zero was moved inside the device after their calibration.

A preset set with a device's own tool shifts the joint angle that the bench computes by as much. The current
presets and offsets of the devices are compared with those at the calibration before anything moves.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from drivers.base import JOINTS

ZERO_SHIFT_FILE = "zero-shifts"
"""Name of the file in a running bench's folder with the presets and offsets of its devices."""

Shifts = tuple[str, str, str]
"""Preset and offset of each device; empty if it reports none."""

_ACTION = (
    "restore it with the device's own tool, or calibrate again: golfbench run --read-only, then golfbench "
    "calibrate encoders"
)


@dataclass(frozen=True)
class CalibratedShifts:
    """Presets and offsets of the devices when their encoders were calibrated."""

    name: str
    """Calibration, for messages."""
    shifts: Shifts


def moved_zero(joint: int, found: str, calibrated: CalibratedShifts) -> str:
    """Return why the device of `joint` is not as it was calibrated, with the action; empty if it is."""
    then = calibrated.shifts[joint]
    if found == then:
        return ""
    known = then or "unknown, as no bench was running when it was entered"
    return (
        f"encoder of the {JOINTS[joint]}: found {found or 'neither preset nor offset'}, expected the values "
        f"at {calibrated.name}: {known}. Its zero may have moved: {_ACTION}"
    )


def write_shifts(folder: Path, shifts: Shifts) -> None:
    """Write the devices' presets and offsets for other processes; the folder is in memory."""
    new = folder / f"{ZERO_SHIFT_FILE}.new"
    new.write_text(json.dumps(shifts), encoding="utf-8")
    new.replace(folder / ZERO_SHIFT_FILE)


def read_shifts(folder: Path) -> Shifts | None:
    """Return presets and offsets of the bench running in `folder`; None without a bench or a report."""
    try:
        shoulder, arm, wrist = json.loads((folder / ZERO_SHIFT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return None
    return str(shoulder), str(arm), str(wrist)
