"""The thesis' experiment: its results, and the reason for its friction."""

from __future__ import annotations

import json
from functools import cache
from math import inf, log, pi
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bench.commands.swing.thesis_report import Others, as_record, draw, simulate_thesis, statements
from bench.swing.thesis_experiment import (
    FRICTION,
    LIMIT,
    PROPORTIONAL,
    TOP,
    ThesisExperiment,
    appendix_b_robot,
    colon,
    joint_reference,
    loop_rates,
    run_thesis_experiment,
    thesis_swing,
)
from sim.kane import inverse_dynamics
from sim.kinematics import forward_kinematics, right_arm_length
from sim.robot import thesis_robot

SWING = thesis_swing()
ROBOT = thesis_robot()


def test_thesis_swing_has_sample_counts_and_times() -> None:
    for table in (SWING.shoulder, SWING.right_arm):
        assert table.value.shape == table.time.shape == (69 + 17,)
        assert np.array_equal(np.flatnonzero(table.time >= TOP), np.arange(69, 86))
        assert table.time[[0, 68, 69, 85]] == pytest.approx([0.0, 0.68, 0.686, 0.846])
    assert SWING.wrist.value.shape == SWING.wrist.time.shape == (41 + 29 + 17,)
    assert SWING.wrist.time[[0, 40, 41, 69, 70, 86]] == pytest.approx([0.0, 0.4, 0.4, 0.68, 0.686, 0.846])
    assert SWING.end == pytest.approx(0.846)


def test_thesis_swing_matches_junction_values() -> None:
    assert SWING.shoulder.value[[0, 68, 69, 85]] == pytest.approx(
        [0.0, -1.79452, -1.72372, 0.16428], abs=1e-9
    )
    assert SWING.right_arm.value[[68, 69]] == pytest.approx([-0.20298, -0.20302], abs=5e-6)
    assert SWING.wrist.value[[0, 40, 41, 69, 70, 86]] == pytest.approx(
        [6.2829, 5.9356, 5.9365, 4.8869, 4.8968, 6.2795], abs=5e-5
    )


def test_colon_counts_as_matlab_does() -> None:
    assert len(colon(0.0, 0.1, 0.3)) == 4  # 0.1 * 3 > 0.3 in floating point
    assert len(colon(0.0, 0.01, 0.686)) == 69
    assert colon(0.4 - 3, 0.2, 3.0)[-1] == pytest.approx(3.0)


def test_joint_reference_matches_tables() -> None:
    t = SWING.shoulder.time
    q = joint_reference(SWING, ROBOT, t)
    assert q.shape == (86, 3)
    assert q[:, 0] - q[0, 0] == pytest.approx(SWING.shoulder.value)
    assert right_arm_length(ROBOT, q[:, 1]) == pytest.approx(0.34 + 0.22 + SWING.right_arm.value)
    assert np.all((q[:, 1] > np.pi) & (q[:, 1] < 1.5 * np.pi))
    # the assumed address: shaft straight down, both arms equally long but for the tanh's tail
    assert q[0].sum() % (2 * np.pi) == pytest.approx(1.5 * np.pi)
    assert right_arm_length(ROBOT, q[0, 1]) == pytest.approx(ROBOT.l23, abs=1e-3)


def test_joint_reference_after_last_sample_holds_value() -> None:
    held = joint_reference(SWING, ROBOT, [0.846, 0.9])
    assert held[1] == pytest.approx(held[0])


def test_joint_reference_downswing_spline_has_known_effort_and_speed() -> None:
    """A spline through the downswing's samples: the reference's demand on actuators and club.

    "About 380 N m, 1.3 kN, 165 N m" were calculated elsewhere with an unrecorded differentiation; a
    spline gives 331, 1186, 168. The peak lies where the tanh abscissa (-2.314 + 33 t) has just passed 0.
    """
    samples = SWING.shoulder.time[SWING.shoulder.time >= TOP]
    spline = CubicSpline(samples, joint_reference(SWING, ROBOT, samples))
    t = np.arange(TOP, SWING.end, 1e-4)
    q, u, u_dot = spline(t), spline(t, 1), spline(t, 2)
    effort = np.abs(inverse_dynamics(ROBOT, q, u, u_dot)).max(axis=0)
    assert effort == pytest.approx([380.0, 1300.0, 165.0], rel=0.15)
    assert effort == pytest.approx([331.0, 1186.0, 168.2], rel=0.01)
    head = forward_kinematics(ROBOT, q)[:, :2]
    speed = np.hypot(*np.gradient(head, t, axis=0).T)
    assert speed.max() == pytest.approx(55.7, rel=0.01)
    assert t[speed.argmax()] - TOP == pytest.approx(0.072, abs=0.001)
    turned, down = SWING.shoulder, SWING.shoulder.time >= TOP
    back = np.interp(0.0, turned.value[down], turned.time[down])  # the shoulder is at its start again
    assert back == pytest.approx(0.8321, abs=1e-4)
    assert 19.0 <= np.interp(back, t, speed) <= 20.0


QUARTER_DECAY = log(4.0) / (4.0 * pi**2 + log(4.0) ** 2) ** 0.5
"""Damping ratio at which an oscillation decays to a quarter in a period: 0.215."""

run = cache(run_thesis_experiment)


def others() -> Others:
    return Others(run(0.0).summary, run(limit=(inf, inf, inf)).summary)


@pytest.fixture(scope="module")
def experiment() -> ThesisExperiment:
    return run()


def test_thesis_experiment_summary_matches_known_figures(experiment: ThesisExperiment) -> None:
    """As found. The thesis: 0.68 + 0.19 s, about 3 cm, the wrist worst in error and saturation, stable."""
    s = experiment.summary
    assert s.stable
    assert s.top_time == pytest.approx(0.688, abs=0.002)
    assert s.contact_time == pytest.approx(0.870, abs=0.001)
    assert s.height_error == pytest.approx(0.0436, abs=0.0002)
    assert s.club_speed == pytest.approx(43.28, abs=0.02)
    assert s.largest_error == pytest.approx((0.2627, 0.7072, 0.8763), abs=0.001)
    assert s.saturated == pytest.approx((0.0, 0.0, 0.28), abs=0.01)
    assert s.rod_range == pytest.approx((-0.0698, 0.2465), abs=0.0005)


def test_thesis_experiment_records_saturation(experiment: ThesisExperiment) -> None:
    assert np.array_equal(experiment.saturated, np.abs(experiment.demand) > LIMIT)
    assert experiment.saturated[:, 2].any()


def test_thesis_experiment_without_friction_is_unstable() -> None:
    summary = run(0.0).summary
    assert not summary.stable
    assert summary.contact_time is None


def test_thesis_experiment_without_limits_never_saturates() -> None:
    assert max(others().unlimited.saturated) == 0.0


def least_damping(friction: float) -> float:
    """Return the least damping ratio of the loop, linearised at rest at each sample's pose; < 0 grows."""
    robot, swing, unlimited = appendix_b_robot(), thesis_swing(), np.full(3, inf)
    smallest = 1.0
    poses = joint_reference(swing, robot, swing.shoulder.time)
    for pose, hold in zip(poses, inverse_dynamics(robot, poses, np.zeros(3), np.zeros(3)), strict=True):
        at_rest, reference = np.concatenate([pose, np.zeros(6)]), pose + hold / PROPORTIONAL
        matrix = np.empty((9, 9))
        for column, step in enumerate(1e-5 * np.eye(9)):
            above = loop_rates(robot, reference, at_rest + step, friction, unlimited)
            below = loop_rates(robot, reference, at_rest - step, friction, unlimited)
            matrix[:, column] = (above - below) / 2e-5
        poles = np.linalg.eigvals(matrix)
        oscillating = poles[np.abs(poles) > 1e-9]
        smallest = min(smallest, float((-oscillating.real / np.abs(oscillating)).min()))
    return smallest


def test_thesis_friction_is_smallest_with_quarter_decay() -> None:
    assert least_damping(FRICTION) >= QUARTER_DECAY > least_damping(FRICTION - 0.5)


def test_statements_report_found_values(experiment: ThesisExperiment) -> None:
    rows = {row.what: row for row in statements(experiment, others())}
    assert rows["error in y at the ball"].found == "+4.4 cm"
    assert rows["largest error"].found.startswith("wrist")
    assert rows["stable without friction"].found == "no"


def test_as_record_without_contact_reports_ball_not_reached(tmp_path: Path) -> None:
    stuck = run(80.0)
    assert stuck.summary.contact_time is None
    record = as_record(stuck, others())
    assert record["statements"][3]["found"] == "never reaches the ball"
    json.dumps(record, allow_nan=False)
    draw(stuck, tmp_path / "stuck.png")


@pytest.mark.slow
def test_simulate_thesis_writes_picture_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.commands.swing.thesis_report.run_thesis_experiment", run)
    simulate_thesis(tmp_path / "new", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "new" / "thesis.json").read_text(encoding="utf-8"))
    assert printed["summary"]["height_error"] == run().summary.height_error
    assert (tmp_path / "new" / "thesis.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "new" / "thesis.svg").read_bytes()
