"""Swings with spool feedback: a stuck valve is reported within milliseconds, fault-free ones swing on."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Request
from bench.control.settings import build_controller
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.profile import Profile
from drivers.base import JOINTS
from sim.faults import Fault, own_records
from sim.plant import PlantParameters, build_plant
from tests.bench.control.monitor.test_position_monitor_spools import with_worn_valves

FITTED = PlantParameters(spool_feedback=True)
WORN = with_worn_valves(FITTED, 0.2, 0.012, 0.008)
BEGUN = dict[PlantParameters, Lockstep]()
"""By plant: armed and waited for once."""


def swinging(profile: Profile, plant: PlantParameters) -> Lockstep:
    """Return a bench of `plant`, whose controller knows the default plant, as its swing at a ball begins."""
    if plant not in BEGUN:
        BEGUN[plant] = begun(profile, plant)
    bench = BEGUN[plant].copy()
    bench.plant = own_records(bench.plant)
    return bench


def begun(profile: Profile, plant: PlantParameters) -> Lockstep:
    controller = build_controller(FITTED, profile)
    bench = Lockstep(own_records(build_plant(plant)), controller, profile.angle[0])
    engine = LockstepEngine(bench)
    assert engine.arm()
    assert engine.await_air()
    bench.state.control["tee"] = True
    bench.advance(1, Request.SWING)
    return bench


@pytest.mark.parametrize("plant", [FITTED, WORN], ids=["as known", "worn valves"])
def test_swing_with_spool_feedback_of_healthy_valves_not_stopped(
    default_profile: Profile, plant: PlantParameters
) -> None:
    bench = swinging(default_profile, plant)
    cycles = bench.advance(len(default_profile.angle) + 1000)
    assert Cause(int(bench.state.control["cause"][0])) is Cause.NONE
    assert bench.state.control["swing"]["struck"][0]
    assert np.isfinite(cycles["spool_position"]).all()


@pytest.mark.parametrize("joint", range(3), ids=JOINTS)
@pytest.mark.parametrize("share", [0.3, 0.75])
def test_swing_with_stuck_spool_stopped_within_10_ms(
    default_profile: Profile, joint: int, share: float
) -> None:
    bench = swinging(default_profile, FITTED)
    bench.advance(int(share * len(default_profile.angle)))
    position = bench.plant_state["spool"][0, joint]
    bench.break_with((Fault("stuck", f"{JOINTS[joint]} valve", "stuck", -1.0 if position > 0.0 else 1.0),))
    cycles = bench.advance(10)
    assert Cause(int(cycles["cause"][-1])) is Cause(Cause.SHOULDER_SPOOL + joint)


def test_swing_spool_feedback_changes_no_bit_of_healthy_swing(default_profile: Profile) -> None:
    with_, without = (swinging(default_profile, p).advance(800) for p in (FITTED, PlantParameters()))
    for name in with_.dtype.names or ():
        if name != "spool_position":
            assert with_[name].tobytes() == without[name].tobytes(), name
