"""One integration step of the robot: compiled Kane against MuJoCo and Pinocchio, same model, same run.

Ratios are of steps with the same rule, semi-implicit Euler. MuJoCo runs its steps inside one call.
Pinocchio is called from Python, as its users call it; for the promised ratio everything that is Python's
(the binding's price, measured on an empty model, and the integration in numpy) is taken off, so that
Pinocchio does one evaluation for nothing but its own time and integrates for free.

Competitors are timed in turn, A B C A B C ..., so that the machine's moods fall on all alike. The clock is
the thread's own processor time: what other programs take from the core does not count.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sim.kane import forward_dynamics
from sim.robot import thesis_robot
from tests.benchmarks.compiled_robot import CompiledRobot
from tests.benchmarks.mujoco_robot import MujocoRobot
from tests.benchmarks.pinocchio_robot import PinocchioRobot, bare_call
from tests.benchmarks.row import Row

Work = Callable[[int], object]
"""Does its work n times over in one call."""

Times = NDArray[np.float64]
"""Nanoseconds for one piece of work, one figure a round."""


def nanoseconds(work: Work, n: int) -> float:
    """Return the time of one of `n` pieces of work (ns)."""
    start = time.thread_time_ns()
    work(n)
    return (time.thread_time_ns() - start) / n


def _repeats(work: Work, sample_ns: float) -> int:
    """Return how many pieces of `work` take about `sample_ns`."""
    work(1)  # compiles, allocates
    n = 1
    while (taken := min(nanoseconds(work, n) for _ in range(3)) * n) < sample_ns / 4:
        n *= 2
    return max(1, round(n * sample_ns / taken))


def in_turn(works: Mapping[str, Work], rounds: int = 25, sample_s: float = 0.01) -> dict[str, Times]:
    """Time each of `works` for about `sample_s`, `rounds` times in turn; the first calls warm up."""
    repeats = {name: _repeats(work, sample_s * 1e9) for name, work in works.items()}
    times: dict[str, list[float]] = {name: [] for name in works}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for _ in range(rounds):
            for name, work in works.items():
                times[name].append(nanoseconds(work, repeats[name]))
    finally:
        if collecting:
            gc.enable()
    return {name: np.array(values) for name, values in times.items()}


PROMISED_RATIO = 15.0
STEP = 1e-5
STATES = 200

Simulator = CompiledRobot | MujocoRobot | PinocchioRobot


def random_states(n: int) -> list[tuple[NDArray[np.float64], ...]]:
    """Return `n` states and efforts (q, u, effort) over the robot's working range."""
    rng = np.random.default_rng(0)
    return [
        (
            rng.uniform((-2.0, np.pi + 0.2, 4.8), (1.0, 1.6 * np.pi, 6.4)),
            rng.uniform(-15.0, 15.0, 3),
            rng.uniform(-1.0, 1.0, 3) * (300.0, 1000.0, 100.0),
        )
        for _ in range(n)
    ]


def disagreement(simulator: MujocoRobot | PinocchioRobot) -> float:
    """Largest difference to `sim.kane`'s accelerations, relative to the largest of each state's three."""
    worst = 0.0
    for q, u, effort in random_states(STATES):
        simulator.start(q, u)
        simulator.push(effort)
        expected = forward_dynamics(thesis_robot(), q, u, effort)
        difference = np.abs(simulator.acceleration() - expected)
        worst = max(worst, float(np.max(difference) / np.max(np.abs(expected))))
    return worst


def _steps(simulator: Simulator) -> Work:
    """Return the work of taking n steps from the same bent pose, without effort."""

    def work(n: int) -> None:
        simulator.start(np.array([-2.0, 3.6, 5.1]), np.zeros(3))
        simulator.follow(np.zeros((1, 3)), STEP, n)

    return work


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Measure; about ten seconds."""
    argparse.ArgumentParser(description=__doc__).parse_args(arguments)
    robot = thesis_robot()
    pinocchio = PinocchioRobot(robot)
    works: dict[str, Work] = {
        "golfbench, Euler": _steps(CompiledRobot(robot)),
        "MuJoCo, Euler, default settings": _steps(MujocoRobot(robot, "default")),
        "MuJoCo, Euler, lean settings": _steps(MujocoRobot(robot)),
        "Pinocchio, Euler, loop in Python": _steps(pinocchio),
        "Pinocchio, constraintDynamics alone": pinocchio.evaluate,
        "Pinocchio, the same call on an empty model": bare_call,
    }
    # Short samples and many rounds: on a busy machine most samples are then undisturbed.
    times = in_turn(works, rounds=101, sample_s=0.0025)
    own = times["golfbench, Euler"]
    binding = times["Pinocchio, the same call on an empty model"]
    ratios: dict[str, tuple[Times, float | None]] = {
        "MuJoCo / golfbench, Euler, default settings": (times["MuJoCo, Euler, default settings"] / own, None),
        "MuJoCo / golfbench, Euler, lean settings": (
            times["MuJoCo, Euler, lean settings"] / own,
            PROMISED_RATIO,
        ),
        "Pinocchio / golfbench, Euler, called from Python": (
            times["Pinocchio, Euler, loop in Python"] / own,
            None,
        ),
        "Pinocchio / golfbench, Euler, Python's share taken off": (
            (times["Pinocchio, constraintDynamics alone"] - binding) / own,
            PROMISED_RATIO,
        ),
    }
    return [
        Row(
            "same model",
            "MuJoCo, accelerations off by",
            disagreement(MujocoRobot(robot)),
            "",
            f"worst of {STATES} states; MuJoCo's loop is soft by design",
            at_most=5e-4,
        ),
        Row(
            "same model",
            "Pinocchio, accelerations off by",
            disagreement(pinocchio),
            "",
            f"worst of {STATES} states",
            at_most=1e-10,
        ),
        *(
            Row("one step", name, float(np.median(t)), "ns", f"fastest round {np.min(t):.4g}")
            for name, t in times.items()
        ),
        *(
            Row(
                "ratio of one step",
                name,
                float(np.median(t)),
                "",
                f"9 of 10 rounds above {np.quantile(t, 0.1):.3g}",
                bound,
            )
            for name, (t, bound) in ratios.items()
        ),
    ]
