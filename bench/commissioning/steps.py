"""A step of commissioning: how it moves the machine, and what its traces say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from bench.commissioning.known_robot import FoundValue, KnownRobot
from bench.commissioning.machine import CommissionedMachine, MotionTrace

Traces = Mapping[str, MotionTrace]
"""Traces of a step by the name of what was done."""


class StepResult(NamedTuple):
    """What a step found."""

    values: tuple[FoundValue, ...]
    notes: tuple[str, ...] = ()
    """Findings for the report that are no values."""


class CommissioningStep(Protocol):
    """One step; measuring and estimating are separate, so that a stored trace can be estimated again."""

    @property
    def name(self) -> str:
        """Short name, part of file names."""

    @property
    def title(self) -> str:
        """Title of the findings, for the report."""

    @property
    def bounds_text(self) -> str:
        """How the energy is bounded, for the report."""

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
