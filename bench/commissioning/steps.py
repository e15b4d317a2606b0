"""A step of commissioning: how it moves the machine, what its traces say, and the faults it may find."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from bench.commissioning.known_robot import FoundValue, KnownRobot
from bench.commissioning.machine import CommissionedMachine, MotionTrace
from bench.config import Configuration
from bench.errors import Refused
from bench.simulation.loads import Loads
from bench.simulation.series import Bench, Series, SeriesSwing
from bench.swing.profile import Profile
from sim.faults import Fault
from sim.impact import Delivery
from sim.plant import PlantParameters


class WrongMachine(Refused):
    """A step found the machine wrong; it was left passive. Exits with REFUSED."""


class SwingStopped(WrongMachine):
    """A swing that something stopped."""


class PredictionFails(WrongMachine):
    """The model of the robot as measured does not do the step; the robot itself has not moved."""


class PredictionStopped(PredictionFails, SwingStopped):
    """A swing that something stopped in the prediction."""


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


SWING_FILE, LEARNED_FILE = "swing.toml", "learned.toml"
"""The profile of 100 %, and with its learned correction."""

Traces = Mapping[str, MotionTrace]
"""Traces of a step by the name of what was done."""


class StepResult(NamedTuple):
    """What a step found."""

    values: tuple[FoundValue, ...]
    notes: tuple[str, ...] = ()
    """Findings for the report that are no values."""


class NamedStep(Protocol):
    """Name, title and bounds of any step."""

    @property
    def name(self) -> str:
        """Short name, part of file names."""

    @property
    def title(self) -> str:
        """Title of the findings, for the report."""

    @property
    def bounds_text(self) -> str:
        """How the energy is bounded, for the report."""


class SwingingStep(NamedStep, Protocol):
    """A step that swings the robot as it was measured."""

    def swing(
        self, robot: SwungRobot, known: Configuration, folder: Path, progress: Callable[[str], None]
    ) -> StepResult:
        """Swing `robot`, `known` as measured, leave files in `folder`, and give `progress` the present part.

        Raises:
            WrongMachine: the machine does not swing as a right one does.
            Refused: it does not come to its address.
        """


class CommissioningStep(NamedStep, Protocol):
    """A measuring step; measuring and estimating are separate: a stored trace can be estimated again."""

    def measure(self, machine: CommissionedMachine, known: KnownRobot) -> Traces:
        """Move the robot and return the traces; the robot is vented afterwards.

        Raises:
            WrongMachine: the machine does not do what a right one does.
            Refused: an interlock ended it.
        """

    def estimate(self, traces: Traces, known: KnownRobot) -> StepResult:
        """Return what `traces` say; a pure function of them.

        Raises:
            WrongMachine: they say that the machine is wrong.
        """
