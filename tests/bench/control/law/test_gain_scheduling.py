"""Model-based gains: every pose keeps the required margins, also for plants of other sizes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.control.law.gain_scheduling import MachineGains, machine_gains, pose_grid, worst_margin
from bench.control.law.gain_table import SHAPE, gains_at
from bench.control.law.linear_loop import at_rest, estimator_response, linearize, steady_estimator
from bench.control.settings import ControlSettings, EstimatorSettings, build_controller, estimator_record
from bench.simulation.plant_variation import WORN
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters, build_plant
from sim.pneumatics import Actuator
from tests.sampling import release_except

TOLERANCE, TIMEOUT = (0.015, 0.010, 0.020), 6.0


def found_for(plant: PlantParameters) -> MachineGains:
    return machine_gains(plant, estimator_record(EstimatorSettings(), plant), TOLERANCE, TIMEOUT)


def with_valves(plant: PlantParameters, **changes: float) -> PlantParameters:
    def changed(actuator: Actuator) -> Actuator:
        valve = actuator.valve
        return replace(
            actuator, valve=replace(valve, **{k: getattr(valve, k) * v for k, v in changes.items()})
        )

    return replace(
        plant,
        shoulder=changed(plant.shoulder),
        right_arm=changed(plant.right_arm),
        wrist=changed(plant.wrist),
    )


SHIPPED = PlantParameters()
PLANTS = {
    "shipped": SHIPPED,
    "worn": WORN.applied_to(SHIPPED),
    "low supply": replace(SHIPPED, supply=replace(SHIPPED.supply, pressure=6.5e5)),
    "larger valves": with_valves(SHIPPED, conductance=1.3),
    "smaller valves": with_valves(SHIPPED, conductance=0.7),
    "faster spools": with_valves(SHIPPED, natural_frequency=1.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", release_except({"shipped", "worn"}, PLANTS))
def test_machine_gains_each_pose_keeps_margins(name: str) -> None:
    """Also between the poses by which the gains were found."""
    plant = PLANTS[name]
    found = found_for(plant)
    assert found.worst.share >= 1.0
    filters = estimator_record(EstimatorSettings(), plant)
    estimator = steady_estimator(filters, plant.tick, plant.encoders.latency)
    built = build_plant(plant)
    lower, spacing = pose_grid(plant)
    shares = []
    for part in np.random.default_rng(1).uniform(0.0, 1.0, (40, 3)):
        pose = lower + spacing * part * (np.array(SHAPE) - 1)
        frozen = linearize(built, at_rest(built, pose))
        estimated = estimator_response(estimator, frozen.frequency, plant.tick)
        gains = gains_at(found.table, pose)
        shares.append(worst_margin(frozen, estimator, estimated, gains, plant.tick).share)
    assert min(shares) >= 0.9
    assert np.quantile(shares, 0.1) >= 1.0


@pytest.mark.release
def test_machine_gains_unreachable_margins_report_worst_margin() -> None:
    late = replace(
        with_valves(SHIPPED, natural_frequency=0.4), encoders=replace(SHIPPED.encoders, latency=0.003)
    )
    found = found_for(late)
    assert found.worst.share < 1.0
    assert found.worst.name
    assert found.delay == pytest.approx(0.003 + 1.5e-3 + 2 * 0.8 / (2 * np.pi * 40.0), rel=1e-6)


def test_machine_gains_follow_lever_and_inertia() -> None:
    """A cocked wrist's cylinder has a third of its lever: the same opening turns it three times as fast."""
    found = found_for(SHIPPED)
    straight, cocked = found.table["table"][0, 3, 2, -1], found.table["table"][0, 3, 2, 0]
    move, proportional = 4, 0
    assert cocked[move, 2] < 0.4 * straight[move, 2]
    assert cocked[proportional, 2] > 2.0 * straight[proportional, 2]


def test_machine_gains_leave_dead_band_within_half_timeout() -> None:
    gains = found_for(SHIPPED).table["table"][0]
    opened = (gains[..., 0, :] + gains[..., 1, :] * TIMEOUT / 2) * TOLERANCE
    assert np.all(opened >= 1.2 * SHIPPED.shoulder.valve.dead_band * (1 - 1e-9))


def test_machine_gains_other_encoder_zeros_return_cached_gains() -> None:
    other = replace(
        SHIPPED, seed=5, encoders=replace(SHIPPED.encoders, zero_count=(10.0, 20.0, 30.0), noise=1e-4)
    )
    assert found_for(other) is found_for(SHIPPED)


def test_build_controller_gains_machine_uses_gain_schedule() -> None:
    profile = load_profile(find_profile("default"))

    def record(source: Any) -> Any:
        return build_controller(SHIPPED, profile, ControlSettings(gains=source))

    machine, hand = record("machine"), record("hand")
    assert np.ptp(machine.pid["table"][0], axis=(0, 1, 2)).max() > 0
    assert np.ptp(hand.pid["table"][0], axis=(0, 1, 2)).max() == 0
    assert machine.pid["supply"][0] == SHIPPED.supply.pressure
    assert hand.pid["supply"][0] == 0
    assert machine.control["move_band"][0].tolist() == [0.02] * 3
    assert hand.control["move_band"][0].tolist() == [0.0] * 3
