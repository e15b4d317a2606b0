"""Controllers compared: each row is its own controller on the same robot."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from bench.base.lifecycle import Cause, Phase
from bench.config import load_configuration, shipped_configuration
from bench.learning.compare import compare, controllers, problem_of, strayed, thesis_gains
from bench.records.telemetry.cycle_record import CYCLE
from bench.simulation.series import Bench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile

compiled_only = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)


@pytest.fixture(scope="module")
def bench() -> Bench:
    c = load_configuration(shipped_configuration())
    return Bench(c.plant, load_profile(find_profile("average-male")), c.control, c.envelope)


def test_thesis_gains_scale_with_greatest_actuator_force(bench: Bench) -> None:
    gains, gauge = thesis_gains(bench.model), 8.0e5 - 1.013e5
    assert gains.proportional == pytest.approx(
        (1000 / (4e-4 * gauge), 1000 / (19.63e-4 * gauge), 1000 / (0.06 * 19.63e-4 * gauge))
    )
    assert gains.derivative[0] == pytest.approx(gains.proportional[0] / 1000)


def test_controllers_successive_entries_differ_in_single_setting(bench: Bench) -> None:
    thesis, alone, kane, inverted, fitted, planned = controllers(bench)
    assert (thesis.velocity_weight, alone.velocity_weight) == (0.0, 1.0)
    assert replace(alone.control, feed_forward="kane") == kane.control
    assert replace(alone.control, feed_forward="kane+pneumatic") == inverted.control == fitted.control
    assert (inverted.sensors, fitted.sensors) == (False, True)
    assert planned.control == bench.control


def test_strayed_reports_first_joint_and_phase_outside_envelope(bench: Bench) -> None:
    cycles = np.zeros(5, CYCLE)
    cycles["phase"] = [Phase.BACKSWING, Phase.TOP, Phase.DOWNSWING, Phase.DOWNSWING, Phase.IMPACT]
    assert strayed(cycles, bench.envelope) is None
    cycles["reference_angle"][4] = 2.0  # not watched in the impact window
    assert strayed(cycles, bench.envelope) is None
    cycles["reference_angle"][2:, 2] = 0.5
    cycles["reference_angle"][3, 0] = 0.5
    assert strayed(cycles, bench.envelope) == (2, Phase.DOWNSWING)
    cycles["reaction"][2] = 1
    assert strayed(cycles, bench.envelope) == (0, Phase.DOWNSWING)


@pytest.mark.release
@compiled_only
def test_compare_model_feed_forward_tracks_closer_than_pid(bench: Bench) -> None:
    told: list[str] = []
    rows = compare(bench, bench.model, swings=1, problem=problem_of(bench), on_start=told.append)
    thesis, alone, kane, inverted, fitted, planned, learned = rows
    assert [row.controller.split(",")[0] for row in rows] == [name.split(",")[0] for name in told]
    # It fails in the swing: the address is held by the bench's own controller.
    assert thesis.cause not in {Cause.NONE, Cause.ADDRESS_TIMEOUT}
    assert np.isnan(thesis.figures.array).all()  # it only brushes the ball in the backswing
    assert min(alone.path, kane.path) > 3 * inverted.path
    for row in (inverted, fitted, planned, learned):
        assert row.cause is Cause.NONE
        assert row.strayed is None
        assert abs(row.error.speed) < 0.06
        assert 10 < row.air * 1000 < 100
    assert fitted.figures != inverted.figures
    assert abs(learned.error.speed) < 0.01
    assert abs(learned.error.strike) < 0.003
