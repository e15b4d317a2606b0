"""The model's public functions as Python sees them: single calls and batches."""

from __future__ import annotations

import numpy as np

from sim.kane import forward_dynamics, inverse_dynamics, mass_matrix
from sim.kinematics import forward_kinematics, inverse_kinematics
from sim.robot import thesis_robot
from tests.benchmarks.row import Row
from tests.benchmarks.stopwatch import Work, in_turn

SIZES = (1000, 100_000)


def run() -> list[Row]:
    """Measure; a few seconds."""
    robot = thesis_robot()
    rng = np.random.default_rng(0)
    rows = max(SIZES)
    q = rng.uniform((-2.0, np.pi + 0.2, 4.8), (1.0, 1.6 * np.pi, 6.4), (rows, 3))
    u = rng.uniform(-15.0, 15.0, (rows, 3))
    effort = rng.uniform(-1.0, 1.0, (rows, 3)) * (300.0, 1000.0, 100.0)
    pose = forward_kinematics(robot, q)
    functions = {
        "forward_dynamics": lambda k: forward_dynamics(robot, q[k], u[k], effort[k]),
        "inverse_dynamics": lambda k: inverse_dynamics(robot, q[k], u[k], effort[k]),
        "mass_matrix": lambda k: mass_matrix(robot, q[k]),
        "forward_kinematics": lambda k: forward_kinematics(robot, q[k]),
        "inverse_kinematics": lambda k: inverse_kinematics(robot, pose[k]),
    }

    def repeated(function, rows: int | slice) -> Work:  # type: ignore[no-untyped-def]
        def work(n: int) -> None:
            for _ in range(n):
                function(rows)

        return work

    works: dict[str, Work] = {}
    evaluations: dict[str, int] = {}
    for name, function in functions.items():
        works[f"{name}, single"], evaluations[f"{name}, single"] = repeated(function, 0), 1
        for size in SIZES:
            case = f"{name}, batch of {size}"
            works[case], evaluations[case] = repeated(function, slice(size)), size
    return [
        Row("model called from Python", name, float(np.median(t)) / evaluations[name], "ns", "per evaluation")
        for name, t in in_turn(works, rounds=7).items()
    ]
