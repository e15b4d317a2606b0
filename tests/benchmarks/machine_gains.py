"""Margins over the working range, with gains from the machine and with gains by hand: `... machine_gains`.

Plants of several sizes, each at poses drawn evenly from its working range. The figure is the worst share of
the required margins (gain 2, phase 30°, delay 3 ms, damping ratio 0.1) that any loop keeps there, 1 where all
are kept, negative where a mode grows; and the share of the poses that keep them all.

With `--tracking` each plant follows the default swing at 80 % of its speed instead, valves opened by
"kane+pneumatic", which needs no plan: root mean square of the following errors, mrad, up to the top and in
the downswing. The worn robot is controlled as the shipped one.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from bench.commissioning.slowed_swing import slowed
from bench.config import load_configuration
from bench.control.gain_table import SHAPE, gains_at
from bench.control.linear_loop import estimator_response, steady_estimator
from bench.control.linear_plant import at_rest, freeze
from bench.control.machine_gains import pose_grid, worst_margin
from bench.control.planned_air import with_planned_air
from bench.control.settings import ControlSettings, EstimatorSettings, estimator_record, pid_record
from bench.simulation.series import Bench
from bench.simulation.variation import WORN
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from bench.tuning.proof import proof
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator
from tests.bench.hand_gains import HAND
from tests.benchmarks.row import Row

NAME = "machine_gains"
_SHARE, _LEAST = 0.8, 5e5
"""Of the speed of the swing that is followed; Pa of supply with which it may begin."""


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the worst shares of the required margins, by plant and gains."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks machine_gains")
    parser.add_argument("--poses", type=int, default=200)
    parser.add_argument("--tracking", action="store_true", help="Following errors instead of margins.")
    options = parser.parse_args(arguments)
    if options.tracking:
        return [row for name, plant in plants().items() for row in _tracked(name, plant)]
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


def _tracked(name: str, plant: PlantParameters) -> list[Row]:
    """Return how closely `plant` follows the slower default swing, by source of the gains."""
    c = load_configuration(Path("shipped"))
    c = replace(c, plant=c.plant if name == "worn" else plant)
    slower = slowed(load_profile(find_profile("default")), _SHARE, c)
    envelope = replace(c.envelope.with_model_check("off"), following={}, min_supply_pressure=_LEAST)
    planned, rows = with_planned_air(slower, c.plant), []
    for source, control in (("hand", HAND), ("machine", ControlSettings())):
        found = proof(
            Bench(c.plant, planned, replace(control, feed_forward="kane+pneumatic"), envelope, c.estimator),
            plant,
        )
        backswing, downswing = ("·".join(f"{1e3 * e:.0f}" for e in errors) for errors in found[:2])
        note = found.failure or f"{backswing} and {downswing} mrad of shoulder·arm·wrist"
        rows.append(
            Row(NAME, f"{name}: worst error, {source}", 1e3 * max(*found[0], *found[1]), "mrad", note)
        )
    return rows


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
