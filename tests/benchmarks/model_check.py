"""What the model-based check costs: the same swing in lock-step with it and without, and the plant alone.

One core, the thread's own processor time, in turn.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.config import load_configuration, shipped_configuration
from bench.control.settings import build_controller
from bench.lifecycle import Request
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base import COMMAND, READINGS
from drivers.base.compiled import compiled, new_record
from sim.driver import hanging_pose
from sim.plant import advance, build_plant, initial_state, sense
from tests.benchmarks.row import Row
from tests.benchmarks.stopwatch import Work, in_turn

GREATEST_SHARE = 0.5
"""Of a tick's period that the decision may take, whatever it checks."""


@compiled
def _plant_alone(
    robot: Any, plant: Any, impact: Any, state: Any, readings: Any, command: Any, n: int
) -> None:
    for _ in range(n):
        sense(plant, state, readings)
        advance(robot, plant, impact, state, command)


def run() -> list[Row]:
    """Measure; some seconds."""
    c = load_configuration(shipped_configuration())
    profile = load_profile(find_profile(c.swing.profile))
    ticks = len(profile.angle)
    works: dict[str, Work] = {}
    always, off = (replace(c.envelope.model, check="always"), replace(c.envelope.model, check="off"))
    for name, model in (("with", always), ("without", off)):
        envelope = replace(c.envelope, model=model)
        bench = Lockstep(
            build_plant(c.plant),
            build_controller(c.plant, profile, c.control, envelope, c.estimator),
            hanging_pose(c.plant),
        )
        bench.advance(200)
        LockstepEngine(bench).arm()
        works[name] = _swings(bench, ticks)
    plant = build_plant(c.plant)
    state = initial_state(plant, hanging_pose(c.plant))
    readings, command = new_record(READINGS), new_record(COMMAND)
    command["guard_lock"] = True
    works["plant"] = lambda n: _plant_alone(*plant.records, state, readings, command, n * ticks)
    tick = {name: float(np.median(t)) / ticks for name, t in in_turn(works, rounds=15, sample_s=0.05).items()}
    decision = {name: tick[name] - tick["plant"] for name in ("with", "without")}
    note = f"{decision['with']:.0f} and {decision['without']:.0f} ns; the plant {tick['plant']:.0f} ns a tick"
    return [
        Row(
            "model check",
            "decision of a tick with it to one without",
            decision["with"] / decision["without"],
            "times",
            note,
        ),
        Row("model check", "tick of plant and decision, the same", tick["with"] / tick["without"], "times"),
        Row(
            "model check",
            "share of a tick's period that the decision takes with it",
            decision["with"] * 1e-9 / c.plant.tick,
            "",
            at_most=GREATEST_SHARE,
        ),
    ]


def _swings(bench: Lockstep, ticks: int) -> Work:
    """Return the work of swinging n times from one and the same address."""

    def work(n: int) -> None:
        for _ in range(n):
            bench.copy().advance(ticks, Request.SWING)

    return work
