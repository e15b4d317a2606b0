"""Steps 6 and 7: first swings at rising speed, each compared with its prediction; the swing is learned.

First swings are of 40, 60, 80 and 100 % of the speed. The prediction is the same swing of the robot as it was
measured. If a swing differs by more than the measured values explain, the machine is not as assumed, and no
faster swing follows.

The swing is learned with the response of the robot as it was measured. Encoders show the strike on the face
as far as lengths are known, which no step measures. Where the ball's mark is read, the mean offset of the
marks so far is added to the encoders' strike. A mark is requested until one is accepted, then after each
swing within tolerance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.commissioning.machine.commissioning_step import (
    LEARNED_FILE,
    SWING_FILE,
    Arm,
    MachineFault,
    PredictionFails,
    PredictionStopped,
    StepResult,
    SwingingStep,
    SwingSeries,
    SwingStopped,
)
from bench.commissioning.swings.robot_swings import (
    design_at,
    fastest_swing,
    make_healthy_limits,
    slowed,
    with_following_limits,
)
from bench.config import Configuration
from bench.control.law.feed_forward import FeedForward
from bench.design.designer import DesignFailed
from bench.learning.delivery import Figures, Tolerance, delivery_from_encoders, figures_of, strike_from_mark
from bench.learning.learn import LearningProblem, ObservedSwing, learn, prepare
from bench.simulation.safety import Loads, RunEnd, SafetyLimits, unsafe_reasons
from bench.simulation.simulated_bench import Bench, Series, SeriesSwing
from bench.swing.profile import Profile, load_profile, save_profile
from drivers.base import JOINTS
from sim.kinematics import head_motion

SLOW_SHARES, DESIGNED_SHARES = (0.4, 0.6), (0.8, 1.0)
"""Shares of the swing's speed: swings along its path without a ball, and designed ones."""
_FASTER = 0.1
"""Share of the full speed by which a slow swing along the stretched path may be faster."""
_MORE = (0.0, 0.1, 0.2)
"""Shares of the full speed that are added where a slow swing of the share itself is not found."""
RESERVE = 0.95
"""Share of the fastest designed swing's speed used for 100 %: a robot is not quite as it was measured."""
_MAX_SPEED_ERROR, _MAX_PATH_ERROR = 0.08, (0.15, 0.12, 0.25)
"""Max error of the prediction: highest head speed, as a share of the full swing's, which loads the shock
absorbers; joint angles up to the ball, rad."""
_MAX_BRAKE_EXCESS = 0.15, 1.5
"""Max excess of a joint's speed while it brakes, as a share of the predicted one and rad/s."""
_PREDICTIONS = 4
"""Swings of the model that predict one of the robot: friction and dead bands make each a little different."""
_STOPPED = "stopped: "
"""Begin of the text about a swing that the bench stopped."""
_BRAKED = 0.1
"""Time after the ball at which speeds are compared (s)."""
_FEED_FORWARD: FeedForward = "kane+pneumatic"
"""Feed-forward of slow swings, whose valve commands are not planned."""
_ROOM = 3.0
"""Times the following errors that are allowed a planned swing: a slow one has little energy."""

Array = np.ndarray[Any, np.dtype[np.float64]]


class SwingDeviation(NamedTuple):
    """Difference of a swing from its prediction."""

    predicted: float
    """Highest speed of the head up to the ball, m/s."""
    measured: float
    path: Array
    """Largest deviation of each joint up to the ball, rad (3,)."""
    braking: Array
    """Speed of each joint while it brakes, measured and predicted, rad/s (2, 3)."""


def rising_swings(
    arm: Arm, known: Configuration, folder: Path, progress: Callable[[str], None]
) -> StepResult:
    """Design the swings for the robot as `known`, make them, and store the fastest in `folder`.

    Raises:
        MachineFault: no swing can be designed, or the robot does not swing as predicted.
        Refused: it does not reach its address.
        BenchError: the package casadi is not installed.
    """
    try:
        fastest = fastest_swing(known, lambda speed: progress(f"designing a swing of {speed}"))
        highest = RESERVE * fastest.speed
        progress(f"designing a swing of {highest:.1f} m/s")
        full = design_at(known, highest, "commissioned", fastest.profile)
        next_fastest = design_at(known, DESIGNED_SHARES[0] * highest, "commissioned-slower", full)
    except DesignFailed as failure:
        action = "Check supply and valves: the measured robot is too weak or too slow."
        raise MachineFault("swing", str(failure), "a swing that this robot can do", action) from None
    notes = [f"the fastest designed swing: {fastest.speed:.1f} m/s; {fastest.limit}"]
    for share in SLOW_SHARES:
        progress(f"swing of {100 * share:.0f} %")
        notes += swung_slowly(arm, known, full, share, highest, folder)
    for share, designed in zip(DESIGNED_SHARES, (next_fastest, full), strict=True):
        limited = with_following_limits(known, designed)
        if designed is full:  # before the club comes at its full speed
            limited = make_healthy_limits(limited, full, folder / SWING_FILE, progress)
        progress(f"swing of {100 * share:.0f} %")
        bench = replace(bench_of(limited, designed), as_known=designed is full)
        notes.append(_swung(arm, bench, share, folder))
    save_profile(folder / SWING_FILE, full)
    return StepResult((), tuple(notes))


SWINGS = SwingingStep(
    "swings",
    "Swings of 40, 60, 80 and 100 % of the speed",
    "each designed for the robot as measured, within its shock absorbers if the ball is missed or "
    "communication is lost; the next one only if the speed differed from its prediction by at most "
    f"{100 * _MAX_SPEED_ERROR:g} % of the full one",
    rising_swings,
)
"""Swings of rising speed."""


def swung_slowly(
    arm: Arm, known: Configuration, full: Profile, share: float, speed: float, folder: Path
) -> list[str]:
    """Swing at `share` of the `speed` (m/s) of `full`, and return the notes for the report.

    A swing along the stretched path that the robot stops is made once more, designed: near the top friction
    may let a slow robot slip in one swing and not in its predictions.

    Raises:
        MachineFault: there is no such swing, or the robot does not swing as predicted.
    """
    slow = slow_swing(known, full, share, speed)
    try:
        return [_swung(arm, slow.bench, slow.share, folder)]
    except MachineFault as wrong:
        if slow.designed or not isinstance(wrong, SwingStopped):
            raise
        note = f"{wrong.location} {wrong.found}: designed instead"
    slow = slow_swing(known, full, share, speed, stretched=False)
    return [note, _swung(arm, slow.bench, slow.share, folder)]


def _with_placed_gains(known: Configuration) -> Configuration:
    """Return `known` with the gains placed by pose, and their damping, also in the downswing.

    The higher gains of a full downswing oscillate at 25 Hz in a longer one.
    """
    return replace(known, control=replace(known.control, downswing_damping=1.0, downswing_gain_factor=1.0))


def _along_path(known: Configuration) -> Configuration:
    """Return `known` with openings from the model, and room for what friction holds back near the top."""
    room = {
        phase: (_ROOM * a, _ROOM * b, _ROOM * c)
        for phase, (a, b, c) in known.envelope.max_following_error.items()
    }
    return replace(
        known,
        control=replace(known.control, feed_forward=_FEED_FORWARD),
        envelope=replace(known.envelope, max_following_error=room),
    )


class SlowSwing(NamedTuple):
    """A slow swing on its bench."""

    share: float
    """Share of the full speed."""
    bench: Bench
    designed: bool = False
    """Not along the stretched path."""


def slow_swing(
    known: Configuration, full: Profile, share: float, speed: float, *, stretched: bool = True
) -> SlowSwing:
    """Return a swing at `share` of the `speed` (m/s) of `full`: its path `stretched` in time.

    Where that is not wanted, or its prediction is stopped or too fast, as friction lets a slow robot move in
    jerks, it is designed; where no design is found, either at a little more speed.

    Raises:
        MachineFault: there is no such swing.
        BenchError: the package casadi is not installed.
    """
    known, found = _with_placed_gains(known), ""
    slow = _along_path(known)
    for tried in (share + more for more in _MORE):
        if stretched:
            bench = bench_of(slow, slowed(full, tried, slow))
            found = _prediction_fails(bench, (tried + _FASTER) * speed)
            if not found:
                return SlowSwing(tried, bench)
        try:
            designed = design_at(known, tried * speed, f"commissioned-{100 * tried:.0f}", full)
            return SlowSwing(tried, bench_of(with_following_limits(known, designed), designed), designed=True)
        except DesignFailed as failure:
            found = f"{found}; designed: {failure}".removeprefix("; ")
    expected = "a whole swing of about this speed, of the robot as measured"
    action = "Reduce friction: at low speed this robot moves in jerks."
    raise PredictionFails(f"prediction of the swing of {100 * share:.0f} %", found, expected, action)


def _prediction_fails(bench: Bench, fastest: float) -> str:
    """Return why the prediction of `bench` is no slow swing, or nothing; `fastest` is in m/s."""
    try:
        predicted = Series(bench, bench.plant).swing(bench.profile, ball=False)
    except Refused as refused:
        return refused.found
    if predicted.cause:
        return f"{_STOPPED}{CAUSE_TEXT[predicted.cause]}"
    speed = _head_speed(bench, predicted)
    return "" if speed <= fastest else f"{speed:.1f} m/s"


def _swung(arm: Arm, bench: Bench, share: float, folder: Path) -> str:
    """Swing `bench` once, and return the note on it; raises MachineFault if it is not as predicted."""
    ball, location = share >= DESIGNED_SHARES[0], f"swing of {100 * share:.0f} %"
    model = Series(bench, bench.plant)
    predicted = [model.swing(bench.profile, ball=ball) for _ in range(_PREDICTIONS)]
    require_safe(model.loads(), f"prediction of the {location}", PredictionFails)
    whole = [one for one in predicted if not one.cause]
    if not whole:
        said = f"{_STOPPED}{CAUSE_TEXT[predicted[0].cause]}"
        action = "Look at friction and dead bands: the robot as measured cannot make a swing designed for it."
        raise PredictionStopped(f"prediction of the {location}", said, "a whole swing", action)
    series = arm(bench)
    made = series.swing(bench.profile, ball=ball)
    np.savez_compressed(folder / f"records/6-swing-{100 * share:.0f}.npz", cycles=made.cycles)
    require_safe(series.loads(), location)
    found = nearest([deviation(bench, one, made) for one in whole])
    spread = widest([deviation(bench, one, whole[0]) for one in whole[1:]])
    require_as_predicted(found, made.cause, location, share, spread)
    offs = ", ".join(
        f"{joint} {1e3 * off:.0f} mrad" for joint, off in zip(JOINTS, found.path.tolist(), strict=True)
    )
    return (
        f"{location}: {found.measured:.1f} m/s, predicted {found.predicted:.1f} m/s; "
        f"largest deviation up to the ball {offs}"
    )


def bench_of(known: Configuration, profile: Profile) -> Bench:
    """Return the bench that swings `profile`, its model the robot as `known`."""
    return Bench.of(replace(known, envelope=known.envelope.with_model_check("off")), profile)


def exceeded(loads: Loads | None) -> list[str]:
    """Return which ratings `loads` are beyond; none where nothing measures them."""
    return [] if loads is None else unsafe_reasons(RunEnd(loads), SafetyLimits())


def require_safe(loads: Loads | None, location: str, error: type[MachineFault] = MachineFault) -> None:
    """Refuse to continue after `loads` beyond a rating; None: nothing measures them.

    Raises:
        MachineFault: a rating was exceeded.
    """
    if unsafe := exceeded(loads):
        action = "Inspect absorbers, chambers and club before anything moves; brakes are weaker than assumed."
        raise error(location, "; ".join(unsafe), "loads within every rating", action)


def deviation(bench: Bench, predicted: SeriesSwing, made: SeriesSwing) -> SwingDeviation:
    """Return how the swing `made` differs from the one `predicted`, by the encoders."""
    ball, rows = bench.profile.begins[5], round(_BRAKED / bench.profile.period)
    path = made.cycles["angle"][:ball] - predicted.cycles["angle"][:ball]
    going = made.cycles["cause"][:ball] == 0
    braking = [np.abs(swing.cycles["velocity"][ball + rows]) for swing in (made, predicted)]
    largest = np.abs(path[going]).max(axis=0) if going.any() else np.full(3, np.nan)
    fast = [_head_speed(bench, swing) for swing in (predicted, made)]
    return SwingDeviation(fast[0], fast[1], largest, np.array(braking))


def nearest(found: Sequence[SwingDeviation]) -> SwingDeviation:
    """Return the deviation (of at least one) from the prediction that the made swing is most like."""

    def off(one: SwingDeviation) -> float:
        speed = abs(one.measured / one.predicted - 1.0) / _MAX_SPEED_ERROR
        worst = float(np.max([speed, *(one.path / _MAX_PATH_ERROR)]))
        return worst if np.isfinite(worst) else np.inf

    return min(found, key=off)


def _head_speed(bench: Bench, swing: SeriesSwing) -> float:
    """Return the head's highest speed (m/s) in the downswing, by the encoders."""
    rows = swing.cycles[bench.profile.begins[3] : bench.profile.begins[5]]
    moving = zip(rows["angle"].tolist(), rows["velocity"].tolist(), strict=True)
    robot = bench.plant.robot.record[0]
    return max(float(np.hypot(*head_motion(robot, *angle, *speed)[3:5])) for angle, speed in moving)


class PredictionSpread(NamedTuple):
    """Largest differences between predictions of one swing: so far friction alone takes them apart."""

    speed: float = 0.0
    """Highest head speed, as a share."""
    path: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Joint angles up to the ball, rad."""


def widest(found: Sequence[SwingDeviation]) -> PredictionSpread:
    """Return the largest of deviations `found` between predictions; none without one."""
    if not found:
        return PredictionSpread()
    a, b, c = np.nanmax([one.path for one in found], axis=0).tolist()
    return PredictionSpread(max(abs(one.measured / one.predicted - 1.0) for one in found), (a, b, c))


def require_as_predicted(
    found: SwingDeviation,
    cause: Cause,
    location: str,
    share: float = 1.0,
    spread: PredictionSpread | None = None,
) -> None:
    """Refuse to continue after a swing at a `share` of the speed that is not as predicted.

    It may be as far off as the bounds and the `spread` of its predictions together.

    Raises:
        MachineFault: it is not.
    """
    action = (
        "Look for what changed since the steps before: supply and hoses, play, a rubbing joint, the club."
    )
    if cause:
        raise SwingStopped(location, f"{_STOPPED}{CAUSE_TEXT[cause]}", "a whole swing", action)
    off = found.measured / found.predicted - 1.0
    spread = spread or PredictionSpread()
    most = _MAX_SPEED_ERROR / share + spread.speed
    if not abs(off) <= most:
        said = f"head speed {100 * off:+.0f} % off its prediction"
        raise MachineFault(location, said, f"within {100 * most:.0f} %", action)
    for i, joint in enumerate(JOINTS):
        if not found.path[i] <= (bound := _MAX_PATH_ERROR[i] + spread.path[i]):
            away = f"the {joint} {found.path[i]:.2f} rad off its prediction"
            raise MachineFault(location, away, f"at most {bound:.2f} rad", action)
        measured, predicted = found.braking[:, i].tolist()
        if measured > (1.0 + _MAX_BRAKE_EXCESS[0]) * predicted + _MAX_BRAKE_EXCESS[1]:
            raise MachineFault(
                f"{location}, {joint}",
                f"{measured:.1f} rad/s {1e3 * _BRAKED:.0f} ms after the ball",
                f"about {predicted:.1f} rad/s: it brakes less than assumed",
                "Check valve, hoses and vents of this joint: the brake is weaker than measured slowly.",
            )


_SWINGS = 20
"""Max learning swings."""
_FARTHEST = 0.010
"""Max distance (m) of a mark from the encoders' strike that lengths explain: another ball left it, or it was
misread."""


def learned_swing(
    arm: Arm, known: Configuration, folder: Path, progress: Callable[[str], None]
) -> StepResult:
    """Learn the profile of the step before, and store it corrected in `folder`.

    Raises:
        MachineFault: the tolerances are not reached, or a load is beyond a rating.
        Refused: the robot does not come back to its address.
    """
    profile = load_profile(folder / SWING_FILE)
    progress("the response of the measured robot")
    problem = prepare(bench_of(known, profile))
    series, made = arm(problem.bench), list[SeriesSwing]()
    marks = _Marks(problem, series)

    def swing(weights: NDArray[np.float64]) -> ObservedSwing:
        progress(f"learning swing {len(made)}")
        swung = series.swing(problem.basis.correction(weights).applied_to(profile))
        require_safe(series.loads(), f"learning swing {len(made)}")
        made.append(swung)
        return ObservedSwing(swung.cycles, marks.figures(swung), swung.cause, swung.settled)

    result = learn(problem, swing, _SWINGS)
    save_profile(folder / LEARNED_FILE, result.correction.applied_to(profile))
    kept = result.attempts[result.chosen].figures
    text = f"{_words(kept)}; target {_words(result.target)}"
    if not result.within:
        expected = "a swing within 2 mm, 0.3 %, 0.3 deg and 0.3 deg of its target"
        action = "Look for what changes between swings: play, a slipping shaft, the supply; then --resume."
        raise MachineFault("learning", f"after {result.used} swings {text}", expected, action)
    notes = (f"learned in {result.used} swings: {text}", marks.text)
    true = figures_of(made[result.chosen].delivery)  # as a simulated plant knows it
    known_truth = () if np.isnan(true.speed) else (f"the simulated plant knows: {_words(true)}",)
    return StepResult((), (*notes, *known_truth))


LEARNING = SwingingStep(
    "learning",
    "Learning the swing",
    f"at most {_SWINGS} swings at the speed of the step before, corrections bounded; "
    "a swing that leaves its limits is stopped",
    learned_swing,
)
"""Learning of the swing that was found."""


def _words(f: Figures) -> str:
    angles = f"lean {np.degrees(f.lean):+.2f} deg, attack {np.degrees(f.attack):+.2f} deg"
    return f"{f.speed:.2f} m/s, strike {1e3 * f.strike:+.1f} mm, {angles}"


class _Marks:
    """The strike on the face by encoders and marks."""

    def __init__(self, problem: LearningProblem, series: SwingSeries) -> None:
        self._problem, self._series = problem, series
        self._read, self._beside, self._strange = True, list[float](), list[float]()

    def figures(self, swung: SeriesSwing) -> Figures:
        """Return the figures of `swung`, the last swing; unknown after a stop."""
        problem = self._problem
        delivery = (
            None
            if swung.cause
            else delivery_from_encoders(swung.cycles, problem.bench.plant, problem.response.free)
        )
        found = figures_of(delivery)
        if delivery is None:
            return found
        if self._read and (not self._beside or self._would_do(self._moved(found))):
            mark = self._series.face_mark(swung)
            if mark is None:
                self._read = False
            else:
                beside = strike_from_mark(*mark, problem.bench.plant) - found.strike
                (self._beside if abs(beside) <= _FARTHEST else self._strange).append(beside)
        return self._moved(found)

    @property
    def text(self) -> str:
        """Finding of the marks, for the report."""
        strange = ", ".join(f"{1e3 * beside:+.1f}" for beside in self._strange)
        told = f"; rejected marks: {strange} mm off the encoders' strike" if strange else ""
        if not self._beside:
            return (
                "no mark on the face was read: the strike is the encoders', as true as the lengths are" + told
            )
        off = 1e3 * float(np.mean(self._beside))
        return (
            f"{len(self._beside)} marks on the face, {off:+.1f} mm off the encoders' strike: error of lengths"
            + told
        )

    def _moved(self, figures: Figures) -> Figures:
        """Return `figures` with the strike where the marks so far say it was."""
        beside = float(np.mean(self._beside)) if self._beside else 0.0
        return figures._replace(strike=figures.strike + beside)

    def _would_do(self, figures: Figures) -> bool:
        scale, target = Tolerance().scale(self._problem.target), self._problem.target.array
        return bool(np.all(np.abs(figures.array - target) <= scale))
