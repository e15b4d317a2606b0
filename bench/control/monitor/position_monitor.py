"""Monitors of positions that are read back: encoder counts, the valves' spools and the guard's lock.

Encoders: a jump of a resting joint, and a jump where the index passes. Neither takes a model of the plant. A
joint at rest that turns by 0.01 rad within a tick would need an acceleration of 10,000 rad/s2. An incremental
encoder sets its count to zero at its index, in every pass: counts that were lost since the last one come back
there at once, as a step that ends at zero.

Spools: a model of second order, with the natural frequency and damping of the configured valve, follows the
applied commands. Bus and driver deliver commands and positions late, so a position is compared with the
model's range over the last RECENT ticks. Fitted feedback without a number counts as a deviation.

Guard's lock: a released lock reads unlocked within a second, whether the guard is opened or not. Feedback
that still reads locked, or reads locked with the guard open, is invalid from then on: the robot could move
behind an unlocked guard. It is valid again once it has read unlocked, as after a repair or at the next
release.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bench.base.lifecycle import Cause, Phase
from bench.control.estimate.air import move_spool
from drivers.base.compiled import compiled

AT_REST = 0.01
"""Max turn of a resting joint in a tick (rad)."""
AT_INDEX, IN_A_BLOW = 0.005, 0.05
"""Max angle deviation from the prediction when an index passes (rad): outside impact; during impact."""
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


RECENT = 4
"""Spool positions that span the model's range: the present one and those up to 3 ms old at 1 kHz."""
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
            move_spool(spools, plant, s.applied[i] - plant.centre[i], i, 2 * plant.substeps)
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


UNLOCKING = 1.0
"""Max time for lock and switch to follow (s): a bolt under load releases when the guard is pushed."""


@compiled
def monitor_guard_lock(s: Any, readings: Any, released: bool, time: float) -> None:
    """Compare the lock's feedback with the command; `released` was commanded in the last tick.

    A device that went passive locks the guard automatically.
    """
    r = readings[0]
    wrong = r.guard_locked and ((released and s.device_operational) or not r.guard_closed)
    if not wrong or s.tick <= 1:
        s.lock.agreed = time
    if not r.guard_locked:
        s.lock.wrong = False
    elif lock_is_late(s, time):
        s.lock.wrong = True


@compiled
def lock_is_late(s: Any, time: float) -> bool:
    """Return whether the lock's feedback contradicts command or guard, for too long."""
    return bool(time - s.lock.agreed > UNLOCKING)
