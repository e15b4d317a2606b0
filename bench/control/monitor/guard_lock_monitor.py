"""Monitor of the guard's lock: its feedback must follow the command.

A released lock reads unlocked within a second, whether the guard is opened or not. Feedback that still reads
locked, or reads locked with the guard open, is invalid from then on: the robot could move behind an unlocked
guard. It is valid again once it has read unlocked, as after a repair or at the next release.
"""

from __future__ import annotations

from typing import Any

from drivers.base.compiled import compiled

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
