"""The plant with guard, e-stop, regulator, ball and encoder faults as `sim.live.surroundings` requests."""

from __future__ import annotations

from typing import Any

import numpy as np

from sim.ball import Ball
from sim.faults import Faults, turn_regulator
from sim.impact import impact_parameters
from sim.live.exchange import BALL
from sim.plant import Plant


class HandledPlant:
    """Applies operator actions and surroundings to a plant and its state."""

    def __init__(self, plant: Plant, state: np.ndarray[Any, Any], faults: Faults | None) -> None:
        """Act on `plant`, its `state` (PLANT_STATE) and its `faults`."""
        self._plant, self._state, self._faults = plant, state, faults
        self.frozen = False
        """Whether readings and their time stamps are frozen."""
        self._regulated = 0.0
        self._ball_handled = 0
        self._ball = np.zeros(1, BALL).tobytes()

    def set_surroundings(self, record: np.ndarray[Any, Any]) -> None:
        """Apply a PLANT_SURROUNDINGS record."""
        state, new = self._state, record[0]
        for name in ("emergency_stop_clear", "guard_closed", "local_reset"):
            state[name] = bool(new[name])
        state["encoder_valid"] = new["encoder_valid"] != 0
        self.frozen = bool(new["frozen"])
        if new["regulated"] != self._regulated:
            self._regulated = float(new["regulated"])
            turn_regulator(self._plant, self._faults, self._regulated)
        if new["ball_handled"] != self._ball_handled:
            self._ball_handled = new["ball_handled"]
            state["ball_present"] = bool(new["ball_present"])
            if new["ball_present"]:
                state["struck"] = False
        if new["ball"].tobytes() != self._ball:
            self._ball = new["ball"].tobytes()
            self._change_ball(new["ball"])

    def _change_ball(self, ball: Any) -> None:
        """Use another ball from now on; an invalid one is ignored."""
        parameters = self._plant.parameters
        try:
            fields = dict(zip(BALL.names or (), ball.item(), strict=True))
            model = Ball("surroundings", **fields) if any(fields.values()) else parameters.ball
            self._plant.impact[:] = impact_parameters(parameters.robot.club, model, parameters.robot.lie)
        except ValueError:
            return
