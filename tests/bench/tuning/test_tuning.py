"""Tuning: the linear loop is the plant's, what it says grows does grow, and both methods do what they say."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from bench.cli import main
from bench.config import load_configuration, shipped_configuration
from bench.control.gains import Gains
from bench.control.linear_loop import Estimator, least_damping, steady_estimator
from bench.control.linear_plant import Frozen, freeze
from bench.control.settings import ControlSettings, estimator_record
from bench.simulation.series import Bench, settled
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from bench.tuning.along_swing import Judged, gains_along, judge, operating_points
from bench.tuning.gains import gains_of, with_gains
from bench.tuning.gains_file import gains_file, machine_gains_file
from bench.tuning.recipe import STEP, Steps, StepTrial, step_profile, tune_by_recipe
from sim.plant import advance, build_plant
from tests.bench.hand_gains import HAND

compiled_only = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)


@pytest.fixture(scope="module")
def bench() -> Bench:
    """Return the shipped configuration and its swing, with gains by hand."""
    c = load_configuration(shipped_configuration())
    return Bench(c.plant, load_profile(find_profile(c.swing.profile)), HAND, c.envelope)


@pytest.fixture(scope="module")
def plants(bench: Bench) -> list[Frozen]:
    plant = build_plant(bench.model)
    return [freeze(plant, point) for point in operating_points(bench)]


@pytest.fixture(scope="module")
def estimator(bench: Bench) -> Estimator:
    filters = estimator_record(bench.estimator, bench.model)
    return steady_estimator(filters, bench.model.tick, bench.model.encoders.latency)


@compiled_only
def test_the_linear_plant_moves_as_the_plant_does(bench: Bench, plants: list[Frozen]) -> None:
    """From one state of the backswing, sliding without dry friction, with two openings a little apart."""
    actuators = {
        name: replace(
            getattr(bench.model, name),
            friction=replace(getattr(bench.model, name).friction, coulomb=0.0, static=0.0),
        )
        for name in ("shoulder", "right_arm", "wrist")
    }
    plant = build_plant(replace(bench.model, **actuators))
    series, mark = settled(bench, bench.model, swings=0)
    series.swing_from(mark, bench.profile, bench.profile.begins[1] + 400)
    stepper = series._engine.stepper
    state, command = stepper.plant_state, stepper.command.copy()
    command["valve"] = [0.08, -0.08, 0.08]  # beyond the dead band, and not much: the pressures change slowly
    state["spool"], state["spool_speed"] = command["valve"], 0.0
    point = plants[1].point._replace(
        motion=np.concatenate([state["angle"][0], state["speed"][0], state["pressure"][0]]),
        supply=float(state["supply_pressure"][0]),
        opening=command["valve"][0].copy(),
    )
    frozen, ticks, small = freeze(plant, point), 5, 0.01
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


@compiled_only
def test_hunting_is_foretold(bench: Bench, plants: list[Frozen], estimator: Estimator) -> None:
    """With this stiff wrist the loop was seen to swing at 4 Hz in a backswing; with the soft one not."""
    soft = gains_of(bench.control)
    stiff = soft.with_joint(2, proportional=0.75, integral=0.45, derivative=0.028, damping=0.0004)
    judged = [frozen for frozen in plants if frozen.point.judged]
    ratios = [
        min(least_damping(frozen, estimator, gains, bench.model.tick) for frozen in judged)
        for gains in (stiff, soft)
    ]
    assert ratios[0] < 0.03
    assert ratios[1] > 2.0 * ratios[0]


@compiled_only
def test_what_grows_by_its_gain_grows_at_the_gain_margin(
    bench: Bench, plants: list[Frozen], estimator: Estimator
) -> None:
    """The margins of a loop and the modes of the closed loop tell the same, by other ways."""
    frozen, gains, period = plants[2], gains_of(bench.control), bench.model.tick
    for joint in range(3):
        loop = judge([frozen], estimator, lambda _: gains, period, [joint]).loops[0]
        assert loop.margins.gain > 1

        def raised(factor: float, joint: int = joint) -> Gains:
            own = {name: factor * getattr(gains, name)[joint] for name in gains._fields}
            return gains.with_joint(joint, **own)

        below, above = (raised(part * loop.margins.gain) for part in (0.97, 1.03))
        assert least_damping(frozen, estimator, below, period) > 0
        assert least_damping(frozen, estimator, above, period) < 0


@compiled_only
def test_gains_from_the_machine_keep_more_margin_than_those_by_hand(
    bench: Bench, plants: list[Frozen], estimator: Estimator
) -> None:
    judged = [frozen for frozen in plants if frozen.point.judged]
    assert [frozen.point.name for frozen in judged] == ["address", "backswing 1/3", "backswing 2/3"]

    def found(source: Any) -> Judged:
        made = bench._replace(control=replace(bench.control, gains=source))
        return judge(judged, estimator, gains_along(made), bench.model.tick)

    hand, machine = found("hand"), found("machine")
    for name in ("phase", "delay"):
        by_hand, by_machine = (
            min(getattr(loop.margins, name) for loop in one.loops) for one in (hand, machine)
        )
        assert by_machine > by_hand
    assert min(machine.damping_ratio.values()) >= 0.1


class Ideal(Steps):
    """Steps of a made-up joint: it overshoots by P - 3 D - 1, and its static error falls with I."""

    def __init__(self) -> None:
        self.wanted: list[tuple[int, int]] = []

    def step(self, gains: Gains, joint: int, rule: int) -> StepTrial:
        self.wanted.append((joint, rule))
        p, i, d = (values[joint] for values in gains[:3])
        return StepTrial(joint, rule, gains, p - 3 * d - 1.0, 0.02 - 0.1 * i)


def test_the_recipe_raises_p_then_d_then_i(bench: Bench) -> None:
    steps = Ideal()
    recipe = tune_by_recipe(bench, steps=steps)
    assert steps.wanted == sorted(steps.wanted)
    assert recipe.missed == ()
    for joint in range(3):
        p, i, d = (values[joint] for values in recipe.gains[:3])
        assert 1.02 <= p <= 1.02 * 1.25 + 1e-9
        assert p - 3 * d - 1.0 <= 0.01
        assert 0.02 - 0.1 * i <= bench.control.rest_band[joint]
    assert recipe.gains.damping == bench.control.damping


class Stuck(Ideal):
    """A joint that never overshoots, and whose error stays."""

    def step(self, gains: Gains, joint: int, rule: int) -> StepTrial:
        return StepTrial(joint, rule, gains, -0.5, 0.05)


def test_what_the_recipe_misses_is_told(bench: Bench) -> None:
    assert tune_by_recipe(bench, steps=Stuck()).missed == tuple(
        (joint, rule) for joint in range(3) for rule in (1, 3)
    )


@compiled_only
def test_a_step_is_a_step_of_one_joint(bench: Bench) -> None:
    profile = step_profile(bench.profile, 1)
    assert np.ptp(profile.angle, axis=0) == pytest.approx([0.0, abs(STEP[1]), 0.0])
    steps, gains = Steps(bench), gains_of(bench.control)
    one, two = steps.step(gains, 1, 1), steps.step(gains, 1, 1)
    assert one == two  # from one and the same instant
    assert -0.5 < one.overshoot < 0.5
    weak = steps.step(gains.with_joint(1, proportional=0.1, integral=0.0), 1, 1)
    assert weak.static_error > one.static_error
    assert steps.step(gains.with_joint(1, proportional=50.0), 1, 1).overshoot > one.overshoot


def test_the_file_of_gains_is_a_configuration(tmp_path: Path) -> None:
    rows = ((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (0.01, 0.02, 0.03), (0.001, 0.002, 0.003), (0.1, 0.2, 0.3))
    gains = Gains(*rows)
    shipped = load_configuration(shipped_configuration())
    base = shipped.files[-1]
    path = tmp_path / "gains.toml"
    path.write_text(gains_file(gains, base, "by a test"))
    control = load_configuration(path).control
    assert gains_of(control) == gains
    assert control == with_gains(shipped.control, gains)
    assert control.gains == "hand"
    assert with_gains(ControlSettings(), gains).dither == ControlSettings().dither
    path.write_text(machine_gains_file(base))
    assert load_configuration(path).control == replace(shipped.control, gains="machine")


@compiled_only
def test_the_command_writes_gains_that_swing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "gains.toml"
    with pytest.raises(SystemExit) as ended:
        main(["tune", "--method", "thesis", "--output", str(path), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert len(told["margins"]) == 21
    assert set(told["swings"]) == {"nominal", "worn"}
    failed = told["swings"]["nominal"]["after"]["failure"] is not None
    assert ended.value.code == (1 if failed else 0)
    assert path.exists() != failed
    with pytest.raises(SystemExit) as ended:
        main(["tune", "--method", "none"])
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert "backswing 2/3" in shown
    assert "nominal" not in shown
