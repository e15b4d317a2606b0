"""The robot under commissioning as one that swings: series of swings, with their loads where known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from bench.simulation.loads import Loads
from bench.simulation.series import Bench, Series, SeriesSwing
from bench.swing.profile import Profile
from sim.faults import Fault
from sim.plant import PlantParameters


class SwingSeries(Protocol):
    """Swings at a ball, one after the other, from the same address."""

    def swing(self, profile: Profile, *, ball: bool = True) -> SeriesSwing:
        """Swing `profile`, at a teed ball or without one, and come back to the address, also after a stop.

        Raises:
            Refused: the robot does not come back.
        """

    def loads(self) -> Loads | None:
        """Return the loads since the series was armed; None where nothing measures them."""


class SwungRobot(Protocol):
    """A robot that can be armed for swings."""

    def series(self, bench: Bench) -> SwingSeries:
        """Arm `bench`, whose model is the robot as it is known.

        Raises:
            Refused: the robot does not reach its address.
        """


class SimulatedRobot:
    """The simulated plant that truly moves, with its faults."""

    def __init__(self, truth: PlantParameters, faults: Sequence[Fault] = ()) -> None:
        """Swing `truth` with `faults`."""
        self._truth, self._faults = truth, tuple(faults)

    def series(self, bench: Bench) -> Series:
        """Arm `bench` on it."""
        return Series(bench, self._truth, self._faults)
