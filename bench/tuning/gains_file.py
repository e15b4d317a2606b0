"""Tuned gains as a configuration file on top of the one they were tuned with."""

from __future__ import annotations

import json
from pathlib import Path

from bench.control.gains import Gains, Triple


def gains_file(gains: Gains, base: Path, how: str) -> str:
    """Return TOML with `gains`, on top of the file `base`; `how` names their origin."""

    def row(values: Triple) -> str:
        return "[" + ", ".join(f"{value:.6g}" for value in values) + "]"

    return f"""# Gains {how}. A profile's openings are planned for the gains it was designed with.
base = {json.dumps(str(base.resolve()))}

[control]
gains = "hand"
damping = {row(gains.damping)}
move_gain = {row(gains.move)}

[control.pid]
proportional = {row(gains.proportional)}
integral = {row(gains.integral)}
derivative = {row(gains.derivative)}
"""


def machine_gains_file(base: Path) -> str:
    """Return TOML on top of the file `base` with gains from the machine."""
    return f"""# Gains by pose, from the robot's linearised loops. Design again what was designed with others.
base = {json.dumps(str(base.resolve()))}

[control]
gains = "machine"
"""
