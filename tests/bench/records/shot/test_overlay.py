"""Two swings on one clock: courses of records and profiles, and where they differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.records.shot.overlay import SwingCourse, clocks, course_of_profile, course_of_record, differences
from bench.records.shot.recorded_shot import RecordedShot, read_shot
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.plant import PlantParameters
from tests.replay.renew import STOP, SWING


@pytest.fixture(scope="module")
def recorded() -> RecordedShot:
    return read_shot(SWING)


@pytest.fixture(scope="module")
def swing(recorded: RecordedShot) -> SwingCourse:
    return course_of_record("swing", recorded)


def test_differences_identical_swings_are_zero(swing: SwingCourse) -> None:
    for row in differences(swing, swing):
        assert row.between == 0.0 or np.isnan(row.between), row
        assert row.rms == 0.0 or np.isnan(row.rms), row


def test_course_of_record_head_speed_matches_simulated_club_speed(
    recorded: RecordedShot, swing: SwingCourse
) -> None:
    assert swing.ball is not None
    at_ball = np.interp(swing.ball - 1e-3, swing.time, swing.head_speed)
    assert at_ball == pytest.approx(swing.figures["club_speed_mps"], rel=0.03)
    assert swing.head_speed[0] < 0.2


def test_clocks_record_and_profile_align_at_ball(swing: SwingCourse, plant: PlantParameters) -> None:
    planned = course_of_profile(plant, load_profile(find_profile("default")))
    one, two, at_ball = clocks(swing, planned)
    assert at_ball
    assert one[0] == pytest.approx(two[0], abs=0.03)
    rows = {row.name: row for row in differences(swing, planned)}
    assert rows["club speed"].between == pytest.approx(0.0, abs=0.1)
    tracking = rows["wrist: tracking error, RMS"]
    assert 0.0 < tracking.first < 10.0
    assert np.isnan([tracking.second, tracking.between]).all(), "a plan has no tracking error"


def test_clocks_stopped_swing_aligns_at_start(swing: SwingCourse) -> None:
    stopped = course_of_record("stop", read_shot(STOP))
    assert stopped.ball is None
    assert clocks(swing, stopped)[2] is False
    both = min(len(swing.time), len(stopped.time))
    early = slice(0, both // 4)
    assert stopped.angle[early] == pytest.approx(swing.angle[early], abs=0.02), "they part in the brake"
    assert {row.name: row for row in differences(swing, stopped)}["shoulder: angle"].rms > 1.0


def test_differences_are_second_minus_first(swing: SwingCourse) -> None:
    other = replace(
        swing,
        angle=swing.angle + np.radians([0.0, 2.0, 0.0]),
        opening=swing.opening * 0.5,
        pressure=swing.pressure * np.nan,
        figures=swing.figures | {"club_speed_mps": swing.figures["club_speed_mps"] + 1.5},
    )
    rows = {row.name: row for row in differences(swing, other)}
    assert rows["club speed"].between == pytest.approx(1.5)
    assert rows["arm: angle"].rms == pytest.approx(2.0)
    opening = rows["wrist: valve opening, largest"]
    assert opening.between == pytest.approx(-0.5 * opening.first)
    assert "carry" not in rows or np.isfinite(rows["carry"].between)
