"""What happens around the robot of a plant process: the operator's hands, and faults that are put in."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

import numpy as np

from drivers.base.shared_record import SharedRecord
from sim.ball import Ball
from sim.live.exchange import BALL, PLANT_SURROUNDINGS, SURROUNDINGS_FILE

_QUIET = {"emergency_stop_clear": True, "guard_closed": True, "encoder_valid": 1}


class SurroundingsWriter:
    """The one writer of the surroundings; what another one left stands until it is changed."""

    def __init__(self, folder: Path) -> None:
        """Attach to the plant whose files lie in `folder`; SharedMemoryError when there is none."""
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
    ) -> None:
        """Change what is given and leave the rest; `frozen` keeps readings and their times as they are."""
        for name, value in {
            "emergency_stop_clear": emergency_stop_clear,
            "guard_closed": guard_closed,
            "local_reset": local_reset,
            "encoder_valid": encoder_valid,
            "frozen": frozen,
        }.items():
            if value is not None:
                self._record[name] = value
        self._shared.write(self._record)

    def place_ball(self, ball: Ball | None = None) -> None:
        """Put a ball on the tee by hand: the plan's, or another one."""
        self.choose_ball(ball)
        self._handle_ball(True)

    def take_ball(self) -> None:
        """Take the ball away, if there is one."""
        self._handle_ball(False)

    def choose_ball(self, ball: Ball | None) -> None:
        """Let the tee raise balls like this one from here on; None: the plan's."""
        self._record["ball"] = 0
        if ball is not None:
            for name in BALL.names or ():
                self._record["ball"][name] = getattr(ball, name)
        self._shared.write(self._record)

    def close(self) -> None:
        """Let go of the file; the surroundings stay as they are. Allowed twice."""
        self._shared.close()

    def __enter__(self) -> SurroundingsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _handle_ball(self, present: bool) -> None:
        self._record["ball_handled"] += 1
        self._record["ball_present"] = present
        self._shared.write(self._record)
