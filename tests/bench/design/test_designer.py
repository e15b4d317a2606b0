"""The designer: its model is the plant's, its geometry is right, the way to the top is followed."""

from __future__ import annotations

import os
import signal
import sys
from dataclasses import replace
from math import asin, radians, sin
from pathlib import Path
from threading import Timer
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.config import load_configuration
from bench.control.moves.pressure_plan import with_planned_air
from bench.control.settings import pid_record
from bench.design import designer
from bench.design._refine import KNOT, Rehearsal, correction, learned_backswing
from bench.design.designer import (
    DesignFailed,
    SwingDesigner,
    _Cushions,
    _guess_from,
    _problem,
    address_pose,
    design_swing,
    fastest_plan,
    slope_of,
    top_pose,
)
from bench.design.golfer_tracking import demand_near
from bench.design.optimal_control import (
    BAR,
    STATES,
    DownswingPlan,
    DownswingProblem,
    SwingDemand,
    _radau_slopes,
    _state_bounds,
    build_equations,
    load_casadi,
    solve_downswing,
)
from bench.simulation.simulated_bench import Bench, simulate_swing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.dynamics import STATES as PLANT_STATES
from sim.dynamics import _derivative
from sim.kinematics import forward_kinematics, head_motion, right_arm_length
from sim.plant import PlantParameters, build_plant
from tests.bench.commissioning.drawn_robots import drawn_robot
from tests.sampling import release_except


@pytest.mark.parametrize("mounted", [0.0, 0.7])
def test_build_equations_derivative_matches_plant(plant: PlantParameters, mounted: float) -> None:
    plant = replace(plant, wrist_lever_angle=mounted)
    equations, records = build_equations(plant), build_plant(plant)
    random = np.random.default_rng(0)
    for _ in range(5):
        angle = [random.uniform(-1.0, 0.4), random.uniform(3.8, 4.3), random.uniform(5.2, 6.2)]
        speed = random.uniform(3.0, 8.0, 3) * random.choice([-1.0, 1.0], 3)
        pressure, supply = random.uniform(2e5, 7e5, 6), 7.5e5
        opening = random.uniform(0.1, 0.8, 3) * random.choice([-1.0, 1.0], 3)
        y, rate, terms, slip = (np.zeros(PLANT_STATES) for _ in range(4))
        y[:3], y[3:6], y[6:12], y[12] = angle, speed, pressure, supply
        slip[:3] = np.sign(speed)
        feed = plant.supply.feed_conductance
        one, two, three = (float(value) for value in opening)
        angles = np.full(9, np.nan)
        _derivative(
            records.robot[0], records.plant[0], y, one, two, three, feed, 0.0, slip, rate, terms, angles
        )
        state = np.concatenate([angle, speed, pressure / BAR, [supply / BAR], opening])
        found = np.array(equations.derivative(state, np.zeros(3))).ravel()
        assert found[3:6] == pytest.approx(rate[3:6], rel=5e-3, abs=1.0)
        assert found[6:13] == pytest.approx(rate[6:13] / BAR, rel=0.02, abs=1.5)


def test_build_equations_head_matches_robot(plant: PlantParameters) -> None:
    angle, speed = np.array([0.3, 4.3, 6.1]), np.array([5.0, 9.0, 20.0])
    head = np.array(build_equations(plant).head(angle, speed)).ravel()
    assert head == pytest.approx(head_motion(plant.robot.record[0], *angle, *speed)[:5])


def test_radau_slopes_differentiate_polynomials_exactly() -> None:
    points = np.array([1 / 3, 1.0])
    slopes = _radau_slopes(points)
    nodes = np.array([0.0, *points])
    for power in range(3):
        expected = power * points ** (power - 1) if power else np.zeros(2)
        assert nodes**power @ slopes == pytest.approx(expected)


def test_slope_of_tilted_plane_gives_attack_angle() -> None:
    lie, attack = radians(53.0), radians(2.0)
    assert sin(slope_of(attack, lie)) * sin(lie) == pytest.approx(sin(attack))
    assert slope_of(0.0, lie) == 0.0
    assert slope_of(-attack, lie) == -slope_of(attack, lie)
    with pytest.raises(ValueError, match="steeper"):
        slope_of(lie, lie)


@pytest.mark.slow
def test_fastest_plan_before_stop_keeps_wrist_off_end_stop(plant: PlantParameters) -> None:
    """The fastest downswing meets it there: a robot a little off was slower by 0.7 % in every other swing."""
    ahead, demand = 0.0012, SwingDemand(attack=radians(2.0))
    configuration = replace(load_configuration(None), plant=plant)
    missed = []
    for before_stop in (0.0, ahead):
        plan = fastest_plan(configuration, replace(demand, before_stop=before_stop))
        assert plan.solved
        angle, speed = plan.state[-1, 2], plan.state[-1, 5]
        missed.append((plant.wrist.upper - angle) / speed)
    assert missed[0] < 0.5 * ahead
    assert missed[1] >= 0.999 * ahead


def test_correction_starts_at_zero_and_passes_knots() -> None:
    knots = np.array([[0.1, -0.2, 0.0], [0.3, 0.0, 0.2]])
    opening = correction(knots, 50, 1e-3)
    ticks = round(KNOT / 1e-3)
    assert opening[0] == pytest.approx([0.0, 0.0, 0.0])
    assert opening[[ticks, 2 * ticks]] == pytest.approx(knots)
    assert opening[-1] == pytest.approx(knots[-1])


def test_address_and_top_pose_lie_within_joint_ranges(plant: PlantParameters) -> None:
    for pose in (address_pose(plant, SwingDemand()), top_pose(plant, SwingDemand())):
        assert plant.shoulder.lower < pose[0] < plant.shoulder.upper
        assert plant.wrist.lower < pose[2] < plant.wrist.upper
        assert abs(np.sin(pose[2] - 1.5 * np.pi)) >= sin(asin(SwingDemand().least_lever))


def test_address_pose_on_turf_places_head_behind_ball() -> None:
    bag = load_configuration(Path("bag"))
    for name in ("wood3", "iron7", "wedge56"):
        plant = bag.plant_with(club=name)
        pose, site = address_pose(plant, SwingDemand()), plant.site
        x, y, _ = forward_kinematics(plant.robot, pose)
        assert (x - site.ball_x, y - site.ball_y) == pytest.approx((-0.050, 0.022), abs=1e-9)
        assert plant.wrist.upper - pose[2] == pytest.approx(SwingDemand().address_cock)
        extension = right_arm_length(plant.robot, pose[1]) - plant.robot.l56
        assert plant.right_arm.lower < extension < plant.right_arm.upper


def test_address_pose_ball_out_of_reach_raises() -> None:
    plant = load_configuration(Path("bag")).plant_with(club="iron7")
    far = replace(plant, site=replace(plant.site, ball_x=1.5))
    with pytest.raises(DesignFailed, match="do not reach the ball"):
        address_pose(far, SwingDemand())


def test_rehearsal_matches_simulated_swing_per_tick() -> None:
    bench = Bench(load_profile(find_profile("driver-85mph")))
    swing = simulate_swing(bench).cycles
    rehearsal = Rehearsal(bench)
    cycles = np.concatenate([rehearsal.advance(n) for n in (1, 0, 99, 1200)])
    begin = int(np.argmax(swing["phase"] == Phase.BACKSWING)) - 1  # sample 0 is still HOLD
    told = swing[begin : begin + len(cycles)]
    for name in ("angle", "applied_valve", "plant_angle", "phase"):
        assert np.array_equal(cycles[name], told[name])


@pytest.mark.slow
def test_solve_downswing_coarse_plan_meets_demand_reproducibly(plant: PlantParameters) -> None:
    """The shipped swing's downswing planned anew on a coarse mesh, a little slower."""
    demand = SwingDemand(head_speed=36.0, attack=radians(0.5))
    (_, plan), (_, again) = _coarse_plan(plant, demand), _coarse_plan(plant, demand)
    assert plan.solved
    x, y, theta_t, vx, vy = head_motion(plant.robot.record[0], *plan.state[-1, :6])[:5]
    assert (x, y) == pytest.approx((plant.site.ball_x, plant.site.ball_y), abs=1e-5)
    slope = slope_of(demand.attack, plant.robot.lie)
    assert (vx, vy) == pytest.approx((36.0 * np.cos(slope), 36.0 * np.sin(slope)), abs=1e-3)
    assert abs(theta_t - 3.5 * np.pi) <= 0.026 + 1e-6
    assert np.abs(plan.state[:, 13:]).max() <= 0.85
    assert np.array_equal(plan.state, again.state)


@pytest.mark.slow
def test_solve_downswing_interrupt_is_not_lost(
    plant: PlantParameters, monkeypatch: pytest.MonkeyPatch
) -> None:
    ca = load_casadi()
    build = ca.nlpsol

    def interrupted(*program: object) -> Any:
        solver = build(*program)

        def solve(**start: object) -> object:
            Timer(0.1, os.kill, (os.getpid(), signal.SIGINT)).start()
            return solver(**start)

        return solve

    monkeypatch.setattr(ca, "nlpsol", interrupted)
    with pytest.raises(KeyboardInterrupt):
        _coarse_plan(plant, SwingDemand(head_speed=36.0, attack=radians(0.5)))


def test_state_bounds_include_start_beyond_top(plant: PlantParameters) -> None:
    """A robot with much friction comes to the top some hundredths of a radian beyond it."""
    bench = Bench(load_profile(find_profile("default")))
    demand = demand_near(plant, bench.profile, SwingDemand(head_speed=43.2))
    state = np.zeros(STATES)
    state[:3] = top_pose(plant, demand)
    state[0] -= 0.073
    low, high = _state_bounds(plant, _problem(plant, demand, bench.envelope, state))
    assert (low[:3] < state[:3]).all()
    assert (state[:3] < high[:3]).all()


def _coarse_plan(plant: PlantParameters, demand: SwingDemand) -> tuple[DownswingProblem, DownswingPlan]:
    """Return the shipped swing's downswing planned anew on a coarse mesh, and the problem it solves."""
    bench = Bench(load_profile(find_profile("driver-85mph")))
    problem = SwingDesigner(bench, demand).problem
    return problem, solve_downswing(plant, problem, *_guess_from(bench.profile, problem.start, 12), 12)


@pytest.mark.slow
def test_solve_downswing_nearest_reachable_demand_concedes_nothing(plant: PlantParameters) -> None:
    demand = SwingDemand(head_speed=36.0, attack=radians(0.5), nearest=True)
    problem, plan = _coarse_plan(plant, demand)
    vx, vy = head_motion(plant.robot.record[0], *plan.state[-1, :6])[3:5]
    assert problem.concessions.speed > 0.0
    assert plan.solved
    assert plan.time[-1] <= demand.downswing_time[1] + 1e-6
    assert np.hypot(vx, vy) == pytest.approx(36.0, abs=1e-3)
    assert np.arctan2(vy, vx) == pytest.approx(slope_of(demand.attack, plant.robot.lie), abs=1e-5)


@pytest.mark.slow
def test_solve_downswing_unreachable_demand_returns_nearest_plan(plant: PlantParameters) -> None:
    demand = SwingDemand(head_speed=58.0, attack=radians(0.5), nearest=True)
    problem, plan = _coarse_plan(plant, demand)
    vx, vy = head_motion(plant.robot.record[0], *plan.state[-1, :6])[3:5]
    assert plan.solved
    assert 46.0 < plan.speed < 57.0
    assert plan.speed == pytest.approx(np.hypot(vx, vy), abs=1e-3)
    assert problem.slope - 1e-5 <= np.arctan2(vy, vx) <= problem.slope + problem.concessions.rise + 1e-5
    assert plan.time[-1] <= demand.downswing_time[1] + problem.concessions.time + 1e-6
    assert np.all(plan.carried <= np.array(problem.cushions) + 1e-3)


@pytest.mark.slow
def test_design_downswing_without_guess_meets_demand(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a coarse mesh; played on the plant, it meets its demand and survives the missing ball."""
    monkeypatch.setattr("bench.design.designer._INTERVALS", 14)
    bench = Bench(load_profile(find_profile("default")))
    demand = SwingDemand(head_speed=38.0, attack=radians(2.0))
    told = list[tuple[str, float]]()
    design = SwingDesigner(bench, demand, lambda what, part: told.append((what, part)))
    found = design.downswing(None)
    ratings = [[a.stop.energy] for a in bench.plant.actuators]
    arrival = design.shooter.arrive(found.opening)
    assert np.hypot(*arrival.head[3:5]) == pytest.approx(38.0, abs=0.1)
    assert abs(arrival.error) < 1e-3
    assert np.all(found.trial.missed_energy <= ratings)
    assert told[0] == ("a first swing", 0.0)
    assert told[-1] == ("downswing", 1.0)


def test_cushions_next_interpolates_between_tried_values() -> None:
    tried = _Cushions(np.zeros((2, 2)), np.zeros((2, 2)))
    brought, over = np.array([20.0, 25.0]), np.array([10.0, -4.0])
    tried = tried.learned(brought, over)
    assert tried.next(brought, over) == pytest.approx([20.0 - 10.3, 25.0 + 2.0])
    brought, over = np.array([10.0, 27.0]), np.array([-5.0, 12.0])
    tried = tried.learned(brought, over)
    # Straight lines between (10, -5) and (20, +10), and (25, -4) and (27, +12).
    assert tried.next(brought, over) == pytest.approx([10.0 + 10.0 / 3, 25.5])


def test_design_swing_faulty_result_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the wrist that is late at the top leaves a step there."""
    made = replace(load_profile(find_profile("default")), club="none")
    stepped = made.angle.copy()
    stepped[made.begins[3] :, 2] += 0.2
    made = replace(made, angle=stepped)
    design = SimpleNamespace(downswing=lambda _: None, into_the_loop=lambda _: made)
    monkeypatch.setattr(designer, "SwingDesigner", lambda *_: design)
    monkeypatch.setattr(designer, "design_blind_brake", lambda *_: made.blind_brake)
    with pytest.raises(
        DesignFailed, match=r'golfbench check.*club: found "none".*a step no robot can follow'
    ):
        design_swing(load_configuration(None), SwingDemand(), "made")


def test_design_swing_missing_package_names_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(BenchError, match=r"golfbench\[design\]"):
        design_swing(load_configuration(None), SwingDemand(), "nothing")


TICKS = 1100


@pytest.mark.parametrize("seed", release_except({0}, [0, 409, 418]))
def test_learned_backswing_follows_reference(seed: int) -> None:
    c, demand = load_configuration(), SwingDemand()
    plant = drawn_robot(seed, c.plant) if seed else c.plant
    pid = pid_record(c.control, c.estimator, plant)
    sketch = designer._sketch(demand, plant, address_pose(plant, demand), top_pose(plant, demand), pid)
    bench = designer._bench(replace(c, plant=plant))
    sketch = with_planned_air(sketch, plant)
    found = learned_backswing(replace(bench, profile=sketch), pid, TICKS, 1.0 - demand.margin)
    error = np.abs(found.cycles["reference_angle"] - found.cycles["angle"]).max(axis=0)
    assert np.all(error < (0.05, 0.02, 0.2)), error.round(4)  # of 409 (0.16, 0.05, 0.45) by the PIDs alone
    assert found.error == pytest.approx((error / c.envelope.max_following_error["backswing"]).max())
    assert np.abs(found.profile.valve).max() <= 1.0 - demand.margin
