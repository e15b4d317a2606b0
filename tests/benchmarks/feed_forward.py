"""What feed-forward by the model costs in the tick: one step of a downswing with each, side by side.

The step runs on the readings of one instant again and again; what putting its state back takes is taken off.
The clock is the thread's own processor time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from bench.control.feed_forward import CODES
from bench.control.records import ControlParameters, ControlState
from bench.control.settings import ControlSettings, build_controller
from bench.control.step import step
from bench.simulation.lockstep import Lockstep
from bench.simulation.simulated_bench import SimulatedBench, begin_swing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from bench.telemetry.cycle_record import CYCLE
from drivers.base.compiled import compiled, new_record
from sim.plant import sense
from tests.benchmarks.row import Row
from tests.benchmarks.stopwatch import Work, in_turn

INTO_DOWNSWING = 60
"""Ticks after which the readings are taken."""
_RESTORED = 5
"""Steps until the state is put back, so that no limit is met."""


@compiled
def _steps(
    state: ControlState,
    parameters: ControlParameters,
    readings: Any,
    time: float,
    command: Any,
    cycle: Any,
    count: int,
) -> None:
    """Run `count` ticks of a millisecond on the same readings."""
    for k in range(count):
        step(state, parameters, readings, time + 0.001 * k, command, cycle)


def _step_only(bench: Lockstep, parameters: ControlParameters, count: int = _RESTORED) -> Work:
    """Return the work of n times `count` steps with `parameters` from where `bench` is."""
    cycle, command = new_record(CYCLE), bench.command.copy()
    begun = ControlState(*(record.copy() for record in bench.state))
    state = ControlState(*(record.copy() for record in bench.state))
    sense(bench.plant.plant, bench.plant_state, bench.readings)
    time = bench.tick * bench.plant.parameters.tick

    def work(n: int) -> None:
        for _ in range(n):
            for record, then in zip(state, begun, strict=True):
                record[:] = then
            _steps(state, parameters, bench.readings, time, command, cycle, count)

    return work


def run() -> list[Row]:
    """Measure; some seconds once compiled."""
    profile = load_profile(find_profile("default"))
    made = SimulatedBench(profile)
    bench, _ = begin_swing(made, None)
    bench.advance(profile.begins[3] + INTO_DOWNSWING)
    bench.plant = replace(bench.plant, plant=bench.plant.plant.copy())
    bench.plant.plant["pressure_sensors"] = False  # what has to be observed costs most
    works: dict[str, Work] = {
        name: _step_only(bench, build_controller(made.plant, profile, ControlSettings(feed_forward=name)))
        for name in CODES
    }
    works[""] = _step_only(bench, build_controller(made.plant, profile), count=0)
    taken = {name: float(np.median(t)) for name, t in in_turn(works).items()}
    times: dict[str, float] = {name: (taken[name] - taken[""]) / _RESTORED for name in CODES}
    rows = [Row("feed-forward", f"one step, {name}", times[name], "ns") for name in CODES]
    for name, limit in (("kane", 1.5), ("kane+pneumatic", 2.0)):
        ratio = times[name] / times["planned"]
        rows.append(Row("feed-forward", f"{name} over planned", ratio, "times", at_most=limit))
    return rows
