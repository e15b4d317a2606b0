"""Learning with marks on the face: what they say of unmeasured lengths."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from bench.commissioning.machine.commissioning_step import (
    LEARNED_FILE,
    SWING_FILE,
    Mark,
    SimulatedSeries,
    SwingSeries,
    read_mark,
)
from bench.commissioning.swings.speed_ramp import LEARNING, bench_of
from bench.config import Configuration
from bench.simulation.simulated_bench import Series, SeriesSwing
from bench.swing.library import find_profile
from bench.swing.profile import load_profile, save_profile
from sim.impact import Delivery
from tests.compiled_only import needs_speed


class Unread(SimulatedSeries):
    """A robot whose marks are not read."""

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        return None


class TouchedBall(SimulatedSeries):
    """A robot whose first mark is that of another ball."""

    first = True

    def face_mark(self, swing: SeriesSwing) -> Mark | None:
        other, self.first = self.first, False
        return (3.0, -31.0) if other else super().face_mark(swing)


def test_read_mark_rounds_to_half_millimetre() -> None:
    made = Delivery((40.0, 1.0, 0.0), 0.0, 0.2, strike_x=0.00138, strike_y=-0.0029)
    assert read_mark(made) == (1.5, -3.0)
    assert read_mark(None) is None


@needs_speed
@pytest.mark.release
@pytest.mark.timeout(600)
def test_learned_swing_face_marks_correct_length_error(tmp_path: Path, configuration: Configuration) -> None:
    robot = configuration.plant.robot
    longer = replace(configuration.plant, robot=replace(robot, l12=robot.l12 + 0.008))
    profile = load_profile(find_profile("default"))
    save_profile(tmp_path / SWING_FILE, profile)
    strikes = []
    for kind in (SimulatedSeries, Unread, TouchedBall):
        result = LEARNING.swing(partial(kind, plant=longer), configuration, tmp_path, lambda what: None)
        learned = load_profile(tmp_path / LEARNED_FILE)
        swung: SwingSeries = Series(bench_of(configuration, learned), longer)  # type: ignore[assignment]
        delivery = swung.swing(learned).delivery
        assert delivery is not None
        strikes.append(delivery.in_plane_error)
        said = next(note for note in result.notes if "mark" in note)
        assert ("off the encoders" in said) is (kind is not Unread)
        assert ("rejected marks" in said) is (kind is TouchedBall)
        assert ("no mark" in said) is (kind is Unread)
    assert abs(strikes[0]) < 0.001
    assert abs(strikes[2]) < 0.002  # the promise; how near depends on the processor's last bits
    assert abs(strikes[1]) > 0.0015, "encoders do not show it"
