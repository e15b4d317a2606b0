"""Limits that come with golfbench are those of the shipped profiles, plant and controllers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.base.lifecycle import Cause
from bench.config._settings import Configuration
from bench.control.residual_thresholds import ENDING
from bench.control.settings import build_controller
from bench.simulation.plant_variation import healthy_plant, healthy_run
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import PROFILES, find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters
from sim.pneumatics import Actuator
from tests.bench.design.shipped_demands import designed_for
from tests.compiled_only import needs_speed

WITH_LIMITS = sorted(path.name.removesuffix(ENDING) for path in PROFILES.glob(f"*{ENDING}"))
ACTION = (
    "make them again: golfbench --config CONFIGURATION profile limits PROFILE [--club CLUB] --output FILE"
)


def watched(name: str) -> Configuration:
    """Return the configuration that the profile `name` was designed for, with its limits."""
    c, path = designed_for(name), find_profile(name)
    return replace(c, envelope=c.envelope.with_model_check("always")).for_profile(load_profile(path), path)


@pytest.mark.parametrize("name", WITH_LIMITS)
def test_shipped_limits_match_profile_and_configuration(name: str) -> None:
    c, path = designed_for(name), find_profile(name)
    found = c.limits_in_use(load_profile(path), path)
    assert not found.stale, f"{found.source}: {ACTION}"
    assert found.source.endswith(f"{name}{ENDING}")


@pytest.mark.release
@needs_speed
@pytest.mark.parametrize("name", WITH_LIMITS[:1])
def test_shipped_limits_healthy_run_reports_no_cause(name: str) -> None:
    c, profile = watched(name), load_profile(find_profile(name))
    parameters = build_controller(c.plant, profile, c.control, c.envelope, c.estimator)
    for seed in range(300, 303):
        run = healthy_run(healthy_plant(c.plant, seed), parameters, profile, seed)
        assert run is not None
        assert (run.cause, run.escalated) == (Cause.NONE, ())
        assert run.stops > 5


def worn(plant: PlantParameters, signs: tuple[float, float, float], lengths: float) -> PlantParameters:
    """Return `plant` with valves as months leave them, centres off by `signs`, and `lengths` (m) off."""

    def actuator(a: Actuator, sign: float) -> Actuator:
        valve = replace(
            a.valve,
            dead_band=a.valve.dead_band + 0.012,
            centre=a.valve.centre + 0.008 * sign,
            natural_frequency=0.8 * a.valve.natural_frequency,
        )
        return replace(a, valve=valve)

    r = plant.robot
    if lengths:
        robot = replace(r, l12=r.l12 + lengths, l16=r.l16 - lengths, l23=r.l23 + lengths, l56=r.l56 - lengths)
        late = replace(plant.encoders, latency=plant.encoders.latency + 6e-4)
        return replace(plant, robot=robot, wrist_lever=plant.wrist_lever + lengths, encoders=late)
    a, b, c = (actuator(one, sign) for one, sign in zip(plant.actuators, signs, strict=True))
    return replace(plant, shoulder=a, right_arm=b, wrist=c)


@needs_speed
@pytest.mark.parametrize(
    ("signs", "lengths"),
    [((-1.0, -1.0, -1.0), 0.0), ((1.0, 1.0, 1.0), 0.0), ((-1.0, 1.0, -1.0), 0.0), ((0.0, 0.0, 0.0), 1.5e-3)],
)
def test_shipped_limits_worn_robot_swings_without_cause(
    signs: tuple[float, float, float], lengths: float
) -> None:
    c, profile = watched("default"), load_profile(find_profile("default"))
    bench = Bench.of(c, profile)
    series = Series(bench, worn(c.plant, signs, lengths))
    assert [series.swing(profile).cause for _ in range(2)] == [Cause.NONE] * 2
