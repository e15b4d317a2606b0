"""The `sim` driver with faults in the Python cycle, and the lock-step bench with the same: the same bits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bench.swing
from bench.base.clock import FreeClock
from bench.base.lifecycle import Cause, Phase, Request
from bench.control.settings import build_controller
from bench.loop.loop import Cycle, CycleArray
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.profile import load_profile
from sim.driver import SimDriver, hanging_pose
from sim.faults import Fault
from sim.plant import PlantParameters, build_plant
from tests.compiled_only import needs_speed

pytestmark = needs_speed

PRESSURE_TIMEOUT = 500
"""Looks at the air of the address."""
FAULTS = {
    "signals": (
        Fault("late", "wrist encoder", "delayed", 0.002, time=3.0, duration=0.5),
        Fault("noise", "arm encoder", "intermittent", 0.1, phase="backswing"),
        Fault("sagging", "supply", "scale", 0.9, time=5.0),
        Fault("leak", "arm valve", "leaking", 0.01, joint="shoulder", angle=-1.0),
    ),
    "a valve that sticks": (Fault("stuck", "shoulder valve", "stuck", 1.0, phase="top"),),
    "nothing yet": (Fault("later", "link", "off", time=1000.0),),
}


class Follower:
    """Passes the phase to the driver before each tick, as the loop's process does."""

    def __init__(self, cycle: Cycle, driver: SimDriver, clock: FreeClock) -> None:
        self.cycle, self.driver, self.clock = cycle, driver, clock

    def advance(self, ticks: int, request: int = 0) -> np.ndarray:
        kept = CycleArray(ticks)
        self.cycle.publish = kept
        if request:
            self.cycle.request(request)
        for _ in range(ticks):
            self.driver.phase = int(self.cycle.state.control["phase"][0])
            self.cycle.run_tick(self.clock.wait())
        return kept.cycles


@pytest.mark.parametrize("name", ["signals", "a valve that sticks"])
def test_sim_driver_faults_match_lock_step(name: str) -> None:
    profile = load_profile(Path(bench.swing.__path__[0]) / "profiles" / "default.toml")
    parameters = PlantParameters()
    start = hanging_pose(parameters)
    lockstep = Lockstep(build_plant(parameters), build_controller(parameters, profile), start, FAULTS[name])
    driver = SimDriver(parameters, start, faults=FAULTS[name])
    driver.open()
    cycle = Cycle(
        driver,
        build_controller(parameters, profile),
        lambda _: None,
        name="sim",
        note_truth=driver.note_truth,
    )
    python = Follower(cycle, driver, FreeClock(parameters.tick))

    def advance(ticks: int, request: int = 0) -> None:
        ours, theirs = lockstep.advance(ticks, request), python.advance(ticks, request)
        assert ours.tobytes() == theirs.tobytes()

    advance(10)
    advance(5500, Request.ARM)  # the timed faults have come
    for _ in range(PRESSURE_TIMEOUT):
        if lockstep.state.control["address_air"]["ready"][0]:
            break
        advance(20)
    advance(1500, Request.SWING)
    cause = Cause(int(lockstep.state.control["cause"][0]))
    assert (cause is Cause.NONE) is (name != "a valve that sticks")


def test_lock_step_pending_fault_is_bit_equal_to_fault_free() -> None:
    profile = load_profile(Path(bench.swing.__path__[0]) / "profiles" / "default.toml")
    parameters = PlantParameters()
    healthy = Lockstep(build_plant(parameters), build_controller(parameters, profile), profile.angle[0])
    engine = LockstepEngine(healthy)
    assert engine.arm()
    assert engine.await_air()
    faulty = healthy.copy()
    faulty.break_with(FAULTS["nothing yet"])
    ours, theirs = healthy.advance(2900, Request.SWING), faulty.advance(2900, Request.SWING)
    assert ours.tobytes() == theirs.tobytes()
    assert Phase(int(healthy.state.control["phase"][0])) is Phase.RETURN
