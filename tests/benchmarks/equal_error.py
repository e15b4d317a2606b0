"""Time to the same trajectory error: half a second of swing from a bent pose under given efforts.

Each simulator integrates the same motion with ever finer steps until its joint angles at the end are
within the demanded error of a reference (DOP853 at 1e-13). Each may use the better of its two rules and
of its settings. The efforts hold for 50 ms each, so that no rule meets a jump inside a step.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from sim.kane import forward_dynamics
from sim.robot import RobotParameters, thesis_robot
from tests.benchmarks.compiled_robot import RULES, CompiledRobot
from tests.benchmarks.mujoco_robot import SETTINGS, MujocoRobot
from tests.benchmarks.pinocchio_robot import PinocchioRobot, bare_call
from tests.benchmarks.row import Row
from tests.benchmarks.stopwatch import in_turn, nanoseconds

Array = NDArray[np.float64]
Simulator = CompiledRobot | MujocoRobot | PinocchioRobot

START = np.array([-2.0, 3.6, 5.1])
HOLD = 0.05
# Roughly what a smooth turn of (2.4, 0.9, 1.2) rad needs; columns N m, N, N m.
EFFORTS = np.array(
    [
        [35.0, 160.0, 15.0],
        [30.0, 115.0, 10.0],
        [25.0, 70.0, 5.0],
        [20.0, 20.0, 0.0],
        [15.0, -30.0, -5.0],
        [5.0, -75.0, -10.0],
        [-5.0, -110.0, -10.0],
        [-25.0, -140.0, -15.0],
        [-40.0, -170.0, -15.0],
        [-60.0, -200.0, -20.0],
    ]
)
TARGETS = (1e-3, 1e-4, 1e-6)
LONGEST_S = 1.0
"""A simulator that would need longer than this for half a second of swing is not asked to go finer."""


class Trial(NamedTuple):
    """One integration of the swing."""

    steps: int
    error: float
    seconds: float


def reference(robot: RobotParameters) -> Array:
    """Return the joint angles at the end of the motion (rad)."""
    state = np.concatenate([START, np.zeros(3)])
    for effort in EFFORTS:

        def rate(_: float, y: Array, effort: Array = effort) -> Array:
            return np.concatenate([y[3:], forward_dynamics(robot, y[:3], y[3:], effort)])

        state = solve_ivp(rate, (0.0, HOLD), state, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return np.asarray(state[:3])


def swing(simulator: Simulator, steps: int) -> None:
    """Integrate the whole motion with `steps` steps for each of the efforts."""
    simulator.start(START, np.zeros(3))
    simulator.follow(EFFORTS, HOLD / steps, steps)


def _seconds(simulator: Simulator, steps: int) -> float:
    """Return the fastest of some runs, more of them the shorter they are."""

    def work(_: int) -> None:
        swing(simulator, steps)

    first = nanoseconds(work, 1)
    repeats = int(np.clip(2e8 / first, 2, 50))
    return min(first, *(nanoseconds(work, 1) for _ in range(repeats))) * 1e-9


def trials(simulator: Simulator, end: Array, python_share: float) -> Iterator[Trial]:
    """Integrate finer and finer, down to the smallest target; `python_share` s per evaluation are free."""
    steps = 1
    while True:
        seconds = _seconds(simulator, steps)
        error = float(np.max(np.abs(simulator.q - end)))
        total = steps * len(EFFORTS)
        if isinstance(simulator, PinocchioRobot):
            yield Trial(total, error, total * simulator.evaluations * python_share)
        else:
            yield Trial(total, error, seconds)
        if error <= min(TARGETS) or 2 * seconds > LONGEST_S:
            return
        steps *= 2


def time_to(error: float, series: list[Trial]) -> float:
    """Return the seconds at which `series` reaches `error`, between its trials on a double-log line.

    NaN when the series never gets there.
    """
    for coarse, fine in pairwise(series):
        if fine.error <= error:
            if coarse.error <= error or not np.isfinite(coarse.error):
                return coarse.seconds if coarse.error <= error else fine.seconds
            share = np.log(coarse.error / error) / np.log(coarse.error / fine.error)
            return float(coarse.seconds * (fine.seconds / coarse.seconds) ** share)
    return float("nan")


def run() -> list[Row]:
    """Measure; about half a minute."""
    robot = thesis_robot()
    end = reference(robot)
    pinocchio = PinocchioRobot(robot, "RK4")
    pinocchio.start(START, np.zeros(3))
    calls = in_turn({"full": pinocchio.evaluate, "bare": bare_call})
    pinocchio_alone = float(np.median(calls["full"] - calls["bare"])) * 1e-9
    simulators: dict[str, dict[str, Simulator]] = {
        "golfbench": {rule: CompiledRobot(robot, rule) for rule in RULES},
        "MuJoCo": {
            f"{rule}, {settings} settings": MujocoRobot(robot, rule, settings)
            for rule in RULES
            for settings in SETTINGS
        },
        "Pinocchio": {f"{rule}, Python's share taken off": PinocchioRobot(robot, rule) for rule in RULES},
    }
    for simulator in simulators["golfbench"].values():
        swing(simulator, 1)  # compiled or loaded now
    series = {
        name: {how: list(trials(simulator, end, pinocchio_alone)) for how, simulator in ways.items()}
        for name, ways in simulators.items()
    }
    rows = []
    for target in TARGETS:
        best = {}
        for name, ways in series.items():
            reached = {how: time_to(target, one) for how, one in ways.items()}
            how = min(reached, key=lambda way: np.nan_to_num(reached[way], nan=np.inf))
            best[name] = reached[how]
            if not np.isfinite(best[name]):
                how = f"not reached; best error {min(t.error for one in ways.values() for t in one):.2g} rad"
            rows.append(Row("equal error", f"{name} to {target:g} rad", best[name] * 1e6, "us", how))
        rows += [
            Row(
                "ratio at equal error",
                f"{name} / golfbench at {target:g} rad",
                best[name] / best["golfbench"],
                "",
            )
            for name in ("MuJoCo", "Pinocchio")
        ]
    return rows
