"""Watch over counts that an encoder lost: a jump of a resting joint, and a jump where the index passes.

Neither takes a model of the plant. A joint at rest that turns by 0.01 rad within a tick would need an
acceleration of 10,000 rad/s2. An incremental encoder sets its count to zero at its index, in every pass:
counts that were lost since the last one come back there at once, as a step that ends at zero.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from drivers.base.compiled import compiled

AT_REST = 0.01
"""Max turn of a resting joint in a tick (rad)."""
AT_INDEX, IN_A_BLOW = 0.005, 0.05
"""Max turn of a moving joint in a tick beyond its velocity's (rad); while the ball is struck."""
_COUNTS = 2.0
"""Counts of rounding."""


@compiled
def resting_jump(e: Any) -> int:
    """Return the cause that names the encoder of a resting joint that jumped in this tick, or 0."""
    for i in range(3):
        if abs(e.innovation[i]) > AT_REST:
            return Cause.SHOULDER_JUMP + i
    return 0


@compiled
def index_cause(s: Any, p: Any, encoder: Any, parameters: Any, e: Any) -> int:
    """Return the cause that names the encoder whose count was wrong when its index passed now, or 0.

    `encoder` is ENCODER_STATE, `parameters` ENCODER_PARAMETERS.
    """
    if not (p.home_by_index and s.homed):
        return 0
    bound = IN_A_BLOW if s.phase == Phase.IMPACT else AT_INDEX
    for i in range(3):
        if encoder.fresh[i] == 0 or encoder.zero_set[i] != 0 or not abs(e.innovation[i]) > bound:
            continue
        span, per_radian = parameters.count_range[i], parameters.counts_per_revolution[i] / (2.0 * np.pi)
        beside = (encoder.unwrapped[i] + span // 2) % span - span // 2
        if abs(beside) <= abs(e.velocity[i]) * s.measured_step * per_radian + _COUNTS:
            return Cause.SHOULDER_INDEX + i
    return 0
