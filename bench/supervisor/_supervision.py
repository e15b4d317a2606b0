"""Orders of the supervisor to the loop: heartbeat, permissions, requests, learned corrections."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numba import carray

from bench.base.lifecycle import Request
from bench.control.step_records import CONTROL_STATE
from bench.supervisor.child_process import CORRECTED, CORRECTED_FILE, CORRECTION, CORRECTION_FILE, weights_of
from bench.swing.correction import Basis
from bench.swing.profile import Profile
from drivers.base.compiled import IS_PLAIN, compiled, compiled_with_arrays, new_record, numbers
from drivers.base.compiled_slots import fetch_record, slots_at
from drivers.base.native import pointer
from drivers.base.shared_memory import HEAD_WORD, READ, SharedRecord

SUPERVISION_FILE = "supervision"

SUPERVISION = np.dtype(
    [
        ("heartbeat", "i8"),
        ("lease", "i8"),
        ("support_ready", "?"),
        ("shutdown", "?"),
        ("request", "u1"),
        ("request_number", "i8"),
        ("request_lease", "i8"),
        ("stop_count", "i8"),
        ("emergency_stop_count", "i8"),
    ],
    align=True,
)
"""`heartbeat` changes while the supervisor lives. `lease` is the number of the lease that counts, 0 while
none is held. A request is new when its number is, and made under `request_lease`; stops are counted
apart and never wait behind one. `shutdown` ends the loop, as soon as the robot stands."""


_UNREAD = -1
"""Version that makes the next tick read every value."""
_MEMORY = np.dtype(
    [
        ("version", "i8"),
        ("alive", "i8"),
        ("silence", "f8"),
        ("last_heartbeat", "f8"),
        ("heartbeat", "i8"),
        ("lease", "i8"),
        ("request_number", "i8"),
        ("stop_count", "i8"),
        ("emergency_stop_count", "i8"),
    ]
)
"""Memory of the loop: version of the last values read, whether the supervisor was alive then, time-out of the
heartbeat (s), time of the last heartbeat (s), and the last heartbeat, lease and counters."""
_EMERGENCY_STOP, _STOP = int(Request.EMERGENCY_STOP), int(Request.STOP)
_SLOTS, _VALUES, _MIN_MARGIN, _MEMORY_AT, _CONTROL = range(5)
"""Addresses in the block: that of the file's block, values, memory for a copy, memory, CONTROL_STATE."""


class Orders:
    """The loop's side: changes since the last tick. The values at startup do not count as changes."""

    def __init__(self, path: Path, silence: float) -> None:
        """Read the file at `path`; after `silence` (s) without a heartbeat the supervisor counts as dead.

        Raises:
            SharedMemoryError: the file is missing.
        """
        self._shared = SharedRecord.open(path, SUPERVISION)
        self._values, self._spare, self._memory = map(new_record, (SUPERVISION, SUPERVISION, _MEMORY))
        self._shared.read(self._values)
        for name in ("heartbeat", "request_number", "stop_count", "emergency_stop_count"):
            self._memory[name] = self._values[name]
        self._version, self._alive, self._silence, self._last_heartbeat, *_ = (
            numbers(self._memory[name]) for name in _MEMORY.names or ()
        )
        self._version[0], self._last_heartbeat[0], self._silence[0] = _UNREAD, -np.inf, silence
        self._look()
        self._words = self._shared.slots.words
        self._control: np.ndarray[Any, Any] | None = None
        held = self._shared.slots.block, self._values, self._spare, self._memory
        self._block = np.array([*(array.ctypes.data for array in held), 0], np.int64)
        self._address = self._block.ctypes.data

    @property
    def shutdown(self) -> bool:
        """Whether the loop shall end."""
        return bool(self._values["shutdown"][0])

    def put(self, control: np.ndarray[Any, Any], time: float) -> None:
        """Write the permissions at `time` (s) and at most one request into a CONTROL_STATE.

        Most ticks have no change and return at once. Written values remain: the step clears the request and
        keeps the permissions.

        A lease that follows another one, however soon, is not held for one tick: the step then disarms the
        bench that the previous holder has armed, and refuses the request that the previous holder has left
        waiting. A request of the new holder waits until the next tick.
        """
        version, last, silence, was_alive = self._seen
        if self._words[HEAD_WORD] == version and (time - last < silence) == was_alive:
            return
        if IS_PLAIN:
            _take(self._values, self._memory, control, time, self._shared.read(self._values))
        else:
            if control is not self._control:
                self._control, self._block[_CONTROL] = control, control.ctypes.data
            _take_newest(self._address, time)
        self._look()

    def _look(self) -> None:
        """Look up the few values that every tick needs: Python's own are at hand fastest."""
        self._seen = self._version[0], self._last_heartbeat[0], self._silence[0], self._alive[0]

    def stop(self) -> None:
        """Stop in the next tick, as one more stop of the supervisor: a request waits until the tick after."""
        self._memory["stop_count"] -= 1
        self._version[0] = _UNREAD
        self._look()

    def declare_supervisor_dead(self) -> None:
        """Treat the supervisor as dead from now on: the loop has seen that its process is gone."""
        self._silence[0] = 0.0
        self._look()

    def close(self) -> None:
        """Unmap the file."""
        self._shared.close()


@compiled
def _take(values: Any, memory: Any, control: Any, time: float, version: int) -> None:
    """Write new orders in `values` (SUPERVISION) into `control`, and remember them."""
    new, m, c = values[0], memory[0], control[0]
    if new.heartbeat != m.heartbeat or m.last_heartbeat == -np.inf:
        m.heartbeat, m.last_heartbeat = new.heartbeat, time
    alive = time - m.last_heartbeat < m.silence
    m.alive = alive
    c.supervisor_alive = alive
    handed_over = m.lease not in (0, new.lease)
    left_over = new.request_number != m.request_number and new.request_lease != new.lease
    m.lease = new.lease
    c.lease_held = new.lease != 0 and alive and not handed_over and not left_over
    c.support_ready = new.support_ready and alive
    if new.emergency_stop_count != m.emergency_stop_count:
        c.request, m.emergency_stop_count = _EMERGENCY_STOP, new.emergency_stop_count
    elif new.stop_count != m.stop_count:
        c.request, m.stop_count = _STOP, new.stop_count
    elif new.request_number != m.request_number and (left_over or not handed_over):
        c.request, c.request_number = new.request, new.request_number
        m.request_number = new.request_number
    waiting = (
        handed_over
        or left_over
        or m.request_number != new.request_number
        or m.stop_count != new.stop_count
        or m.emergency_stop_count != new.emergency_stop_count
    )
    m.version = _UNREAD if waiting else version


@compiled_with_arrays
def _take_newest(address: int, time: float) -> None:
    """Read the file and take new orders, at the addresses in the block."""
    a = carray(pointer(address), 5, np.int64)
    slots, values = slots_at(a[_SLOTS]), carray(pointer(a[_VALUES]), 1, SUPERVISION)
    fetch_record(slots, a[_VALUES], a[_MIN_MARGIN])
    memory = carray(pointer(a[_MEMORY_AT]), 1, _MEMORY)
    _take(values, memory, carray(pointer(a[_CONTROL]), 1, CONTROL_STATE), time, slots[READ])


class CorrectionReader:
    """The loop's side of learned corrections: ordered weights are applied between swings.

    It reports the tick since which they are active. A correction changes tables of the following swings:
    reference and feed-forward up to the impact. All limits of a swing apply to the corrected one as well.
    """

    def __init__(self, folder: Path, profile: Profile, basis: Basis) -> None:
        """Open the bench's files for corrections of `profile` with weights of `basis`.

        Raises:
            SharedMemoryError: the supervisor has not created them.
        """
        self._profile, self._basis = profile, basis
        self._orders = SharedRecord.open(folder / CORRECTION_FILE, CORRECTION)
        self._active = SharedRecord.create(folder / CORRECTED_FILE, CORRECTED)
        self._order, self._answer = np.zeros(1, CORRECTION), np.zeros(1, CORRECTED)
        self._version = self._orders.slots.head
        self._active.write(self._answer)

    @property
    def is_ordered(self) -> bool:
        """Whether there is an order that was not taken yet."""
        return self._orders.slots.head != self._version

    def take(self, tick: int, *, resting: bool) -> Profile | None:
        """Return the profile to swing from `tick` on if a new one was ordered, else None.

        An order that arrives while the robot is not resting, or for another profile, only updates `asked`
        and is dropped.
        """
        if not self.is_ordered:
            return None
        self._version = self._orders.read(self._order)
        self._answer["asked"] = self._order["number"]
        taken = None
        weights = weights_of(self._order)
        if resting and len(weights) in (0, self._basis.size):
            taken = self._profile
            if weights:
                taken = self._basis.corrected(taken, weights)
            self._answer["tick"], self._answer["order"] = tick, self._order
        self._active.write(self._answer)
        return taken

    def close(self) -> None:
        """Unmap the files."""
        self._orders.close()
        self._active.close()
