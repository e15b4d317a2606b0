"""Orders of the supervisor to the loop: heartbeat, permissions and requests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bench.lifecycle import Request
from drivers.base.compiled import new_record
from drivers.base.shared_record import SharedRecord

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


class Orders:
    """The loop's side: changes since the last tick. The values at startup do not count as changes."""

    def __init__(self, path: Path, silence: float) -> None:
        """Read the file at `path`; after `silence` (s) without a heartbeat the supervisor counts as dead.

        Raises:
            SharedMemoryError: the file is missing.
        """
        self._shared, self._silence = SharedRecord.open(path, SUPERVISION), silence
        self._values = new_record(SUPERVISION)
        self._shared.read(self._values)
        self._version = _UNREAD
        now = self._values[0]
        self._seen = int(now["request_number"]), int(now["stop_count"]), int(now["emergency_stop_count"])
        self._heartbeat, self._last_heartbeat = int(now["heartbeat"]), -np.inf
        self._alive = False
        self._lease = 0

    @property
    def shutdown(self) -> bool:
        """Whether the loop shall end."""
        return bool(self._values["shutdown"][0])

    def put(self, control: np.ndarray[Any, Any], time: float) -> None:
        """Write what holds at `time` (s) into a CONTROL_STATE: permissions, and at most one request.

        Most ticks have no change and return at once. Written values remain: the step clears the request and
        keeps the permissions.

        A lease that follows another one, however soon, is not held for one tick: the step then disarms the
        bench that the previous holder has armed, and refuses the request that the previous holder has left
        waiting. A request of the new holder waits until the next tick.
        """
        version, alive = self._shared.newest, time - self._last_heartbeat < self._silence
        if version == self._version and alive == self._alive:
            return
        version = self._shared.read(self._values)
        (heartbeat, lease, support_ready, _, request, number, request_lease, stops, emergencies) = (
            self._values.item()
        )
        if heartbeat != self._heartbeat or self._last_heartbeat == -np.inf:
            self._heartbeat, self._last_heartbeat = heartbeat, time
        self._alive = alive = time - self._last_heartbeat < self._silence
        control["supervisor_alive"] = alive
        seen_number, seen_stops, seen_emergencies = self._seen
        handed_over = self._lease not in (0, lease)
        left_over = number != seen_number and request_lease != lease
        self._lease = lease
        control["lease_held"] = lease != 0 and alive and not handed_over and not left_over
        control["support_ready"] = support_ready and alive
        if emergencies != seen_emergencies:
            control["request"], seen_emergencies = Request.EMERGENCY_STOP, emergencies
        elif stops != seen_stops:
            control["request"], seen_stops = Request.STOP, stops
        elif number != seen_number and (left_over or not handed_over):
            control["request"], control["request_number"] = request, number
            seen_number = number
        self._seen = seen_number, seen_stops, seen_emergencies
        waiting = handed_over or left_over or self._seen != (number, stops, emergencies)
        self._version = _UNREAD if waiting else version

    def declare_supervisor_dead(self) -> None:
        """Treat the supervisor as dead from now on: the loop has seen that its process is gone."""
        self._silence = 0.0

    def close(self) -> None:
        """Unmap the file."""
        self._shared.close()
