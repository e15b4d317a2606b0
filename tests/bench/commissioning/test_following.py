"""Following limits for a robot that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.base.lifecycle import Cause
from bench.commissioning.swings.robot_swings import with_following_limits
from bench.config import Configuration
from bench.simulation.plant_variation import Variation
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.profile import Profile
from tests.compiled_only import needs_speed


@needs_speed
def test_with_following_limits_shipped_robot_keeps_limits(
    configuration: Configuration, default: Profile
) -> None:
    assert with_following_limits(configuration, default).envelope.max_following_error == {
        phase: pytest.approx(limits) for phase, limits in configuration.envelope.max_following_error.items()
    }


@pytest.mark.release
@needs_speed
def test_with_following_limits_lagging_robot_widens_limits(
    configuration: Configuration, default: Profile
) -> None:
    plant = Variation(flow=(0.5, 0.5, 0.5)).applied_to(configuration.plant)
    lagging = replace(configuration, plant=plant)
    wider = with_following_limits(lagging, default)
    before, after = (np.array(list(c.envelope.max_following_error.values())) for c in (lagging, wider))
    assert np.all(after >= before)
    assert np.any(after > before)

    def cause(c: Configuration) -> Cause:
        envelope = c.envelope.with_model_check("off")
        bench = Bench.of(replace(c, envelope=envelope), default)
        return Series(bench, bench.plant).swing(default, ball=True).cause

    assert cause(lagging) in {Cause.SHOULDER_FOLLOWING, Cause.ARM_FOLLOWING, Cause.WRIST_FOLLOWING}
    assert cause(wider) == Cause.NONE
