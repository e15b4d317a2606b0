"""The learner on a linear robot that differs from the model, with scatter, stops and unknown figures."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.learning import learn
from bench.learning.delivery import UNKNOWN, Figures, Tolerance
from bench.learning.learn import Attempt, Learner, Response

Array = NDArray[np.float64]

TARGET = Figures(0.0, 43.0, 0.0, 0.03)
TOLERANCE = Tolerance()
WEIGHTS, ROWS = 12, 8


class Robot:
    """Answers to weights like its model, but for a share of the response and an offset."""

    def __init__(self, seed: int, offset: float = 15.0, doubt: float = 0.3, scatter: float = 0.1) -> None:
        random = np.random.default_rng(seed)
        self.random, self.scale = random, TOLERANCE.scale(TARGET)
        figures = random.normal(0, 10, (4, WEIGHTS)) * self.scale[:, None]
        path = random.normal(0, 0.02, (3 * ROWS, WEIGHTS))
        plan = random.normal(0, 1, (ROWS, 3))
        self.plan, self.model = plan, Response(np.arange(ROWS), figures, path, plan)
        self.figures = figures * (1 + doubt * random.normal(0, 1, figures.shape))
        self.path = path * (1 + doubt * random.normal(0, 1, path.shape))
        self.offset = offset * random.normal(0, 1, 4) * self.scale
        self.scatter = scatter

    def swing(self, point: Array) -> Attempt:
        noise = self.scatter * self.random.normal(0, 1, 4) * self.scale
        figures = TARGET.array + self.offset + self.figures @ point + noise
        return Attempt(point, Figures(*figures), self.plan + (self.path @ point).reshape(ROWS, 3))


def learning(seed: int, **differs: float) -> tuple[Robot, Learner]:
    """Return a robot and a learner that has made no swing with it."""
    robot = Robot(seed, **differs)
    return robot, Learner(robot.model, TARGET, robot.plan)


def learned(seed: int, **differs: float) -> tuple[Robot, Learner]:
    robot, learner = learning(seed, **differs)
    for _ in range(learn.SWINGS + 1):
        learner.note(robot.swing(learner.point))
        if learner.confirmed:
            break
    return robot, learner


@pytest.mark.parametrize("seed", range(6))
def test_learner_differing_robot_converges_within_twelve_swings(seed: int) -> None:
    robot, learner = learned(seed)
    before, after = learner.trials[0], learner.trials[learner.chosen]
    assert np.abs(learner.error(before.figures)).max() > 3.0
    robot.scatter = 0.0
    assert np.abs(learner.error(robot.swing(after.point).figures)).max() < 1.0
    assert len(learner.trials) <= 13


def test_learner_repeated_swing_within_tolerance_confirms() -> None:
    _, learner = learned(1)
    assert learner.confirmed
    assert len(learner.trials) < 13
    assert np.array_equal(learner.trials[-1].point, learner.trials[-2].point)
    assert (learner.scatter < 0.5).all()


def test_learner_weights_stay_in_bound_and_steps_in_radius(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("MAX_WEIGHT", 0.4), ("RADIUS", 0.5), ("_MAX_RADIUS", 0.5)):
        monkeypatch.setattr(learn, name, value)
    _, learner = learned(2, offset=200.0)
    points = np.array([trial.point for trial in learner.trials])
    assert np.abs(points).max() <= 0.4 + 1e-6
    assert np.linalg.norm(points[1]) <= 0.5 + 1e-9
    assert np.abs(points).max() > 0.39


def test_learner_stopped_swing_is_rejected_and_halves_step() -> None:
    robot, learner = learning(3)
    learner.note(robot.swing(learner.point))
    first = learner.point.copy()
    path = robot.swing(first).path
    path[ROWS // 2 :] = np.nan
    learner.note(Attempt(first, UNKNOWN, path))
    assert learner.chosen == 0
    assert np.linalg.norm(learner.point) <= 0.5 * learn.RADIUS + 1e-9
    assert not np.allclose(learner.point, first)


def test_learner_stopped_swings_reduce_path_error() -> None:
    """Before any swing reached the ball the path alone is learned from."""
    robot, learner = learning(4)
    off = robot.path @ np.full(WEIGHTS, 0.3)
    for _ in range(5):
        path = robot.plan + (off + robot.path @ learner.point).reshape(ROWS, 3)
        learner.note(Attempt(learner.point, UNKNOWN, path))
    last = robot.plan - learner.trials[learner.chosen].path
    assert np.linalg.norm(last) < 0.6 * np.linalg.norm(off)


def test_learner_unmeasured_figure_is_ignored() -> None:
    robot, learner = learning(5)
    for _ in range(13):
        trial = robot.swing(learner.point)
        learner.note(trial._replace(figures=trial.figures._replace(lean=np.nan)))
        if learner.confirmed:
            break
    errors = learner.error(learner.trials[learner.chosen].figures)
    assert np.isnan(errors[2])
    assert np.nanmax(np.abs(errors)) < 1.0


def test_learner_worse_later_swings_keep_best_trial() -> None:
    robot, learner = learning(0, scatter=0.0)
    learner.note(robot.swing(learner.point))
    good = Attempt(learner.point, TARGET, robot.plan)
    learner.note(good)
    for part in (0.5, 0.8, 0.9):
        far = Figures(*(TARGET.array + 30 * TOLERANCE.scale(TARGET)))
        learner.note(Attempt(part * good.point, far, robot.plan))
    assert learner.trials[learner.chosen].point is good.point


def test_learner_unsettled_swing_is_neither_confirmed_nor_chosen() -> None:
    robot, learner = learning(1, offset=0.0, scatter=0.0)
    for settled in (False, False, True):
        learner.note(robot.swing(np.zeros(WEIGHTS))._replace(settled=settled))
        assert not learner.confirmed
    assert learner.chosen == 2
    learner.note(robot.swing(np.zeros(WEIGHTS)))
    assert learner.confirmed


def test_learner_unsettled_first_swing_flag_shortens_learning() -> None:
    """It is ten tolerances of head speed off the later delivery with the same weights."""
    used = {}
    for told in (True, False):
        used[told] = 0
        for seed in range(6):
            robot, learner = learning(seed, doubt=0.1)
            first = robot.swing(learner.point)
            fast = first.figures._replace(speed=first.figures.speed + 10 * robot.scale[1])
            learner.note(first._replace(figures=fast, settled=not told))
            while not learner.confirmed:
                learner.note(robot.swing(learner.point))
            used[told] += len(learner.trials)
    assert used[True] < used[False]


def test_learner_mean_off_target_takes_further_step() -> None:
    """The prediction is within half the tolerances by swings nearby, the mean at the point is not."""
    robot, learner = learning(4, offset=0.0, scatter=0.0)
    zero = np.zeros(WEIGHTS)
    nearby = [np.full(WEIGHTS, 1e-5 * k) for k in range(1, 5)]
    for point, error in zip((zero, zero, *nearby), (0.1, 1.1, 0.3, 0.3, 0.3, 0.3), strict=True):
        learner.note(Attempt(point, Figures(*(TARGET.array + error * robot.scale)), robot.plan))
    assert not learner.confirmed
    assert np.linalg.norm(learner.point) > 0.01
