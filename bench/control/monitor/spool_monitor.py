"""Monitoring of the valves' spools: the measured position against a model of the commanded one.

A model of second order, with the natural frequency and damping of the configured valve, follows the applied
commands. Bus and driver deliver commands and positions late, so a position is compared with the model's range
over the last RECENT ticks. Fitted feedback without a number counts as a deviation.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause
from bench.control.estimate.residual_monitor import move_spool
from drivers.base.compiled import compiled

RECENT = 4
"""Openings in the model's range: the present one and those of up to 3 ms ago at 1 kHz."""
_MAX_STEP = 0.05
"""Longest time that one tick moves the model, s; no spool is under way for longer."""


@compiled
def monitor_spools(s: Any, p: Any, plant: Any, readings: Any, step: float) -> None:
    """Judge the spools of CONTROL_STATE `s`, `step` s after the last tick, by ENVELOPE_PARAMETERS `p`."""
    spools = s.spools
    ticks = max(int(min(step, _MAX_STEP) / plant.tick + 0.5), 1)
    for i in range(3):
        shown = readings[0].spool_position[i]
        if not np.isnan(shown):
            spools.fitted[i] = 1
        if spools.fitted[i] == 0:
            continue
        for _ in range(ticks):
            move_spool(spools, plant, s.applied[i] - plant.centre[i], i)
        low = high = spools.spool[i]
        for k in range(RECENT - 1, 0, -1):
            spools.recent[k, i] = spools.recent[k - 1, i]
            low, high = min(low, spools.recent[k, i]), max(high, spools.recent[k, i])
        spools.recent[0, i] = spools.spool[i]
        # False with NaN and infinity.
        near = low - p.spool_tolerance <= shown <= high + p.spool_tolerance
        if near or not s.device_operational:
            spools.late[i] = max(spools.late[i] - plant.tick, 0.0)
        else:
            spools.late[i] = min(spools.late[i] + plant.tick, p.spool_timeout + plant.tick)
        if spools.late[i] > p.spool_timeout + 0.5 * plant.tick:
            spools.wrong[i] = 1
        elif spools.late[i] <= 0.0:
            spools.wrong[i] = 0


@compiled
def spool_cause(s: Any) -> int:
    """Return the cause that names the first spool that deviates from its command, or 0."""
    for i in range(3):
        if s.spools.wrong[i] != 0:
            return int(Cause.SHOULDER_SPOOL + i)
    return 0
