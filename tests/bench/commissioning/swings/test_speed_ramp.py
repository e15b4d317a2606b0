"""Speed ramp: slower swings along a designed path, and the reports on a robot that deviates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from bench.base.lifecycle import Cause
from bench.commissioning.machine.commissioning_step import Arm, MachineFault, SimulatedSeries
from bench.commissioning.swings import speed_ramp
from bench.commissioning.swings.robot_swings import FastestSwing, slowed
from bench.commissioning.swings.speed_ramp import (
    SWINGS,
    PredictionSpread,
    SwingDeviation,
    bench_of,
    deviation,
    nearest,
    require_as_predicted,
    require_safe,
    slow_swing,
    widest,
)
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.control.settings import ModelSettings
from bench.design.designer import DesignFailed
from bench.simulation.plant_variation import Variation
from bench.simulation.safety import Loads
from bench.simulation.simulated_bench import Bench, SeriesSwing
from bench.swing.profile import Profile
from tests.compiled_only import needs_speed

GOOD = SwingDeviation(30.0, 30.1, np.array([0.01, 0.01, 0.02]), np.array([[3.0, 2.0, 4.0], [3.0, 2.0, 4.0]]))
OTHER_PREDICTIONS = (([0.05, 0.01, 0.1], 30.3), ([0.01, 0.02, 0.05], 31.8))
"""Deviations of two predictions from a third of 30 m/s."""
TIGHT = {"backswing": (1e-4, 1e-4, 1e-4)}
SPEED = 43.2
"""Head speed of the default swing, m/s."""


@pytest.fixture(scope="module")
def configuration() -> Configuration:
    shipped = load_configuration(shipped_configuration())
    return replace(shipped, control=replace(shipped.control, feed_forward="kane+pneumatic"))


def test_slowed_swing_keeps_path(configuration: Configuration, default: Profile) -> None:
    slow = slowed(default, 0.5, configuration)
    for row in (default.begins[1], default.begins[3], default.begins[5], default.begins[6]):
        later = default.begins[1] + 2 * (row - default.begins[1])
        assert slow.angle[later] == pytest.approx(default.angle[row], abs=1e-6)
    assert slow.begins[3] - slow.begins[1] == 2 * (default.begins[3] - default.begins[1])
    assert slow.downswing_time == pytest.approx(2.0 * default.downswing_time, abs=0.002)
    assert slow.air == default.air
    assert len(slow.blind_brake) == (len(slow.angle) - 1) // slow.blind_spacing + 1
    assert np.abs(slow.valve).max() <= 1.0


@needs_speed
def test_slowed_swing_head_speed_matches_share(
    tmp_path: Path, configuration: Configuration, default: Profile
) -> None:
    slow = slowed(default, 0.5, configuration)
    bench = bench_of(configuration, slow)
    right = SimulatedSeries(bench, configuration.plant)
    predicted = right.swing(slow, ball=False)
    found = deviation(bench, predicted, right.swing(slow, ball=False))
    assert found.measured == pytest.approx(0.5 * default.delivery["head_speed_mps"], rel=0.15)
    require_as_predicted(found, Cause.NONE, "swing of 50 %")
    require_safe(right.loads(), "swing of 50 %")

    stiff = Variation(friction=(3.0, 3.0, 3.0), flow=(0.6, 0.6, 0.6)).applied_to(configuration.plant)
    other = SimulatedSeries(bench, stiff).swing(slow, ball=False)
    with pytest.raises(MachineFault, match="swing of 50 %"):
        require_as_predicted(deviation(bench, predicted, other), other.cause, "swing of 50 %")


@needs_speed
def test_slow_swing_downswing_velocity_deviation_is_small(
    configuration: Configuration, default: Profile
) -> None:
    slow = slow_swing(configuration, default, 0.4, SPEED)
    swing = SimulatedSeries(slow.bench, configuration.plant).swing(slow.bench.profile, ball=False)
    begins = slow.bench.profile.begins
    rows = swing.cycles[begins[3] : begins[5]]
    deviation_rms = np.sqrt(np.mean((rows["velocity"] - rows["reference_velocity"]) ** 2, axis=0))
    assert not slow.designed
    assert deviation_rms.max() < 0.5


@pytest.mark.release
@needs_speed
def test_slow_swing_stopped_in_prediction_is_designed(
    monkeypatch: pytest.MonkeyPatch, configuration: Configuration, default: Profile
) -> None:
    def design(known: Configuration, speed: float, name: str, start: Profile) -> Profile:
        assert name == f"commissioned-{100 * speed / SPEED:.0f}"
        if speed < slowest:
            raise DesignFailed("the head does not pass")
        return start

    slowest = 20.0
    monkeypatch.setattr(speed_ramp, "design_at", design)
    stretched = slow_swing(configuration, default, 0.5, SPEED)
    assert len(stretched.bench.profile.angle) > len(default.angle)
    tight = replace(configuration, envelope=replace(configuration.envelope, max_following_error=TIGHT))
    found = slow_swing(tight, default, 0.5, SPEED)
    assert (found.share, found.bench.profile) == (0.5, default)
    control = found.bench.control
    assert (control.downswing_damping, control.downswing_gain_factor) == (1.0, 1.0)
    assert found.bench.envelope.max_following_error["backswing"] > TIGHT["backswing"], (
        "the designed one has room"
    )
    slowest = 24.0
    assert slow_swing(tight, default, 0.5, SPEED).share == pytest.approx(0.6)
    slowest = 32.0
    with pytest.raises(MachineFault, match=r"prediction of the swing of 50 %(?s:.)*the head does not pass"):
        slow_swing(tight, default, 0.5, SPEED)
    slowest = 20.0
    monkeypatch.setattr(speed_ramp, "_FASTER", -0.3)  # as if it came much too fast
    assert slow_swing(configuration, default, 0.5, SPEED).bench.profile is default


@pytest.mark.parametrize(
    ("found", "cause", "words"),
    [
        (GOOD, Cause.SHOULDER_FOLLOWING, "stopped"),
        (GOOD._replace(measured=34.0), Cause.NONE, "head speed [+]13 %"),
        (GOOD._replace(measured=26.0), Cause.NONE, "head speed -13 %"),
        (GOOD._replace(measured=float("nan")), Cause.NONE, "head speed"),
        (GOOD._replace(path=np.array([0.01, 0.4, 0.02])), Cause.NONE, "arm 0.40 rad off"),
        (GOOD._replace(path=np.full(3, np.nan)), Cause.NONE, "shoulder nan rad"),
        (GOOD._replace(braking=np.array([[3.0, 2.0, 9.0], [3.0, 2.0, 4.0]])), Cause.NONE, "brakes less"),
    ],
)
def test_require_as_predicted_deviation_raises_fault(found: SwingDeviation, cause: Cause, words: str) -> None:
    with pytest.raises(MachineFault, match=words):
        require_as_predicted(found, cause, "swing of 60 %")


def test_require_as_predicted_small_deviation_is_accepted() -> None:
    require_as_predicted(GOOD, Cause.NONE, "swing of 60 %")
    slower = GOOD._replace(braking=np.array([[0.0, 0.0, 0.0], [3.0, 2.0, 4.0]]))
    require_as_predicted(slower, Cause.NONE, "swing of 60 %")


def test_nearest_returns_closest_prediction() -> None:
    """The model of a robot with wide dead bands makes a slow swing of 25 or of 23 m/s; the robot made 22."""
    fast, slow = GOOD._replace(predicted=25.2, measured=22.0), GOOD._replace(predicted=23.0, measured=22.0)
    astray = slow._replace(path=np.array([0.2, 0.01, 0.02]))
    unknown = slow._replace(path=np.full(3, np.nan))
    assert nearest([unknown, fast, astray, slow]) is slow
    assert nearest([fast]) is fast


def test_require_safe_load_over_rating_raises_fault() -> None:
    loads = Loads(np.zeros((3, 2)), np.zeros(6), 0.02, 20.0, 1.2, "wrist upper stop", 0.5, 0.5)
    with pytest.raises(MachineFault, match="120 % of its rated energy"):
        require_safe(loads, "swing of 80 %")
    require_safe(None, "swing of 80 %")  # a real robot does not say


def test_require_as_predicted_lower_share_widens_speed_limit() -> None:
    """In m/s: friction makes a slow swing uncertain, and its energy is low."""
    off = GOOD._replace(measured=1.12 * GOOD.predicted)
    require_as_predicted(off, Cause.NONE, "swing of 60 %", 0.6)
    with pytest.raises(MachineFault, match="12 % off"):
        require_as_predicted(off, Cause.NONE, "swing of 100 %", 1.0)
    with pytest.raises(MachineFault, match="within 13 %"):
        require_as_predicted(GOOD._replace(measured=1.15 * GOOD.predicted), Cause.NONE, "swing of 60 %", 0.6)


def test_require_as_predicted_prediction_spread_widens_limits() -> None:
    """What friction alone takes apart is no wrong machine."""
    assert widest([]) == PredictionSpread()
    others = [GOOD._replace(path=np.array(path), measured=speed) for path, speed in OTHER_PREDICTIONS]
    spread = widest(others)
    assert spread.path == (0.05, 0.02, 0.1)
    assert spread.speed == pytest.approx(0.06)
    off = GOOD._replace(path=np.array([0.16, 0.01, 0.02]))
    require_as_predicted(off, Cause.NONE, "swing of 100 %", spread=spread)
    with pytest.raises(MachineFault, match=r"the shoulder 0\.16 rad(?s:.)*at most 0\.15 rad"):
        require_as_predicted(off, Cause.NONE, "swing of 100 %")
    with pytest.raises(MachineFault, match=r"at most 0\.20 rad"):
        require_as_predicted(
            GOOD._replace(path=np.array([0.21, 0.0, 0.0])), Cause.NONE, "swing of 100 %", spread=spread
        )
    require_as_predicted(GOOD._replace(measured=1.13 * 30.0), Cause.NONE, "swing of 100 %", spread=spread)


class _Stumbling(SimulatedSeries):
    """A robot that stops in every swing."""

    def swing(self, *given: Any, ball: bool = True) -> SeriesSwing:
        return super().swing(*given, ball=ball)._replace(cause=Cause.WRIST_LEVER)


@needs_speed
@pytest.mark.timeout(600)
def test_rising_swings_full_swing_uses_generated_limits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, configuration: Configuration, default: Profile
) -> None:
    made = list[str]()
    slower, watched = replace(default, name="slower"), ModelSettings(air={"swing": (1e5, 1e5, 1e5)})

    def make(known: Configuration, profile: Profile, file: Path, progress: object) -> Configuration:
        made.append(f"limits of {profile.name}")
        assert file == tmp_path / "swing.toml"
        return replace(known, envelope=replace(known.envelope, model=watched))

    def swung(robot: object, bench: Bench, share: float, folder: Path) -> str:
        own = bench.envelope.model.air == watched.air
        made.append(f"{bench.profile.name} {own} {bench.as_known}")
        return ""

    def design(known: Configuration, speed: float, name: str, start: Profile) -> Profile:
        return default if name == "commissioned" else slower

    found = FastestSwing(default, 45.0, "stops")
    for name, stand_in in {
        "fastest_swing": lambda known, progress: found,
        "design_at": design,
        "swung_slowly": lambda *_: ["slow"],
        "with_following_limits": lambda known, profile: known,
        "make_healthy_limits": make,
        "_swung": swung,
    }.items():
        monkeypatch.setattr(speed_ramp, name, stand_in)
    SWINGS.swing(cast("Arm", None), configuration, tmp_path, lambda what: None)
    assert made == ["slower False False", "limits of default", "default True True"]


@pytest.mark.slow
def test_swung_slowly_stopped_swing_is_designed_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, configuration: Configuration, default: Profile
) -> None:
    """Near the top friction lets a slow robot slip, in one swing and not in its prediction."""
    (tmp_path / "records").mkdir()
    monkeypatch.setattr(speed_ramp, "design_at", lambda *_: default)
    benches, whole = list[Bench](), [default]

    def arm(bench: Bench) -> SimulatedSeries:
        benches.append(bench)
        kind = SimulatedSeries if any(bench.profile is one for one in whole) else _Stumbling
        return kind(bench, configuration.plant)

    known = replace(configuration, envelope=configuration.envelope.with_model_check("off"))
    speed = default.delivery["head_speed_mps"]
    notes = speed_ramp.swung_slowly(arm, known, default, 0.6, speed, tmp_path)
    assert [bench.profile is default for bench in benches] == [False, True]
    assert "designed instead" in notes[0]
    assert "predicted" in notes[1]
    whole.clear()
    with pytest.raises(MachineFault, match="stopped"):
        speed_ramp.swung_slowly(arm, known, default, 0.6, speed, tmp_path)
