"""The project's own model in a compiled loop of semi-implicit Euler steps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base.compiled import compiled
from sim import kane
from sim.robot import RobotParameters

Array = NDArray[np.float64]

accelerations: Any = kane.accelerations


@compiled
def _euler(robot: Any, state: Any, effort: Any, dt: float, steps: int) -> Any:
    r = robot[0]
    q1, q2, q3, u1, u2, u3 = state
    e1, e2, e3 = effort
    for _ in range(steps):
        a1, a2, a3 = accelerations(r, q1, q2, q3, u1, u2, u3, e1, e2, e3)
        u1, u2, u3 = u1 + dt * a1, u2 + dt * a2, u3 + dt * a3
        q1, q2, q3 = q1 + dt * u1, q2 + dt * u2, q3 + dt * u3
    return q1, q2, q3, u1, u2, u3


@compiled
def _follow_euler(robot: Any, state: Any, efforts: Any, dt: float, steps: int) -> Any:
    for i in range(efforts.shape[0]):
        state = _euler(robot, state, (efforts[i, 0], efforts[i, 1], efforts[i, 2]), dt, steps)
    return state


class CompiledRobot:
    """The robot as `sim.kane` has it, advanced by one compiled loop."""

    def __init__(self, robot: RobotParameters) -> None:
        self._record = robot.record
        self._state: tuple[float, ...] = (0.0,) * 6

    def start(self, q: Array, u: Array) -> None:
        """Set joint angles and speeds."""
        self._state = tuple(map(float, (*q, *u)))

    def follow(self, efforts: Array, dt: float, steps: int) -> None:
        """Take `steps` steps of `dt` seconds under each of `efforts` [M_A N m, F_E N, M_C N m] in turn."""
        self._state = _follow_euler(self._record, self._state, efforts, dt, steps)

    @property
    def q(self) -> Array:
        """Joint angles (rad)."""
        return np.array(self._state[:3])
