"""The project's own model in compiled loops: semi-implicit Euler and the classical Runge-Kutta rule."""

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
def _runge_kutta(robot: Any, state: Any, effort: Any, dt: float, steps: int) -> Any:
    r = robot[0]
    q1, q2, q3, u1, u2, u3 = state
    e1, e2, e3 = effort
    h, s = dt / 2, dt / 6
    for _ in range(steps):
        a1, a2, a3 = accelerations(r, q1, q2, q3, u1, u2, u3, e1, e2, e3)
        v1, v2, v3 = u1 + h * a1, u2 + h * a2, u3 + h * a3
        b1, b2, b3 = accelerations(r, q1 + h * u1, q2 + h * u2, q3 + h * u3, v1, v2, v3, e1, e2, e3)
        w1, w2, w3 = u1 + h * b1, u2 + h * b2, u3 + h * b3
        c1, c2, c3 = accelerations(r, q1 + h * v1, q2 + h * v2, q3 + h * v3, w1, w2, w3, e1, e2, e3)
        x1, x2, x3 = u1 + dt * c1, u2 + dt * c2, u3 + dt * c3
        d1, d2, d3 = accelerations(r, q1 + dt * w1, q2 + dt * w2, q3 + dt * w3, x1, x2, x3, e1, e2, e3)
        q1, q2, q3 = (
            q1 + s * (u1 + 2 * (v1 + w1) + x1),
            q2 + s * (u2 + 2 * (v2 + w2) + x2),
            q3 + s * (u3 + 2 * (v3 + w3) + x3),
        )
        u1, u2, u3 = (
            u1 + s * (a1 + 2 * (b1 + c1) + d1),
            u2 + s * (a2 + 2 * (b2 + c2) + d2),
            u3 + s * (a3 + 2 * (b3 + c3) + d3),
        )
    return q1, q2, q3, u1, u2, u3


@compiled
def _follow_euler(robot: Any, state: Any, efforts: Any, dt: float, steps: int) -> Any:
    for i in range(efforts.shape[0]):
        state = _euler(robot, state, (efforts[i, 0], efforts[i, 1], efforts[i, 2]), dt, steps)
    return state


@compiled
def _follow_runge_kutta(robot: Any, state: Any, efforts: Any, dt: float, steps: int) -> Any:
    for i in range(efforts.shape[0]):
        state = _runge_kutta(robot, state, (efforts[i, 0], efforts[i, 1], efforts[i, 2]), dt, steps)
    return state


RULES: dict[str, Any] = {"Euler": _follow_euler, "RK4": _follow_runge_kutta}


class CompiledRobot:
    """The robot as `sim.kane` has it, advanced by one compiled loop."""

    def __init__(self, robot: RobotParameters, rule: str) -> None:
        self._record = robot.record
        self._follow = RULES[rule]
        self._state: tuple[float, ...] = (0.0,) * 6

    def start(self, q: Array, u: Array) -> None:
        """Set joint angles and speeds."""
        self._state = tuple(map(float, (*q, *u)))

    def follow(self, efforts: Array, dt: float, steps: int) -> None:
        """Take `steps` steps of `dt` seconds under each of `efforts` [M_A N m, F_E N, M_C N m] in turn."""
        self._state = self._follow(self._record, self._state, efforts, dt, steps)

    @property
    def q(self) -> Array:
        """Joint angles (rad)."""
        return np.array(self._state[:3])
