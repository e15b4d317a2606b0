"""The machine is not as it should be: the fault found, and its remedy."""

from __future__ import annotations

from bench.errors import Refused


class WrongMachine(Refused):
    """A step found the machine wrong; it was left passive. Exits with REFUSED."""


class SwingStopped(WrongMachine):
    """A swing that something stopped."""


class PredictionFails(WrongMachine):
    """The model of the robot as measured does not do the step; the robot itself has not moved."""


class PredictionStopped(PredictionFails, SwingStopped):
    """A swing that something stopped in the prediction."""
