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

from drivers.base import CHAMBERS, JOINTS, Triple

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
    """Max way of each joint from where the sequence began, rad by its encoder."""
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
    """(n, 6) Pa absolute, in the order of CHAMBERS."""
    supply: Array
    """(n,) Pa absolute."""
    valve: Array
    """(n, 3) openings commanded from this row on."""
    vents_shut: NDArray[np.bool_]
    """(n,) whether the vents are commanded shut from this row on."""
    segment: NDArray[np.int64]
    """(n,) number of the segment."""
    tripped: PassedBound | None = None
    """Bound that ended the sequence."""
    ended: tuple[bool, ...] = ()
    """Whether the condition of each segment ended it."""

    def angle(self, counts_per_revolution: int) -> Array:
        """Return the encoders' angles (n, 3) rad since the first row, as the encoders count."""
        return np.asarray(self.count * (2 * np.pi / counts_per_revolution))

    def of_segment(self, *numbers: int) -> NDArray[np.bool_]:
        """Return the rows (n,) of segments `numbers`."""
        return np.isin(self.segment, numbers)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return its arrays by name, for a file."""
        names = ("time", "first_count", "count", "pressure", "supply", "valve", "vents_shut", "segment")
        return {name: getattr(self, name) for name in names}


class CommissionedMachine(Protocol):
    """Robot under commissioning, as its sensors and valves show it."""

    @property
    def time(self) -> float:
        """Time since the machine was made ready, s."""

    def set_supply(self, pressure: float) -> None:
        """Set the pressure regulator to `pressure` (Pa absolute); infinite: as in service."""

    def run(self, segments: tuple[Segment, ...], bounds: MotionBounds) -> MotionTrace:
        """Run `segments` with the supply on; afterwards the last openings stay in force.

        The machine is passive after a bound was passed.

        Raises:
            Refused: emergency stop, guard or device end the work.
        """

    def vent(self, duration: float = 40.0) -> MotionTrace:
        """Be passive until chambers are empty and joints rest, for at most `duration` (s).

        Raises:
            MachineFault: the chambers are not empty then.
        """

    def make_passive(self) -> None:
        """Centre the spools, shut the supply, open the vents; never raises."""


def bound_passed(bounds: MotionBounds, speed: Array, way: Array, pressure: Array) -> PassedBound | None:
    """Return the bound that `speed` (3,), `way` (3,) or `pressure` (6,) passes."""
    for i, joint in enumerate(JOINTS):
        if not abs(speed[i]) <= bounds.speed[i]:
            text = f"speed of the {joint} {abs(speed[i]):.1f} rad/s, bound {bounds.speed[i]:.1f} rad/s"
            return PassedBound(text)
        if not abs(way[i]) <= bounds.travel[i]:
            text = f"way of the {joint} {abs(way[i]):.2f} rad, bound {bounds.travel[i]:.2f} rad"
            return PassedBound(text, way_of=i)
    for k, chamber in enumerate(CHAMBERS):
        if bounds.pressure < np.inf and not pressure[k] <= bounds.pressure:
            text = (
                f"pressure of {chamber} {1e-5 * pressure[k]:.2f} bar, bound {1e-5 * bounds.pressure:.2f} bar"
            )
            return PassedBound(text)
    return None
