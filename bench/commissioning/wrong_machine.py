"""The machine is not as it should be: the fault found, and its remedy."""

from __future__ import annotations

from bench.errors import Refused


class WrongMachine(Refused):
    """A step found the machine wrong; it was left passive. Exits with REFUSED."""
