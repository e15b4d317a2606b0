"""Encoders whose zero was moved inside the device after their calibration.

A preset set with a device's own tool turns the joint that the bench believes in by as much. It is found by
comparing what the devices say of their zeros now with what they said at the calibration, before anything
moves.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from drivers.base import JOINTS

ZERO_SHIFT_FILE = "zero-shifts"
"""Name of the file in a running bench's folder with what its devices said."""

Shifts = tuple[str, str, str]
"""What each device says of preset and offset; empty if it does not know of any."""

_ACTION = (
    "restore it with the device's own tool, or calibrate again: golfbench run --read-only, then golfbench "
    "calibrate encoders"
)


@dataclass(frozen=True)
class CalibratedShifts:
    """What the devices said when their encoders were calibrated."""

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
        f"encoder of the {JOINTS[joint]}: found {found or 'neither preset nor offset'}, expected what it was "
        f"at {calibrated.name}: {known}. Its zero may have moved: {_ACTION}"
    )


def write_shifts(folder: Path, shifts: Shifts) -> None:
    """Write what the devices say for other processes; the folder is in memory."""
    new = folder / f"{ZERO_SHIFT_FILE}.new"
    new.write_text(json.dumps(shifts), encoding="utf-8")
    new.replace(folder / ZERO_SHIFT_FILE)


def read_shifts(folder: Path) -> Shifts | None:
    """Return what the devices of the bench running in `folder` said; None without a bench or their word."""
    try:
        shoulder, arm, wrist = json.loads((folder / ZERO_SHIFT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return None
    return str(shoulder), str(arm), str(wrist)
