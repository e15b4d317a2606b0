"""Spools with position feedback: one that does not follow its command is reported within milliseconds."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase, Reaction, Refusal, Request, State
from bench.control.envelope import ENVELOPE_PARAMETERS
from bench.control.estimate.air import move_spool
from bench.control.monitor.position_monitor import monitor_spools, spool_cause
from bench.control.step_records import CONTROL_STATE, SPOOLS
from drivers.base import JOINTS
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from sim.plant import PlantParameters, build_plant
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import Puppet

TICK = 1e-3
CAUSES = [Cause.SHOULDER_SPOOL, Cause.ARM_SPOOL, Cause.WRIST_SPOOL]


def with_worn_valves(
    plant: PlantParameters, slower: float, dead_band: float, centre: float
) -> PlantParameters:
    """Return `plant` with valves that differ by so much."""
    for name in ("shoulder", "right_arm", "wrist"):
        actuator = getattr(plant, name)
        valve = replace(
            actuator.valve,
            natural_frequency=(1.0 - slower) * actuator.valve.natural_frequency,
            dead_band=actuator.valve.dead_band + dead_band,
            centre=actuator.valve.centre + centre,
        )
        plant = replace(plant, **{name: replace(actuator, valve=valve)})
    return plant


def plant_record(*changes: float) -> np.ndarray:
    """Return the parameters of the default plant, its valves changed as `with_worn_valves` does."""
    return build_plant(with_worn_valves(PlantParameters(), *changes or (0.0, 0.0, 0.0))).plant


class Valves:
    """The monitor with spools that truly move, read `late` ticks after the fact."""

    def __init__(self, truth: np.ndarray | None = None, late: int = 0) -> None:
        self.control, self.readings = new_record(CONTROL_STATE), new_record(READINGS)
        self.limits, self.true = new_record(ENVELOPE_PARAMETERS), new_record(SPOOLS)
        self.limits["spool_tolerance"], self.limits["spool_timeout"] = 0.1, 0.005
        self.control["device_operational"] = True
        self.model, self.truth = plant_record(), plant_record() if truth is None else truth
        self.stuck = np.full(3, nan)
        """Where each spool is stuck; NaN: it obeys."""
        self.past = [np.zeros(3)] * (late + 1)

    def tick(self, command: tuple[float, float, float], shown: tuple[float, ...] | None = None) -> Cause:
        """Obey `command` for a tick; return the monitor's verdict on `shown`, the truth if None."""
        self.control["applied"] = command
        for i in range(3):
            held = command[i] if np.isnan(self.stuck[i]) else self.stuck[i]
            move_spool(
                self.true[0],
                self.truth[0],
                held - self.truth["centre"][0, i],
                i,
                2 * int(self.truth["substeps"][0]),
            )
        self.past = [*self.past[1:], self.true["spool"][0].copy()]
        self.readings["spool_position"] = self.past[0] if shown is None else shown
        monitor_spools(self.control[0], self.limits[0], self.model[0], self.readings, TICK)
        return Cause(spool_cause(self.control[0]))


def swept(k: int) -> float:
    """Return the opening at tick `k` of a command as lively as a swing's: dither, steps, full strokes."""
    steps = (0.0, 0.4, -0.3, 1.0, -1.0, 0.2)
    return float(np.clip(steps[k // 60 % len(steps)] + (0.1 if k // 15 % 2 else -0.1), -1.0, 1.0))


@pytest.mark.parametrize("joint", range(3), ids=JOINTS)
@pytest.mark.parametrize("where", [1.0, -1.0, 0.0])
def test_monitor_spools_stuck_spool_found_within_8_ms(joint: int, where: float) -> None:
    valves = Valves()
    for _ in range(50):
        assert valves.tick((0.4, 0.4, 0.4)) is Cause.NONE
    valves.stuck[joint] = where
    found = [valves.tick((0.4, 0.4, 0.4)) for _ in range(8)]
    assert found[-1] is CAUSES[joint]
    assert found[0] is Cause.NONE


@pytest.mark.parametrize("late", [0, 1, 2])
@pytest.mark.parametrize(
    ("slower", "band", "centre"), [(0.0, 0.0, 0.0), (0.2, 0.012, 0.008), (-0.2, -0.012, -0.008)]
)
def test_monitor_spools_healthy_valve_not_named(late: int, slower: float, band: float, centre: float) -> None:
    valves = Valves(plant_record(slower, band, centre), late)
    for k in range(600):
        assert valves.tick((swept(k), swept(k + 20), swept(k + 40))) is Cause.NONE, k


@pytest.mark.parametrize("shown", [nan, inf, 0.5])
def test_monitor_spools_no_number_while_fitted_found(shown: float) -> None:
    valves = Valves()
    valves.tick((0.0, 0.0, 0.0))
    found = [valves.tick((0.0, 0.0, 0.0), (0.0, shown, 0.0)) for _ in range(6)]
    assert found == [Cause.NONE] * 5 + [Cause.ARM_SPOOL]
    for _ in range(10):
        found.append(valves.tick((0.0, 0.0, 0.0)))
    assert found[-1] is Cause.NONE


def test_monitor_spools_invalid_from_start_found() -> None:
    valves = Valves()
    assert [valves.tick((0.0,) * 3, (nan, nan, inf)) for _ in range(6)][-1] is Cause.WRIST_SPOOL


def test_monitor_spools_not_fitted_nothing_remembered() -> None:
    valves = Valves()
    for k in range(60):
        assert valves.tick((swept(k), 0.0, 0.0), (nan,) * 3) is Cause.NONE
    assert valves.control["spools"].tobytes() == bytes(SPOOLS.itemsize)


def test_monitor_spools_passive_device_not_judged() -> None:
    valves = Valves()
    valves.control["device_operational"] = False
    assert {valves.tick((0.0,) * 3, (1.0,) * 3) for _ in range(20)} == {Cause.NONE}


def fitted(puppet: Puppet) -> Puppet:
    """Let the spools of `puppet`, whose commands are small, show their centre."""
    puppet.parameters.envelope["spool_tolerance"] = 0.4
    return puppet.give(spool_position=(0.0,) * 3)


@pytest.mark.parametrize(
    ("phase", "joint", "reaction"),
    [
        (Phase.HOLD, 0, Reaction.PASSIVE),
        (Phase.HOLD, 2, Reaction.PASSIVE),
        (Phase.DOWNSWING, 0, Reaction.PASSIVE),
        (Phase.DOWNSWING, 2, Reaction.BRAKE),
        (Phase.COMMITTED, 1, Reaction.PASSIVE),
        (Phase.FOLLOW_THROUGH, 2, Reaction.COMPLETE),
    ],
)
def test_monitor_motion_misplaced_spool_reacts_as_wrong_flow(
    phase: Phase, joint: int, reaction: Reaction
) -> None:
    puppet = fitted(Puppet()).enter(phase)
    shown = [0.0] * 3
    shown[joint] = -1.0
    puppet.give(spool_position=shown).run(6)
    assert (puppet.cause, puppet.reaction) == (CAUSES[joint], reaction)


def test_monitor_standstill_misplaced_spool_latches_and_refuses_reset() -> None:
    puppet = fitted(reach(State.READY))
    puppet.run(10)
    assert puppet.bench is State.READY
    puppet.give(spool_position=(0.0, 0.0, 0.9)).run(10)
    assert (puppet.bench, puppet.cause) == (State.FAULT, Cause.WRIST_SPOOL)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.VENT
    puppet.give(spool_position=(0.0,) * 3).run(50)
    press(puppet)
    assert asked(puppet, Request.RESET) is Refusal.NONE
