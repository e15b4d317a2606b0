"""One shot of a series: its settings, its measurements, the source of each figure; the table of shots.

The table is CSV (RFC 4180): comma, CRLF, UTF-8, decimal point, one header row. Floats are written in
positional notation with the fewest digits that read back to the same float; an absent figure is an empty
cell; times are UTC in ISO 8601. A text that a spreadsheet would take for a formula has an apostrophe in
front.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from enum import StrEnum
from math import degrees, isfinite, pi
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from drivers.base import Launch
    from sim.flight import Flight
    from sim.impact import Delivery


class ShotStatus(StrEnum):
    """Status of a shot."""

    VALID = "valid"
    EXCLUDED = "excluded"
    """Hit, but the delivery was outside its bounds: counted and shown, not compared."""
    FAILED = "failed"
    """Not hit: no ball, a fault, a stop."""


@dataclass(frozen=True)
class Shot:
    """One shot as a row of the exported table; the fields are its columns, in order.

    Units stand in the names. Angles follow `sim/impact.py`: attack positive up, club path, face angle,
    direction and spin axis positive to the right of the target line, strike positive towards the toe
    and up from the centre of the face. A figure that was not measured is None, never zero; the sources
    name the sources of the delivery, launch and carry figures ("" without figures). `carry_source` says
    which carry `carry_m` is: "reference", "monitor", "measured" (the columns below), or "simulated", the
    flight of the simulated ball.
    """

    shot: int
    block: int
    position: int
    """Place in the block's order, from 1."""
    club: str
    ball: str
    status: ShotStatus
    reason: str = ""
    club_speed_mps: float | None = None
    attack_angle_deg: float | None = None
    club_path_deg: float | None = None
    face_angle_deg: float | None = None
    dynamic_loft_deg: float | None = None
    strike_x_mm: float | None = None
    strike_y_mm: float | None = None
    ball_speed_mps: float | None = None
    launch_angle_deg: float | None = None
    direction_deg: float | None = None
    spin_rpm: float | None = None
    spin_axis_deg: float | None = None
    carry_m: float | None = None
    total_m: float | None = None
    apex_m: float | None = None
    landing_angle_deg: float | None = None
    delivery_source: str = ""
    launch_source: str = ""
    carry_source: str = ""
    time_utc: datetime = datetime(1970, 1, 1, tzinfo=UTC)
    """Begin of its swing."""
    carry_side_m: float | None = None
    """Distance of the ball's landing from the target line, positive to the right."""
    swing: str = ""
    role: str = "test"
    """"test", "control" or "warm-up"."""
    section: int = 1
    attempt: int = 1
    """Number of the attempt, from 1; an invalid shot is repeated."""
    sample: int = 0
    """Number of the physical ball; 0 if balls are not distinguished."""
    air_temperature_k: float | None = None
    air_pressure_pa: float | None = None
    relative_humidity: float | None = None
    carry_reference_m: float | None = None
    """Carry flown from the launch with the reference ball's aerodynamics, all balls alike."""
    carry_monitor_m: float | None = None
    """Carry as the launch monitor reported it."""
    carry_measured_m: float | None = None
    """Carry flown with the aerodynamic coefficients measured on this ball."""
    carry_measured_error_m: float | None = None
    """Standard uncertainty of `carry_measured_m` from its coefficients, common to all shots of the ball."""
    flight_source: str = ""
    """Source of total, apex, landing angle and side; empty: that of `carry_m`."""
    gate_figure: str = ""
    """First metric outside the campaign's gate: a field of `bench.campaign.plan.gate.Centre`, or empty."""

    def __post_init__(self) -> None:
        """Refuse values a table cannot hold: non-finite figures, times without zone, a missing reason."""
        for name, value in vars(self).items():
            if isinstance(value, float) and not isfinite(value):
                raise ValueError(f"{name} is {value}; a figure that is not known is None")
        if self.time_utc.utcoffset() is None:
            raise ValueError(f"time_utc {self.time_utc} has no time zone")
        if (self.status is ShotStatus.VALID) == bool(self.reason):
            raise ValueError(f"status {self.status} with reason {self.reason!r}: only valid shots have none")


def delivery_columns(delivery: Delivery | None) -> dict[str, Any]:
    """Return the columns of `delivery` (SI, radians); empty without one."""
    if delivery is None:
        return {}
    return {
        "club_speed_mps": delivery.speed,
        "attack_angle_deg": degrees(delivery.attack_angle),
        "club_path_deg": degrees(delivery.path),
        "face_angle_deg": degrees(delivery.face_angle),
        "dynamic_loft_deg": degrees(delivery.dynamic_loft),
        "strike_x_mm": 1e3 * delivery.strike_x,
        "strike_y_mm": 1e3 * delivery.strike_y,
        "delivery_source": delivery.source,
    }


def launch_columns(launch: Launch | None, source: str) -> dict[str, Any]:
    """Return the columns of `launch` from `source`; empty without one."""
    if launch is None:
        return {}
    return {
        "ball_speed_mps": launch.speed,
        "launch_angle_deg": degrees(launch.launch_angle),
        "direction_deg": degrees(launch.direction),
        "spin_rpm": launch.spin * 30 / pi,
        "spin_axis_deg": degrees(launch.spin_axis),
        "launch_source": source,
    }


def flight_columns(flight: Flight | None, carry_source: str = "") -> dict[str, Any]:
    """Return the columns of `flight`, with its carry if that has a source; empty without one."""
    if flight is None:
        return {}
    carry = {"carry_m": flight.carry, "carry_source": carry_source} if carry_source else {}
    return carry | {
        "total_m": flight.total,
        "apex_m": flight.apex,
        "landing_angle_deg": degrees(flight.landing_angle),
        "carry_side_m": flight.carry_side,
    }


COLUMNS = tuple(field.name for field in fields(Shot))
"""Names of the columns of the shot table, in order; the export format of a campaign."""


@dataclass(frozen=True)
class ShotRecord:
    """A shot, its cycles (n records of CYCLE) and, when the ball flew, its flight."""

    shot: Shot
    cycles: np.ndarray[Any, Any] = field(repr=False, compare=False)
    flight: Flight | None = None

    @property
    def valid(self) -> bool:
        """The shot counts in comparisons."""
        return self.shot.status is ShotStatus.VALID


def shot_table_text(shots: Sequence[Shot]) -> str:
    """Return the table of `shots` as text, one row each."""
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow(COLUMNS)
    table.writerows(map(_to_cell, vars(shot).values()) for shot in shots)
    return text.getvalue()


_FORMULA = re.compile("'*[=+\\-@\t\r]")
"""Beginning of a text that a spreadsheet would take for a formula, with apostrophes put in front already."""


def _to_cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat(timespec="microseconds").replace("+00:00", "Z")
    if isinstance(value, float):
        from numpy import format_float_positional  # commands of a running bench do without numpy

        return format_float_positional(value, unique=True, trim="0")
    if isinstance(value, str) and _FORMULA.match(value):
        return f"'{value}"
    return str(value)
