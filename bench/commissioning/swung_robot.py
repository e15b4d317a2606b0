"""The robot under commissioning as one that swings: series of swings, with their loads where known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from bench.simulation.loads import Loads
from bench.simulation.series import Bench, Series, SeriesSwing
from bench.swing.profile import Profile
from sim.faults import Fault
from sim.impact import Delivery
from sim.plant import PlantParameters

Mark = tuple[float, float]
"""Ball's mark on the face, mm from its centre: towards the toe, and up."""
_READ = 0.5
"""mm to which a person reads a mark."""


def read_mark(delivery: Delivery | None) -> Mark | None:
    """Return the mark of a simulated `delivery` as a person reads it; None without one."""
    if delivery is None:
        return None
    toe, high = (_READ * round(1e3 * at / _READ) for at in (delivery.strike_x, delivery.strike_y))
    return toe, high


class SwingSeries(Protocol):
    """Swings at a ball, one after the other, from the same address."""

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, at a teed ball or without one, and come back to the address, also after a stop.

        Raises:
            Refused: the robot does not come back.
        """

    def loads(self) -> Loads | None:
        """Return the loads since the series was armed; None where nothing measures them."""

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of the last `swing` left on the face; None where it is not read."""


class SwungRobot(Protocol):
    """A robot that can be armed for swings."""

    def series(self, bench: Bench) -> SwingSeries:
        """Arm `bench`, whose model is the robot as it is known.

        Raises:
            Refused: the robot does not reach its address.
        """


class SimulatedSeries(Series):
    """Swings of the simulated plant, whose marks on the face are read."""

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        """Return the mark that the ball of `swing` left."""
        return read_mark(swing.delivery)


class SimulatedRobot:
    """The simulated plant that truly moves, with its faults."""

    def __init__(self, truth: PlantParameters, faults: Sequence[Fault] = ()) -> None:
        """Swing `truth` with `faults`."""
        self._truth, self._faults = truth, tuple(faults)

    def series(self, bench: Bench) -> SimulatedSeries:
        """Arm `bench` on it."""
        return SimulatedSeries(bench, self._truth, self._faults)
