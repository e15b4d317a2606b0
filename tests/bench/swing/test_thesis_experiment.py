"""The thesis' experiment: the closed loop against an independent integration, and what came out of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp

from bench.commands.thesis_report import as_record, draw, show, simulate_thesis, statements
from bench.swing.tables import Address, joint_reference, thesis_swing
from bench.swing.thesis_experiment import (
    QUARTER_DECAY,
    ThesisExperiment,
    ThesisParameters,
    appendix_b_robot,
    find_friction,
    least_damping,
    run_thesis_experiment,
    variants,
)
from sim.kane import bias_forces, mass_matrix
from sim.kinematics import right_arm_length

COARSE = 1e-3
"""s; ten times faster than the default, right to 0.2 mm at the ball."""


@pytest.fixture(scope="module")
def experiment() -> ThesisExperiment:
    return run_thesis_experiment(ThesisParameters(time_step=COARSE))


def test_against_an_independent_integration() -> None:
    """Plain Python with the mass matrix and scipy's adaptive solver, through the saturated downswing."""
    robot, swing = appendix_b_robot(), thesis_swing()
    found = run_thesis_experiment(ThesisParameters(friction=(5.0, 6.0, 7.0)))
    start, end = np.searchsorted(found.time, (0.7, 0.74))

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        q, u, z = x[:3], x[3:6], x[6:]
        error = joint_reference(swing, robot, t) - q
        output = np.clip(1000 * error + 0.92 * z - u, *(np.array([-1, 1])[:, None] * found.parameters.limit))
        lever = -robot.l62 * robot.l23 * np.sin(q[1]) / right_arm_length(robot, q[1])
        generalised = output * [1.0, lever, 1.0] - [5.0, 6.0, 7.0] * u
        u_dot = np.linalg.solve(mass_matrix(robot, q), generalised - bias_forces(robot, q, u))
        return np.concatenate([u, u_dot, error])

    integral = np.trapezoid((found.reference - found.angle)[: start + 1], found.time[: start + 1], axis=0)
    first = np.concatenate([found.angle[start], found.velocity[start], integral])
    span = (found.time[start], found.time[end])
    expected = solve_ivp(rate, span, first, rtol=1e-8, atol=1e-9, max_step=2e-3).y[:, -1]
    assert found.angle[end] == pytest.approx(expected[:3], abs=2e-6)
    assert found.velocity[end] == pytest.approx(expected[3:6], abs=2e-4)


def test_the_step_is_fine_enough() -> None:
    usual = run_thesis_experiment(ThesisParameters(friction=(10.0,) * 3)).summary
    fine = run_thesis_experiment(ThesisParameters(friction=(10.0,) * 3, time_step=1e-4)).summary
    assert usual.height_error == pytest.approx(fine.height_error, abs=1e-5)
    assert usual.club_speed == pytest.approx(fine.club_speed, abs=1e-3)


def test_what_came_out(experiment: ThesisExperiment) -> None:
    """As found. The thesis: 0.68 + 0.19 s, about 3 cm, the wrist worst in error and saturation, stable."""
    s = experiment.summary
    assert s.stable
    assert s.top_time == pytest.approx(0.688, abs=0.002)
    assert s.contact_time == pytest.approx(0.870, abs=0.002)
    assert s.height_error == pytest.approx(0.044, abs=0.002)
    assert s.club_speed == pytest.approx(43.3, abs=0.3)
    assert s.largest_error == pytest.approx((0.26, 0.71, 0.88), abs=0.01)
    assert s.saturated == pytest.approx((0.0, 0.0, 0.28), abs=0.01)
    assert experiment.parameters.friction == (10.0, 10.0, 10.0)


def test_saturation_is_recorded(experiment: ThesisExperiment) -> None:
    assert np.all(np.abs(experiment.effort) <= experiment.limit)
    assert np.array_equal(experiment.saturated, experiment.effort != experiment.demand)
    assert experiment.saturated[:, 2].any()


def test_without_friction_it_is_unstable_as_the_thesis_says() -> None:
    summary = run_thesis_experiment(ThesisParameters(friction=(0.0,) * 3, time_step=COARSE)).summary
    assert not summary.stable
    assert summary.contact_time is None


def test_friction_is_the_smallest_that_is_quiet(experiment: ThesisExperiment) -> None:
    *before, last = experiment.search
    assert last.accepted
    assert last.damping >= QUARTER_DECAY
    assert not any(trial.accepted for trial in before)
    assert [trial.friction for trial in experiment.search] == pytest.approx(np.arange(0, 10.5, 0.5))
    with pytest.raises(ValueError, match="no joint friction up to 1 N m s/rad"):
        find_friction(ThesisParameters(time_step=COARSE), step=1.0, most=1)


def test_quarter_decay() -> None:
    t = 2 * np.pi / np.sqrt(1 - QUARTER_DECAY**2)  # one period at 1 rad/s
    assert np.exp(-QUARTER_DECAY * t) == pytest.approx(0.25)


def test_least_damping_against_the_linear_equations() -> None:
    """Without gravity the linearised loop is M x'' + (D J + B) x' + P J x + I J z = 0, z' = x."""
    robot, swing = replace(appendix_b_robot(), gravity=0.0), thesis_swing()
    damping = []
    for pose in joint_reference(swing, robot, swing.shoulder.time):
        lever = -robot.l62 * robot.l23 * np.sin(pose[1]) / right_arm_length(robot, pose[1])
        jacobian, zero, one = np.diag([1.0, lever, 1.0]), np.zeros((3, 3)), np.eye(3)
        inverse = np.linalg.inv(mass_matrix(robot, pose))
        matrix = np.block(
            [
                [zero, one, zero],
                [-inverse @ jacobian * 1000, -inverse @ (jacobian + 4.0 * one), -inverse @ jacobian * 0.92],
                [one, zero, zero],
            ]
        )
        poles = np.linalg.eigvals(matrix)
        damping.append((-poles.real / np.abs(poles)).min())
    found = least_damping(ThesisParameters(friction=(4.0,) * 3), robot, swing)
    assert found == pytest.approx(min(damping), rel=1e-4)


def test_open_choices_are_parameters(experiment: ThesisExperiment) -> None:
    summaries = variants(experiment.parameters)
    assert summaries["as run"] == experiment.summary
    assert len(summaries) == 8
    # the arm follows better when its controller puts out a torque, the wrist worse with its lever
    assert summaries["θ2 controller puts out a torque"].rms_error[1] < 0.5 * experiment.summary.rms_error[1]
    assert summaries["wrist limit falls with |sin β|"].rms_error[2] > 1.5 * experiment.summary.rms_error[2]
    assert max(summaries["actuators without limits"].saturated) == 0.0


def test_the_lever_takes_the_wrists_authority() -> None:
    found = run_thesis_experiment(ThesisParameters(wrist_lever=True, friction=(10.0,) * 3, time_step=COARSE))
    beta = found.angle[:, 2] - 1.5 * np.pi
    assert found.limit[:, 2] == pytest.approx(found.parameters.limit[2] * np.abs(np.sin(beta)))
    assert np.all(found.limit[:, 0] == found.parameters.limit[0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"proportional": (0.0, 1.0, 1.0)}, "proportional: found"),
        ({"limit": (280.0, -1.0, 82.0)}, "limit: found"),
        ({"friction": (1.0, float("nan"), 1.0)}, "friction: found"),
        ({"derivative": (1.0, 1.0)}, "expected three numbers"),
        ({"integral": (float("inf"),) * 3}, "integral: found"),
        ({"arm_output": "speed"}, "expected 'force' or 'torque'"),
        ({"duration": 0.1}, "expected 0.85 to 60 s"),
        ({"time_step": 0.01}, "time_step: found"),
    ],
)
def test_bad_parameters_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ThesisParameters(**change)  # type: ignore[arg-type]


def test_an_address_outside_the_stroke_is_refused() -> None:
    with pytest.raises(ValueError, match=r"address\.rod"):
        run_thesis_experiment(ThesisParameters(address=Address(rod=0.1)))
    with pytest.raises(ValueError, match="give three numbers"):
        variants(ThesisParameters())


@pytest.mark.slow
def test_simulate_thesis_writes_picture_and_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = simulate_thesis(tmp_path / "new", True, ThesisParameters(time_step=COARSE, friction=(10.0,) * 3))
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "new" / "thesis.json").read_text(encoding="utf-8"))
    assert printed["summary"]["height_error"] == found.summary.height_error
    assert (tmp_path / "new" / "thesis.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "new" / "thesis.svg").read_bytes()


def test_the_table_names_thesis_and_findings(experiment: ThesisExperiment) -> None:
    console = Console(width=200, record=True, quiet=True)
    others = variants(experiment.parameters)
    show(experiment, others, console)
    rows = {row.what: row for row in statements(experiment, others)}
    assert rows["error in y at the ball"].found == "+4.4 cm"
    assert rows["largest error"].found.startswith("wrist")
    assert rows["stable without friction"].found == "no"


def test_a_swing_that_never_reaches_the_ball_is_reported(tmp_path: Path) -> None:
    stuck = run_thesis_experiment(ThesisParameters(friction=(80.0,) * 3, time_step=COARSE))
    assert stuck.summary.contact_time is None
    record = as_record(stuck, variants(stuck.parameters))
    assert record["statements"][3]["found"] == "never reaches the ball"
    json.dumps(record, allow_nan=False)
    draw(stuck, tmp_path / "stuck.png")
