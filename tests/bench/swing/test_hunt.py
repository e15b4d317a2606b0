"""Hunt's functions: ADAMS' STEP and the junctions of the two phases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.swing.hunt import BACKSWING_DURATION, SWING_DURATION, right_arm_length, shoulder_turn, step


def test_step_is_cubic() -> None:
    assert step([-1.0, 0.0, 0.5, 1.0, 2.0], 0.0, 0.0, 1.0, 1.0) == pytest.approx([0, 0, 0.5, 1, 1])
    assert step(0.25, 0.0, 0.0, 1.0, 1.0) == pytest.approx(0.25**2 * (3 - 2 * 0.25))
    # not the tanh which the thesis equates with it
    assert abs(step(0.25, 0.0, 0.0, 1.0, 1.0) - (np.tanh(-1.5) + 1) / 2) > 0.1


@given(st.floats(-5, 5), st.floats(0.01, 5), st.floats(-5, 5), st.floats(-5, 5))
def test_step_rises_monotonically_with_flat_ends(t0: float, width: float, h0: float, h1: float) -> None:
    t = np.linspace(t0 - width, t0 + 2 * width, 301)
    h = step(t, t0, h0, t0 + width, h1)
    assert np.all(np.diff(h) * np.sign(h1 - h0) >= -1e-12)
    assert h[0] == h0
    assert h[-1] == pytest.approx(h1)
    # mirrored about its middle
    assert h + h[::-1] == pytest.approx(np.full(301, h0 + h1))
    ends = step(np.array([t0 + 1e-5 * width, t0 + (1 - 1e-5) * width]), t0, h0, t0 + width, h1)
    assert ends == pytest.approx([h0, h1], abs=1e-8)


def test_step_empty_ramp_is_refused() -> None:
    with pytest.raises(ValueError, match="t0 must lie before t1"):
        step(0.0, 1.0, 0.0, 1.0, 1.0)


def test_hunt_functions_match_values_at_junctions() -> None:
    top = BACKSWING_DURATION
    assert shoulder_turn([0, top, SWING_DURATION]) == pytest.approx([0, 1.810354, 1.810354 - 1.96752676])
    assert right_arm_length([0, 0.2, top, SWING_DURATION]) == pytest.approx(
        [-0.03032, -0.03032, -0.23382, -0.03032]
    )


def test_hunt_functions_are_continuous() -> None:
    time = np.arange(0.0, SWING_DURATION, 1e-3)
    assert np.abs(np.diff(shoulder_turn(time))).max() < 0.012
    assert np.abs(np.diff(right_arm_length(time))).max() < 0.002


def test_hunt_functions_time_outside_swing_is_refused() -> None:
    with pytest.raises(ValueError, match="outside the swing"):
        shoulder_turn(0.9)
    with pytest.raises(ValueError, match="outside the swing"):
        right_arm_length(np.nan)
