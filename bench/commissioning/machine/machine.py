"""What moves the robot in commissioning: bounded sequences of valve openings, and the record of each.

A step describes a motion as segments and bounds; a `CommissionedMachine` runs them tick by tick and returns
what its sensors gave. Whatever ends a sequence early, the machine is passive then: spools centred, supply
shut, vents open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.base import CHAMBERS, JOINTS, Command, Triple

Array = NDArray[np.float64]


class Until(NamedTuple):
    """Condition that ends a segment before its time."""

    kind: Literal["above", "moved", "rested"]
    """Pressure of chamber `number` above `level` (Pa); joint `number` turned by `level` (rad) since the
    sequence began; joint `number` at rest for `level` (s)."""
    number: int
    level: float


class Segment(NamedTuple):
    """A time of constant or evenly changing valve commands."""

    duration: float
    """Max duration, s."""
    valve: Triple
    """Valve commands at its start."""
    end: Triple | None = None
    """Valve commands at its end, reached evenly; None: as at its start."""
    vents_shut: bool = False
    until: Until | None = None


class MotionBounds(NamedTuple):
    """Limits of a sequence; beyond one of them the machine is made passive."""

    speed: Triple
    """Max speed of each joint, rad/s by its encoder."""
    travel: Triple
    """Max displacement of each joint since the start of the sequence, by its encoder (rad)."""
    pressure: float
    """Max pressure of a chamber, Pa absolute; infinite: no sensor is needed."""
    opening: float = 0.35
    """Max opening of a valve."""
    duration: float = 60.0
    """Max duration of a sequence, s."""


DRIFT = 4.0
"""Max speed of a joint whose spool may be off its centre, rad/s; robots of the range were seen up to 2."""
ADRIFT = MotionBounds((DRIFT,) * 3, (np.inf,) * 3, np.inf)
"""Bounds of a robot whose valves are not measured yet, while its spools are centred with air on."""


class PassedBound(NamedTuple):
    """A bound that a motion passed."""

    text: str
    way_of: int | None = None
    """Joint whose way it bounds; None for a bound of something else."""


@dataclass(frozen=True, eq=False)
class MotionTrace:
    """Sensor readings and commands of a sequence, one row a tick."""

    time: Array
    """(n,) s."""
    first_count: NDArray[np.int64]
    """(3,) counts of the first row."""
    count: NDArray[np.int64]
    """(n, 3) counts since the first row, unwrapped."""
    pressure: Array
    """(n, 6) Pa absolute, in the order of CHAMBERS; invalid ones lie between their neighbours."""
    supply: Array
    """(n,) Pa absolute, likewise."""
    valve: Array
    """(n, 3) openings commanded from this row on."""
    vents_shut: NDArray[np.bool_]
    """(n,) whether the vents are commanded shut from this row on."""
    segment: NDArray[np.int64]
    """Index of the segment (n,)."""
    tripped: PassedBound | None = None
    """Bound that ended the sequence."""
    ended: tuple[bool, ...] = ()
    """Whether the condition of each segment ended it."""

    def of_segment(self, *numbers: int) -> NDArray[np.bool_]:
        """Return the rows (n,) of segments `numbers`."""
        return np.isin(self.segment, numbers)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return its arrays by name, for a file."""
        names = ("time", "first_count", "count", "pressure", "supply", "valve", "vents_shut", "segment")
        return {name: getattr(self, name) for name in names}


_REST = 5e-4
"""Max movement of a joint at rest (rad)."""


_ROW = np.dtype(
    [
        *(("time", "f8"), ("count", "i8", 3), ("pressure", "f8", 6), ("supply", "f8")),
        *(("valve", "f8", 3), ("vents_shut", "?"), ("segment", "i8")),
    ]
)
"""Row of a log; its columns are those of `MotionTrace`."""


class MotionLog:
    """Rows of a sequence as they come."""

    def __init__(self, rows: int, counts: int) -> None:
        self._rows, self._counts, self._n = np.zeros(rows, _ROW), counts, 0
        self._count, self._first = self._rows["count"], np.zeros(3, np.int64)

    @property
    def full(self) -> bool:
        """Whether no row is left."""
        return self._n >= len(self._rows)

    def note(self, readings: np.ndarray[Any, Any], command: Command, segment: int) -> None:
        """Add a row."""
        r, n, turned = readings[0], self._n, np.zeros(3, np.int64)
        count = np.asarray(r["encoder_count"], np.int64)
        if n == 0:
            self._first = count.copy()
        else:
            before, half = self._count[n - 1], self._counts // 2
            turned = before + (count - before - self._first + half) % self._counts - half
        air = r["chamber_pressure"], r["supply_pressure"]
        self._rows[n] = (r["time"], turned, *air, command.valve, command.exhaust_closed, segment)
        self._n = n + 1

    def way(self) -> Array:
        """Return the way (3,) rad since the first row."""
        return np.asarray(self._count[max(self._n - 1, 0)] * (2 * np.pi / self._counts))

    def rested(self, span: int, joint: int | None = None) -> bool:
        """Return whether `joint`, or each, has rested for `span` rows."""
        if self._n <= span:
            return False
        counts = self._count[self._n - 1 - span : self._n]
        counts = counts if joint is None else counts[:, [joint]]
        return bool(np.max(np.ptp(counts, axis=0)) * (2 * np.pi / self._counts) < _REST)

    def motion(self, tripped: PassedBound | None, ended: tuple[bool, ...], tick: float) -> LoggedMotion:
        """Return the rows so far, one a `tick` (s) unless some were missed."""
        return LoggedMotion(self._rows[: self._n], self._first, tripped, ended, tick)


class LoggedMotion(NamedTuple):
    """A sequence as it was logged. Its trace takes milliseconds to make, for which no machine waits."""

    rows: NDArray[Any]
    """(n,) records of _ROW."""
    first_count: NDArray[np.int64]
    tripped: PassedBound | None
    ended: tuple[bool, ...]
    tick: float
    """Period of the rows, s."""

    def trace(self) -> MotionTrace:
        """Return the trace, a row a tick: rows that a busy machine missed lie between their neighbours."""
        rows, n = self.rows, len(self.rows)
        at = np.arange(n, dtype=float)
        if n > 1:
            number = np.round((rows["time"] - rows["time"][0]) / self.tick)
            wanted = np.arange(number[-1] + 1.0)
            if len(wanted) != n:
                at = np.interp(wanted, number, at)
        time = rows["time"]
        pressure, supply = (at_rows(_bridged(rows[name], time), at) for name in ("pressure", "supply"))
        count = np.round(at_rows(rows["count"], at)).astype(np.int64)
        valve, shut, segment = (
            rows[name][at.astype(np.int64)] for name in ("valve", "vents_shut", "segment")
        )
        return MotionTrace(
            at_rows(time, at),
            self.first_count,
            count,
            pressure,
            supply,
            valve,
            shut,
            segment,
            self.tripped,
            self.ended,
        )


def _bridged(table: Array, time: Array) -> Array:
    """Return `table` (n,) or (n, c) at `time` (n,), invalid values between the valid ones of the column."""
    if table.ndim == 2:
        return np.column_stack([_bridged(column, time) for column in table.T])
    valid = np.isfinite(table)
    return np.interp(time, time[valid], table[valid]) if valid.any() and not valid.all() else table


def at_rows(table: NDArray[Any], rows: NDArray[Any]) -> Array:
    """Return the values of `table` (n,) or (n, c) at fractional `rows` (k,)."""
    if table.ndim == 1:
        return np.asarray(np.interp(rows, np.arange(len(table)), table))
    return np.column_stack([at_rows(column, rows) for column in table.T])


class CommissionedMachine(Protocol):
    """Robot under commissioning, as the measuring steps see it."""

    def set_supply(self, pressure: float) -> None:
        """Set the pressure regulator to `pressure` (Pa absolute); infinite: as in service."""

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds, doing: str = "") -> MotionTrace:
        """Run `segments` with the supply on; afterwards the last openings stay in force.

        The machine is passive after a bound was passed. `doing` announces the motion to persons.

        Raises:
            Refused: emergency stop, guard or device end the work.
        """

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Be passive until chambers are empty and joints rest, for at most `duration` (s).

        Raises:
            MachineFault: the chambers are not empty then.
        """


def bound_passed(bounds: MotionBounds, speed: Array, way: Array, pressure: Array) -> PassedBound | None:
    """Return the bound that `speed` (3,), `way` (3,) or `pressure` (6,) passes.

    An invalid pressure passes none: the machine itself ends a motion whose sensors do not recover.
    """
    for i, joint in enumerate(JOINTS):
        if not abs(speed[i]) <= bounds.speed[i]:
            text = f"speed of the {joint} {abs(speed[i]):.1f} rad/s, bound {bounds.speed[i]:.1f} rad/s"
            return PassedBound(text)
        if not abs(way[i]) <= bounds.travel[i]:
            text = f"way of the {joint} {abs(way[i]):.2f} rad, bound {bounds.travel[i]:.2f} rad"
            return PassedBound(text, way_of=i)
    for k, chamber in enumerate(CHAMBERS):
        if bounds.pressure < pressure[k] < np.inf:
            text = (
                f"pressure of {chamber} {1e-5 * pressure[k]:.2f} bar, bound {1e-5 * bounds.pressure:.2f} bar"
            )
            return PassedBound(text)
    return None
