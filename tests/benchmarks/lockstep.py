"""A whole swing in lock-step: how much faster than real time, compiled and through the Python cycle.

Both benches arm, then take the same swing of the default profile at a ball again and again, from the begin
of the backswing until the robot holds at address; one core, the thread's own processor time.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import bench.swing
from bench.clock import FreeClock
from bench.control.settings import build_controller
from bench.lifecycle import Phase, Request
from bench.loop import Cycle, Loop
from bench.simulation.lockstep import Lockstep
from bench.swing.profile import load_profile
from sim.driver import SimDriver, hanging_pose
from sim.plant import PlantParameters, build_plant
from tests.benchmarks.row import Row
from tests.benchmarks.stopwatch import Work, in_turn

PROMISED_COMPILED, PROMISED_PYTHON = 100.0, 100.0
PATIENCE = 20_000
"""Ticks after which arming or a swing should long be over."""

Stepper = Lockstep | Loop


def _until_hold(stepper: Stepper, ticks: int) -> int:
    """Run in steps of `ticks` until the robot holds at address; return how many ticks that took."""
    for passed in range(ticks, PATIENCE, ticks):
        last = stepper.advance(ticks)[-1]
        if last["phase"] == Phase.HOLD and last["supply_enable"]:
            return passed
    state = stepper.state.control[0]
    raise RuntimeError(f"no hold at address: the robot is in phase {state['phase']}, cause {state['cause']}")


def _swing(stepper: Stepper, ticks: int) -> NDArray[np.void]:
    """Tee a ball up and take one swing of `ticks` ticks; return its records."""
    stepper.state.control["tee"] = False
    stepper.advance(1)
    stepper.state.control["tee"] = True
    stepper.advance(1)
    return stepper.advance(ticks, Request.SWING)


def _swings(stepper: Stepper, ticks: int) -> Work:
    """Return the work of swinging n times."""

    def work(n: int) -> None:
        for _ in range(n):
            _swing(stepper, ticks)

    return work


def run() -> list[Row]:
    """Measure; about twenty seconds."""
    parameters = PlantParameters()
    profile = load_profile(Path(bench.swing.__path__[0]) / "profiles" / "default.toml")
    start = hanging_pose(parameters)
    driver = SimDriver(parameters, start)
    driver.open()
    controllers = [build_controller(parameters, profile) for _ in range(2)]
    compiled = Lockstep(build_plant(parameters), controllers[0], start)
    cycle = Cycle(driver, controllers[1], lambda _: None, name="sim", note_truth=driver.note_truth)
    python = Loop(cycle, FreeClock(parameters.tick))
    for stepper in (compiled, python):
        stepper.advance(10)
        stepper.advance(1, Request.ARM)
        _until_hold(stepper, 100)

    # One swing to learn its length, then one whose records are compared.
    length = 0
    for stepper in (compiled, python):
        _swing(stepper, 100)
        length = 100 + _until_hold(stepper, 100)
    ours, theirs = _swing(compiled, length), _swing(python, length)
    different = sum(one.tobytes() != other.tobytes() for one, other in zip(ours, theirs, strict=True))

    duration = (length + 2) * parameters.tick
    times = in_turn(
        {"compiled": _swings(compiled, length), "python": _swings(python, length)}, rounds=9, sample_s=0.05
    )
    seconds = {name: float(np.median(t)) * 1e-9 for name, t in times.items()}
    note = (
        f"a swing of {duration:.2f} s, {parameters.substeps} substeps a tick of {parameters.tick * 1e3:g} ms"
    )
    return [
        Row("lock-step", "records of the two ways that differ", different, "", f"of {length}", at_most=0),
        Row(
            "lock-step",
            "control step and plant compiled, faster than real time",
            duration / seconds["compiled"],
            "times",
            f"{note}; wished 200",
            at_least=PROMISED_COMPILED,
        ),
        Row(
            "lock-step",
            "whole cycle around a driver, faster than real time",
            duration / seconds["python"],
            "times",
            "sim driver, records kept in memory",
            at_least=PROMISED_PYTHON,
        ),
        Row("lock-step", "one compiled tick", seconds["compiled"] / (length + 2) * 1e9, "ns"),
        Row("lock-step", "one tick of the cycle", seconds["python"] / (length + 2) * 1e9, "ns"),
    ]
