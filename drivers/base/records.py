"""Readings, commands and truth as records of compiled code and shared memory.

The contract itself does without numpy, so that clients of a bench do.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.base import Command, Readings

READINGS = np.dtype(
    [
        ("time", "f8"),
        ("encoder_count", "i8", (3,)),
        ("encoder_time", "f8", (3,)),
        ("encoder_valid", "u1", (3,)),
        ("encoder_age", "f8", (3,)),
        ("emergency_stop_clear", "?"),
        ("guard_closed", "?"),
        ("guard_locked", "?"),
        ("supply_pressure", "f8"),
        ("local_reset", "?"),
        ("ball_present", "?"),
        ("chamber_pressure", "f8", (6,)),
        ("encoder_indexed", "u1", (3,)),
        ("vent_open", "f8", (2,)),
        ("shut_off_open", "f8"),
        ("spool_position", "f8", (3,)),
    ],
    align=True,
)
"""`Readings` as a record for compiled code and shared memory, same names."""

COMMAND = np.dtype(
    [
        ("valve", "f8", (3,)),
        ("supply_enable", "?"),
        ("exhaust_closed", "?"),
        ("guard_lock", "?"),
        ("beacon", "?"),
        ("tee", "?"),
        ("search_index", "?"),
    ],
    align=True,
)
"""`Command` as a record for compiled code and shared memory, same names."""


TRUTH = np.dtype(
    [
        ("plant_angle", "f8", (3,)),
        ("plant_velocity", "f8", (3,)),
        ("plant_pressure", "f8", (6,)),
        ("plant_effort", "f8", (3,)),
        ("plant_head_position", "f8", (2,)),
        ("plant_head_speed", "f8"),
    ],
    align=True,
)
"""Fields of a cycle record that only a simulated plant knows, same names."""


def pack_readings(readings: Readings, record: np.ndarray[Any, Any]) -> None:
    """Write `readings` into a READINGS record (a one-element array); 1.2 us.

    Raises:
        TypeError, ValueError, OverflowError: a field is not of the record's kind, length or range.
    """
    record[0] = readings


def unpack_readings(record: np.ndarray[Any, Any]) -> Readings:
    """Return the Readings of a READINGS record in plain Python types; 1.7 us."""
    (
        time,
        count,
        sample_time,
        valid,
        age,
        stop,
        closed,
        locked,
        supply,
        reset,
        ball,
        chamber,
        indexed,
        vents,
        shut_off,
        spools,
    ) = record.item()
    v1, v2, v3 = valid.tolist()
    i1, i2, i3 = indexed.tolist()
    return Readings(
        time,
        tuple(count.tolist()),
        tuple(sample_time.tolist()),
        (v1 != 0, v2 != 0, v3 != 0),
        tuple(age.tolist()),
        stop,
        closed,
        locked,
        supply,
        reset,
        ball,
        tuple(chamber.tolist()),
        (i1 != 0, i2 != 0, i3 != 0),
        tuple(vents.tolist()),
        shut_off,
        tuple(spools.tolist()),
    )


def pack_command(command: Command, record: np.ndarray[Any, Any]) -> None:
    """Write `command` into a COMMAND record (a one-element array); 0.4 us.

    Raises:
        TypeError, ValueError: a field is not of the record's kind or length.
    """
    record[0] = command


def unpack_command(record: np.ndarray[Any, Any]) -> Command:
    """Return the Command of a COMMAND record in plain Python types; 0.8 us."""
    valve, supply_enable, exhaust_closed, guard_lock, beacon, tee, search_index = record.item()
    return Command(
        tuple(valve.tolist()), supply_enable, exhaust_closed, guard_lock, beacon, tee, search_index
    )
