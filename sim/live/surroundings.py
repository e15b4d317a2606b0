"""Surroundings of a simulated plant: operator actions and injected faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drivers.base.shared_record import SharedRecord
from sim.ball import Ball
from sim.live.exchange import BALL, PLANT_SURROUNDINGS, SURROUNDINGS_FILE

_QUIET = {"emergency_stop_clear": True, "guard_closed": True, "encoder_valid": 1}


def chosen_ball(folder: Path) -> Ball | None:
    """Return the ball that the tee of the plant in `folder` supplies; None for the plan's ball.

    Raises:
        SharedMemoryError: there is no plant, or one of other code.
    """
    record = np.zeros(1, PLANT_SURROUNDINGS)
    shared = SharedRecord.open(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
    try:
        if not shared.read(record):
            return None
    finally:
        shared.close()
    fields = dict(zip(BALL.names or (), record["ball"][0].item(), strict=True))
    return Ball("surroundings", **fields) if any(fields.values()) else None


class SurroundingsWriter:
    """The single writer of the surroundings; values of an earlier writer remain until changed."""

    def __init__(self, folder: Path) -> None:
        """Attach to the plant with files in `folder`; SharedMemoryError if missing."""
        self._shared = SharedRecord.open(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
        self._record = np.zeros(1, PLANT_SURROUNDINGS)
        if not self._shared.read(self._record):
            for name, value in _QUIET.items():
                self._record[name] = value

    def change(
        self,
        *,
        emergency_stop_clear: bool | None = None,
        guard_closed: bool | None = None,
        local_reset: bool | None = None,
        encoder_valid: tuple[bool, bool, bool] | None = None,
        frozen: bool | None = None,
        regulated: float | None = None,
    ) -> None:
        """Change the given values only.

        `frozen` freezes readings and their time stamps; `regulated` turns the pressure regulator (Pa
        absolute), 0 back to that of the plan.
        """
        for name, value in {
            "emergency_stop_clear": emergency_stop_clear,
            "guard_closed": guard_closed,
            "local_reset": local_reset,
            "encoder_valid": encoder_valid,
            "frozen": frozen,
            "regulated": regulated,
        }.items():
            if value is not None:
                self._record[name] = value
        self._shared.write(self._record)

    def place_ball(self, ball: Ball | None = None) -> None:
        """Put a ball on the tee by hand, by default the plan's ball."""
        self.choose_ball(ball)
        self._handle_ball(True)

    def take_ball(self) -> None:
        """Remove the ball, if present."""
        self._handle_ball(False)

    def choose_ball(self, ball: Ball | None) -> None:
        """Let the tee supply this ball from now on; None for the plan's ball."""
        self._record["ball"] = 0
        if ball is not None:
            for name in BALL.names or ():
                self._record["ball"][name] = getattr(ball, name)
        self._shared.write(self._record)

    def close(self) -> None:
        """Unmap the file; the surroundings remain. May be called twice."""
        self._shared.close()

    def __enter__(self) -> SurroundingsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _handle_ball(self, present: bool) -> None:
        self._record["ball_handled"] += 1
        self._record["ball_present"] = present
        self._shared.write(self._record)
