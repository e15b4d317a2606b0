"""Stories of the adversary: a bench, and what people, network and nature do to it, step by step.

A story is data: the steps are those that were done, so that it plays again without the draws that made it,
and so that steps can be left out of it.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from math import isnan
from pathlib import Path
from typing import Any

from sim.faults import Fault

Step = tuple[str, Any, Any]
"""Action, object and value: see `tests.adversary.player.Player.do`."""


@dataclass(frozen=True)
class Setup:
    """The bench of a story."""

    configuration: str = "shipped"
    """Name of a configuration of golfbench; its profile is the one used."""
    incremental: bool = False
    """Encoders count from power-up, homed by their index."""
    sensors: bool = True
    """The chambers have pressure sensors."""
    check: bool = True
    """The model-based check is on."""
    local_reset: bool = True
    series: bool = False
    warning_time: float = 1.0
    armed_timeout: float = 120.0
    turned: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """rad from the hanging pose at power-up."""
    seed: int = 1
    """Seed of the faults' random numbers."""


@dataclass(frozen=True)
class Story:
    """A bench and the steps done with it."""

    setup: Setup = field(default_factory=Setup)
    steps: tuple[Step, ...] = ()
    found: str = ""
    """Violation at the time of discovery."""

    def with_steps(self, steps: tuple[Step, ...]) -> Story:
        """Return the story with other steps."""
        return replace(self, steps=steps)

    def to_text(self) -> str:
        """Return the story as JSON, one step a line."""
        lines = ",\n  ".join(json.dumps(step) for step in self.steps)
        head = json.dumps(asdict(self.setup))
        return f'{{"found": {json.dumps(self.found)},\n "setup": {head},\n "steps": [\n  {lines}\n ]}}\n'


def read_story(path: Path) -> Story:
    """Return the story in the JSON file `path`."""
    tree = json.loads(path.read_text())
    setup = dict(tree["setup"])
    setup["turned"] = tuple(setup["turned"])
    return Story(Setup(**setup), tuple((a, b, c) for a, b, c in tree["steps"]), tree["found"])


def fault_entry(fault: Fault) -> dict[str, Any]:
    """Return `fault` as JSON takes it; NaN is left out."""
    entry = {name: value for name, value in asdict(fault).items() if name != "name"}
    return {n: v for n, v in entry.items() if not (isinstance(v, float) and isnan(v))}


def fault_of(entry: dict[str, Any]) -> Fault:
    """Return the fault of a step."""
    return Fault(name=entry["signal"], **entry)
