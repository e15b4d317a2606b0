"""The engine of simulated swings: arming, refusal, and going back to an instant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.base.lifecycle import Phase
from bench.control.settings import build_controller
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.profile import Profile
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed

PLANT = PlantParameters()

pytestmark = needs_speed


def bench_on(profile: Profile) -> LockstepEngine:
    stepper = Lockstep(build_plant(PLANT), build_controller(PLANT, profile), profile.angle[0])
    return LockstepEngine(stepper, name=profile.name)


def test_lockstep_engine_go_back_and_copy_repeat_swing_exactly(default_profile: Profile) -> None:
    bench = bench_on(default_profile)
    assert bench.arm()
    assert bench.resting()
    mark, twin = bench.mark(), bench.copy()
    records = []
    for engine in (bench, bench, twin):
        if engine is bench:
            bench.go_back(mark)
        engine.begin_record()
        engine.reset_peaks()
        engine.tee_up(ball=True)
        assert engine.start_swing(50, 10)
        engine.advance(len(default_profile.angle))
        assert engine.run_until(engine.holding, 10.0)
        records.append(engine.record().tobytes())
        assert 0.0 < engine.loads().stop_share < 1.0
    assert len(set(records)) == 1


def test_lockstep_engine_low_supply_arm_is_refused_at_rest(default_profile: Profile) -> None:
    airless = replace(PLANT, supply=replace(PLANT.supply, pressure=1.5e5))
    stepper = Lockstep(
        build_plant(airless), build_controller(PLANT, default_profile), default_profile.angle[0]
    )
    bench = LockstepEngine(stepper, name="without air")
    with pytest.raises(Refused) as refused:
        bench.arm()
    assert "'without air'" in refused.value.location
    assert "hold at address" in refused.value.expected
    assert bench.phase is Phase.STANDING
    assert not stepper.command["valve"].any()


def test_lockstep_engine_stop_request_ends_arming_at_rest(default_profile: Profile) -> None:
    stepper = Lockstep(build_plant(PLANT), build_controller(PLANT, default_profile), default_profile.angle[0])
    bench = LockstepEngine(stepper, stop=lambda: stepper.tick > 200)
    assert not bench.arm()
    assert bench.phase is Phase.STANDING
    assert np.all(np.abs(bench.plant_state["speed"]) < 0.2)
