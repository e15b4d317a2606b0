"""Margins: the linear loop is the plant's, and its predicted growth occurs."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bench.config import load_configuration, shipped_configuration
from bench.control.law.gain_table import Gains
from bench.control.law.linear_loop import Estimator, LinearPlant, least_damping, linearize, steady_estimator
from bench.control.settings import estimator_record
from bench.learning.along_swing import LoopMargins, gains_along, judge, operating_points
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import advance, build_plant
from tests.bench.hand_gains import HAND
from tests.compiled_only import needs_speed
from tests.conftest import Run


@pytest.fixture(scope="module")
def bench() -> Bench:
    """Return the shipped configuration and its swing, with gains by hand."""
    c = load_configuration(shipped_configuration())
    return Bench(load_profile(find_profile(c.swing.profile)), c.plant, HAND, c.envelope)


def by_hand(bench: Bench) -> Gains:
    pid, control = bench.control.pid, bench.control
    return Gains(pid.proportional, pid.integral, pid.derivative, control.damping, control.move_gain)


def with_joint(gains: Gains, joint: int, **values: float) -> Gains:
    rows = {name: list(getattr(gains, name)) for name in values}
    for name, value in values.items():
        rows[name][joint] = value
    return gains._replace(**{name: tuple(row) for name, row in rows.items()})


@pytest.fixture(scope="module")
def plants(bench: Bench) -> list[LinearPlant]:
    plant = build_plant(bench.plant)
    return [linearize(plant, point) for point in operating_points(bench)]


@pytest.fixture(scope="module")
def estimator(bench: Bench) -> Estimator:
    filters = estimator_record(bench.estimator, bench.plant)
    return steady_estimator(filters, bench.plant.tick, bench.plant.encoders.latency)


@needs_speed
def test_linearize_small_valve_step_matches_plant_response(bench: Bench, plants: list[LinearPlant]) -> None:
    """From one state of the backswing, sliding without dry friction, with two openings a little apart."""
    actuators = {
        name: replace(
            getattr(bench.plant, name),
            friction=replace(getattr(bench.plant, name).friction, coulomb=0.0, static=0.0),
        )
        for name in ("shoulder", "right_arm", "wrist")
    }
    plant = build_plant(replace(bench.plant, **actuators))
    series = Series(bench, bench.plant)
    series.settle(swings=0)
    series.swing_again(bench.profile, bench.profile.begins[1] + 400)
    stepper = series._engine.stepper
    state, command = stepper.plant_state, stepper.command.copy()
    command["valve"] = [0.08, -0.08, 0.08]  # beyond the dead band, and not much: the pressures change slowly
    state["spool"], state["spool_speed"] = command["valve"], 0.0
    point = plants[1].point._replace(
        motion=np.concatenate([state["angle"][0], state["speed"][0], state["pressure"][0]]),
        supply=float(state["supply_pressure"][0]),
        opening=command["valve"][0].copy(),
    )
    frozen, ticks, small = linearize(plant, point), 5, 0.01
    for joint in range(3):
        ends = []
        for side in (1.0, -1.0):
            moved, opened = state.copy(), command.copy()
            opened["valve"][0, joint] += side * small
            for _ in range(ticks):
                advance(*plant.records, moved, opened)
            ends.append(np.concatenate([moved["angle"][0], moved["speed"][0], moved["pressure"][0]]))
        truth = (ends[0] - ends[1]) / (2 * small)
        told = np.zeros(18)
        for _ in range(ticks):
            told = frozen.transition @ told + frozen.input[:, joint]
        for rows in (slice(3, 6), slice(6, 12)):
            assert told[rows] == pytest.approx(truth[rows], abs=0.08 * np.abs(truth[rows]).max())


@needs_speed
def test_least_damping_stiff_wrist_predicts_hunting(
    bench: Bench, plants: list[LinearPlant], estimator: Estimator
) -> None:
    """With this stiff wrist the loop was seen to swing at 4 Hz in a backswing; with the soft one not."""
    soft = by_hand(bench)
    stiff = with_joint(soft, 2, proportional=0.75, integral=0.45, derivative=0.028, damping=0.0004)
    judged = [frozen for frozen in plants if frozen.point.judged]
    ratios = [
        min(least_damping(frozen, estimator, gains, bench.plant.tick) for frozen in judged)
        for gains in (stiff, soft)
    ]
    assert ratios[0] < 0.03
    assert ratios[1] > 2.0 * ratios[0]


@needs_speed
def test_judge_gain_margin_matches_closed_loop_instability(
    bench: Bench, plants: list[LinearPlant], estimator: Estimator
) -> None:
    """Loop margins and closed-loop modes agree, computed independently."""
    frozen, gains, period = plants[2], by_hand(bench), bench.plant.tick
    for joint in range(3):
        loop = judge([frozen], estimator, lambda _: gains, period).loops[joint]
        assert loop.margins.gain > 1

        def raised(factor: float, joint: int = joint) -> Gains:
            own = {name: factor * getattr(gains, name)[joint] for name in gains._fields}
            return with_joint(gains, joint, **own)

        below, above = (raised(part * loop.margins.gain) for part in (0.97, 1.03))
        assert least_damping(frozen, estimator, below, period) > 0
        assert least_damping(frozen, estimator, above, period) < 0


@needs_speed
def test_gains_along_machine_gains_exceed_hand_gain_margins(
    bench: Bench, plants: list[LinearPlant], estimator: Estimator
) -> None:
    judged = [frozen for frozen in plants if frozen.point.judged]
    assert [frozen.point.name for frozen in judged] == ["address", "backswing 1/3", "backswing 2/3"]

    def found(source: Any) -> LoopMargins:
        made = replace(bench, control=replace(bench.control, gains=source))
        return judge(judged, estimator, gains_along(made), bench.plant.tick)

    hand, machine = found("hand"), found("machine")
    for name in ("phase", "delay"):
        by_hand, by_machine = (
            min(getattr(loop.margins, name) for loop in one.loops) for one in (hand, machine)
        )
        assert by_machine > by_hand
    assert min(machine.damping_ratio.values()) >= 0.1


@needs_speed
def test_tune_command_shows_margins_and_swings(run: Run) -> None:
    def shown(*options: str) -> str:
        code, text, _ = run("tune", *options)
        assert code == 0
        return text

    told, text = json.loads(shown("--json")), shown()
    assert len(told["margins"]) == 21
    assert [told["swings"][robot]["failure"] for robot in ("nominal", "worn")] == [None, None]
    assert "backswing 2/3" in text
    assert "nominal robot: " in text
