"""A step of commissioning: how it moves the machine, and what its traces say."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

from bench.commissioning.known_robot import FoundValue, KnownRobot
from bench.commissioning.machine import CommissionedMachine, MotionTrace
from bench.commissioning.swung_robot import SwungRobot
from bench.config import Configuration

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
