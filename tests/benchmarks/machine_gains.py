"""Margins over the working range, with gains from the machine and with gains by hand: `... machine_gains`.

Plants of several sizes, each at poses drawn evenly from its working range. The figure is the worst share of
the required margins (gain 2, phase 30°, delay 3 ms, damping ratio 0.1) that any loop keeps there, 1 where all
are kept, negative where a mode grows; and the share of the poses that keep them all.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.config import load_configuration
from bench.control.gain_table import SHAPE, gains_at
from bench.control.linear_loop import estimator_response, steady_estimator
from bench.control.linear_plant import at_rest, freeze
from bench.control.machine_gains import pose_grid, worst_margin
from bench.control.settings import ControlSettings, EstimatorSettings, estimator_record, pid_record
from bench.simulation.variation import WORN
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator
from tests.bench.hand_gains import HAND
from tests.benchmarks.row import Row

NAME = "machine_gains"


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the worst shares of the required margins, by plant and gains."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks machine_gains")
    parser.add_argument("--poses", type=int, default=200)
    options = parser.parse_args(arguments)
    rows = []
    for name, plant in plants().items():
        for source in ("hand", "machine"):
            control = replace(HAND, gains=source)
            begin = perf_counter()
            shares = np.array(_shares(plant, control, options.poses))
            note = (
                f"{100 * np.mean(shares >= 1):.0f} % of {options.poses} poses, {perf_counter() - begin:.1f} s"
            )
            rows.append(Row(NAME, f"{name}: worst share, gains by {source}", shares.min(), "", note))
    return rows


def plants() -> dict[str, PlantParameters]:
    """Return plants of several sizes."""
    shipped, small = PlantParameters(), load_configuration(Path("small_plant")).plant

    def changed(actuator: Actuator, area: float, conductance: float, frequency: float) -> Actuator:
        valve = actuator.valve
        valve = replace(
            valve,
            conductance=conductance * valve.conductance,
            natural_frequency=frequency * valve.natural_frequency,
        )
        return replace(actuator, area_a=area * actuator.area_a, area_b=area * actuator.area_b, valve=valve)

    def resized(area: float = 1.0, conductance: float = 1.0, frequency: float = 1.0) -> PlantParameters:
        a, b, c = (changed(one, area, conductance, frequency) for one in shipped.actuators)
        return replace(shipped, shoulder=a, right_arm=b, wrist=c)

    return {
        "shipped": shipped,
        "worn": WORN.applied_to(shipped),
        "small": small,
        "low supply": replace(shipped, supply=replace(shipped.supply, pressure=6.5e5)),
        "areas + 25 %, valves - 30 %": resized(1.25, 0.7),
        "areas - 25 %, valves + 30 %": resized(0.75, 1.3),
        "cylinders of 63 mm, valves + 80 %": resized(1.56, 1.8),
        "spools of 60 Hz": resized(frequency=0.6),
        "spools of 150 Hz": resized(frequency=1.5),
    }


def _shares(plant: PlantParameters, control: ControlSettings, count: int) -> list[float]:
    """Return the worst share at each pose."""
    settings = EstimatorSettings()
    filters, period = estimator_record(settings, plant), plant.tick
    estimator = steady_estimator(filters, period, plant.encoders.latency)
    record, built = pid_record(control, settings, plant), build_plant(plant)
    lower, spacing = pose_grid(plant)
    shares = []
    for part in np.random.default_rng(0).uniform(0.0, 1.0, (count, 3)):
        pose = lower + spacing * part * (np.array(SHAPE) - 1)
        frozen = freeze(built, at_rest(built, pose))
        estimated = estimator_response(estimator, frozen.frequency, period)
        shares.append(worst_margin(frozen, estimator, estimated, gains_at(record, pose), period).share)
    return shares
