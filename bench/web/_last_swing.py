"""The last swing for the page: figures, head speed, tracking, pressures and club path.

Its curves are shown while it runs and its figures when it ends, from the loop's ring in shared memory. All
are shown again when its record is stored, half a second after the robot is back at its address. A thread of
low priority reads both: the loop of a bench on the same machine does not notice.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.errors import BenchError
from bench.base.lifecycle import State
from bench.records.shot.recorded_shot import FlightConditions, recorded_shot, shot_of_cycles, warm_up_shots
from bench.records.shot.shot import Shot
from bench.records.shot.strike import SWINGING, TO_BALL
from bench.records.telemetry.record_file import read_swing
from bench.records.telemetry.ring import NoRing, RingReader
from drivers.base import ACTUATORS, JOINTS
from sim.plant import PlantParameters

PAST = 8.0
"""Time of the newest cycles in which the swing that has ended is searched, s."""
POINTS = 160
"""Max number of points of a curve."""
NICE = 10
"""Priority of the thread, as of the viewer's service."""
_IDLE = 3.0
"""Time after the start at which the models are compiled, unless a record came first, s."""
FIGURES = (
    "club_speed_mps",
    "attack_angle_deg",
    "strike_x_mm",
    "strike_y_mm",
    "ball_speed_mps",
    "launch_angle_deg",
    "spin_rpm",
    "carry_m",
)

_log = logging.getLogger("golfbench")


def swing_view(path: Path) -> dict[str, Any]:
    """Return the swing in the record at `path` as the page shows it, SI and degrees, valid as JSON.

    Raises:
        BenchError, ExceptionGroup: as `read_shot`.
    """
    cycles, metadata = read_swing(path)
    read = recorded_shot(cycles, metadata, str(path))
    number, time = metadata.get("number"), metadata.get("time_utc")
    named = {"name": path.name, "number": number, "time_utc": time, "stored": True}
    return named | _view(read.record.shot, cycles, read.plant)


def ended_swing_view(ring: Path, plant: PlantParameters, around: FlightConditions) -> dict[str, Any] | None:
    """Return the newest swing in the loop's `ring` as `swing_view`; None if it holds none.

    Its figures are those of `plant`, the configured one; number, name and shot come with its record.

    Raises:
        BenchError: there is no ring on this machine.
    """
    cycles, now = _newest_swing(ring, plant), datetime.now(UTC)
    if cycles is None:
        return None
    shot = shot_of_cycles(cycles, plant, around, number=1, time_utc=now).shot
    return _unstored(now) | _view(shot, cycles, plant)


def running_swing_view(ring: Path, plant: PlantParameters) -> dict[str, Any] | None:
    """Return the swing under way in the loop's `ring` as `swing_view`, without figures; None before it moves.

    Raises:
        BenchError: there is no ring on this machine.
    """
    cycles = _newest_swing(ring, plant)
    if cycles is None:
        return None
    none: dict[str, Any] = {"club": "", "ball": "", "status": "", "reason": "", "sources": {"launch": ""}}
    none["figures"] = dict.fromkeys(FIGURES)
    return _unstored(datetime.now(UTC)) | {"running": True} | none | _drawn(cycles, plant)


def _unstored(now: datetime) -> dict[str, Any]:
    time = now.isoformat(timespec="milliseconds")
    return {"name": "", "number": None, "time_utc": time, "stored": False, "running": False}


def _newest_swing(ring: Path, plant: PlantParameters) -> np.ndarray[Any, Any] | None:
    past = round(PAST / plant.tick)
    reader = RingReader(ring, past=past)
    try:
        cycles = reader.read(past)
    finally:
        reader.close()
    swinging = cycles["state"] == State.SWINGING
    if not swinging.any():
        return None
    last = len(cycles) - int(np.argmax(swinging[::-1]))
    others = np.flatnonzero(~swinging[:last])
    return cycles[int(others[-1]) + 1 if len(others) else 0 : last]


def _view(shot: Shot, cycles: np.ndarray[Any, Any], plant: PlantParameters) -> dict[str, Any]:
    view: dict[str, Any] = {
        "club": shot.club,
        "ball": shot.ball,
        "status": str(shot.status),
        "reason": shot.reason,
        "figures": {name: _finite(getattr(shot, name)) for name in FIGURES},
        "sources": {"launch": shot.launch_source, "carry": shot.carry_source},
    }
    return view | _drawn(cycles, plant)


def _drawn(cycles: np.ndarray[Any, Any], plant: PlantParameters) -> dict[str, Any]:
    """Return the ball's position and the curves of a swing's `cycles`; a swing without motion has none."""
    moving = cycles[np.isin(cycles["phase"], SWINGING)]
    curves = _curves(moving) if len(moving) > 2 else {"path": [], "speed": None, "tracking": None}
    return {"ball_at": [plant.site.ball_x, plant.site.ball_y], **curves}


def _curves(moving: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return club path, head speed, tracking and chamber pressures of the cycles of a swing."""
    time = moving["time"] - moving["time"][0]
    head = moving["head_position"]
    speed = moving["head_speed"]
    error = np.degrees(moving["angle"] - moving["reference_angle"])
    down = np.isin(moving["phase"], TO_BALL)
    worst = np.abs(error[down] if down.any() else error).max(axis=0)
    at = np.unique(np.linspace(0, len(moving) - 1, POINTS).astype(int))
    end = int(np.flatnonzero(down)[-1]) if down.any() else len(moving) - 1
    pressure = moving["chamber_pressure"]
    sides = [(name, side) for name in ACTUATORS for side in "AB"]
    return {
        "to_ball": int(np.searchsorted(at, end, side="right")),
        "path": _rounded(head[at], 4),
        "down": _rounded(head[down][:: max(1, int(down.sum()) // POINTS)], 4) if down.any() else [],
        "time": _rounded(time[at], 4),
        "speed": {"curve": _rounded(speed[at], 2), "max_mps": _finite(float(np.nanmax(speed)))},
        "tracking": [
            {"name": name, "error_deg": _rounded(error[at, joint], 3), "max_deg": _finite(worst[joint])}
            for joint, name in enumerate(JOINTS)
        ],
        "pressures": [
            {"name": name, "side": side, "pa": _rounded(pressure[at, chamber], 0)}
            for chamber, (name, side) in enumerate(sides)
            if np.isfinite(pressure[:, chamber]).any()
        ],
    }


def _rounded(values: np.ndarray[Any, Any], digits: int) -> Any:
    return np.round(np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0), digits).tolist()


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


_Look = Callable[[], dict[str, Any] | None]


class SwingReader:
    """Reads the newest record or ring that was offered, in a separate thread."""

    def __init__(
        self,
        publish: Callable[[str, Any], None],
        plant: PlantParameters,
        around: FlightConditions = FlightConditions(),  # noqa: B008 - a value
    ) -> None:
        """Pass each swing's view to `publish` on topic "swing"; models are compiled for `plant` early.

        `plant` and `around` are those of the configuration.
        """
        self._publish, self._plant, self._around = publish, plant, around
        self._offered: tuple[Path, _Look] | None = None
        self._ended, self._changed = False, threading.Condition()
        self._thread = threading.Thread(target=self._work, name="page-swings", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End after the record that is being read."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()

    def offer(self, path: Path) -> None:
        """Read the record at `path` instead of what still waits."""
        self._put(path, partial(swing_view, path))

    def offer_shot(self, message: dict[str, Any]) -> None:
        """Read the stored record that a `message` about a shot names first, if it is on this machine."""
        record, outcome = message.get("record"), message.get("outcome")
        if isinstance(record, str) and outcome is None and Path(record).is_file():
            self.offer(Path(record))

    def offer_ring(self, ring: Path, *, running: bool = False) -> None:
        """Read the swing that has ended from `ring` instead of what still waits.

        One that is `running` is left out while another offer waits.
        """
        if not running:
            self._put(ring, partial(ended_swing_view, ring, self._plant, self._around))
        elif self._offered is None:
            self._put(ring, partial(running_swing_view, ring, self._plant))

    def _put(self, path: Path, look: _Look) -> None:
        with self._changed:
            self._offered = path, look
            self._changed.notify()

    def _take(self, timeout: float | None) -> tuple[Path, _Look] | None:
        """Return the offer, once there is one; None after `timeout` (s), or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._offered is not None, timeout)
            offered, self._offered = self._offered, None
            return offered

    def _work(self) -> None:
        with suppress(PermissionError):  # a service that may not has a low priority already
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        warm = False
        while True:
            offer = self._take(None if warm else _IDLE)
            if self._ended:
                return
            if offer is None:
                warm_up_shots(self._plant, self._around)
                warm = True
                continue
            path, look = offer
            try:
                view = look()
            except NoRing as error:  # a bench on another machine: its record is not here either
                _log.debug("page: %s", error)
            except (BenchError, ExceptionGroup, ValueError, KeyError, OSError) as error:
                _log.warning("page: swing in %s: %s", path, error)
            else:
                if view is not None:
                    self._publish("swing", view)
