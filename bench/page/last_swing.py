"""The last swing for the page: club path, speeds, figures and tracking, read from its record.

A thread of low priority reads it: the loop of a bench on the same machine does not notice.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from queue import Empty, Full, Queue
from typing import Any

import numpy as np

from bench.errors import BenchError
from bench.lifecycle import Phase
from bench.shot.recorded_shot import FlightConditions, recorded_shot, warm_up_shots
from bench.telemetry.recorder import read_swing
from drivers.base import JOINTS
from sim.plant import PlantParameters

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
_MOVING = (
    Phase.BACKSWING,
    Phase.TOP,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.IMPACT,
    Phase.FOLLOW_THROUGH,
)
_TO_BALL = (Phase.DOWNSWING, Phase.COMMITTED, Phase.IMPACT)

_log = logging.getLogger("golfbench")


def swing_view(path: Path) -> dict[str, Any]:
    """Return the swing in the record at `path` as the page shows it, SI and degrees, valid as JSON.

    Raises:
        BenchError, ExceptionGroup: as `read_shot`.
    """
    cycles, metadata = read_swing(path)
    read = recorded_shot(cycles, metadata, str(path))
    shot, site = read.record.shot, read.plant.site
    moving = cycles[np.isin(cycles["phase"], _MOVING)]
    view: dict[str, Any] = {
        "name": path.name,
        "number": metadata.get("number"),
        "time_utc": metadata.get("time_utc"),
        "club": shot.club,
        "ball": shot.ball,
        "status": str(shot.status),
        "reason": shot.reason,
        "figures": {name: _finite(getattr(shot, name)) for name in FIGURES},
        "sources": {"launch": shot.launch_source, "carry": shot.carry_source},
        "ball_at": [site.ball_x, site.ball_y],
    }
    return view | (_curves(moving) if len(moving) > 2 else {"path": [], "speed": None, "tracking": None})


def _curves(moving: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return club path, head speed and tracking of the cycles of a swing."""
    time = moving["time"] - moving["time"][0]
    head = moving["head_position"]
    speed = np.hypot(*np.gradient(head, moving["time"], axis=0).T)
    error = np.degrees(moving["angle"] - moving["reference_angle"])
    down = np.isin(moving["phase"], _TO_BALL)
    worst = np.abs(error[down] if down.any() else error).max(axis=0)
    at = np.unique(np.linspace(0, len(moving) - 1, POINTS).astype(int))
    return {
        "path": _rounded(head[at], 4),
        "down": _rounded(head[down][:: max(1, int(down.sum()) // POINTS)], 4) if down.any() else [],
        "time": _rounded(time[at], 4),
        "speed": {"curve": _rounded(speed[at], 2), "max_mps": _finite(float(np.nanmax(speed)))},
        "tracking": [
            {"name": name, "error_deg": _rounded(error[at, joint], 3), "max_deg": _finite(worst[joint])}
            for joint, name in enumerate(JOINTS)
        ],
    }


def _rounded(values: np.ndarray[Any, Any], digits: int) -> Any:
    return np.round(np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0), digits).tolist()


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and np.isfinite(value) else None


class SwingReader:
    """Reads the newest record that was offered, in a thread of its own."""

    def __init__(self, publish: Callable[[str, Any], None], plant: PlantParameters) -> None:
        """Pass each swing's view to `publish` on topic "swing"; models are compiled for `plant` early."""
        self._publish, self._plant = publish, plant
        self._offered: Queue[Path | None] = Queue(1)
        self._thread = threading.Thread(target=self._work, name="page-swings", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """End after the record that is being read."""
        self._put(None)
        self._thread.join()

    def offer(self, path: Path) -> None:
        """Read `path` instead of one that still waits."""
        self._put(path)

    def _put(self, item: Path | None) -> None:
        while True:
            try:
                self._offered.put_nowait(item)
                return
            except Full:
                try:
                    if self._offered.get_nowait() is None:
                        item = None  # the end stays the end
                except Empty:
                    pass

    def _work(self) -> None:
        with suppress(PermissionError):  # a service that may not has a low priority already
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICE)
        warm = False
        while True:
            try:
                path = self._offered.get(timeout=None if warm else _IDLE)
            except Empty:
                warm_up_shots(self._plant, FlightConditions())
                warm = True
                continue
            if path is None:
                return
            try:
                self._publish("swing", swing_view(path))
            except (BenchError, ExceptionGroup, ValueError, KeyError) as error:
                _log.warning("page: record %s: %s", path, error)
