from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.control.law.gain_table import Triple
from bench.control.law.pid import PID_STATE, control, reset_integral
from drivers.base.compiled import new_record

PERIOD = 1e-3
Array = np.ndarray[Any, Any]
ZERO = np.zeros(3)

# So that signals may be given as *signals.
tick: Callable[..., None] = control


def begun(
    proportional: Triple = (4.0, 2.0, 3.0),
    integral: Triple = (10.0, 0.0, 5.0),
    derivative: Triple = (0.1, 0.2, 0.0),
) -> Array:
    """Return the state with these gains taken."""
    state = new_record(PID_STATE)
    state["gains"][0, :3] = proportional, integral, derivative
    return state


def test_pid_first_step_is_exact() -> None:
    state = begun()
    reference, reference_velocity = np.array([0.1, 0.2, -0.6]), np.array([1.0, -1.0, 2.0])
    angle, velocity = np.array([0.05, 0.25, -0.1]), np.array([0.5, 0.5, 0.5])
    control(state, reference, reference_velocity, angle, velocity, np.array([0.1, 0, 0]), PERIOD)
    s = state[0]
    assert s["proportional"] == pytest.approx([4 * 0.05, 2 * -0.05, 3 * -0.5], abs=1e-15)
    # The wrist is at its limit.
    assert s["integral"] == pytest.approx([10 * 0.05 * 1e-3, 0.0, 0.0], abs=1e-15)
    assert s["derivative"] == pytest.approx([0.1 * 0.5, 0.2 * -1.5, 0.0], abs=1e-15)
    assert s["unsaturated"] == pytest.approx([0.2 + 5e-4 + 0.05 + 0.1, -0.1 - 0.3, -1.5], abs=1e-15)
    assert s["output"] == pytest.approx([0.3505, -0.4, -1.0], abs=1e-15)


def test_pid_within_limits_equals_textbook_form() -> None:
    rng = np.random.default_rng(3)
    state = begun()
    proportional, integral, derivative = state["gains"][0][:3]
    total = np.zeros(3)
    for _ in range(500):
        r, r_dot, y, y_dot, ff = rng.normal(0, 0.01, (5, 3))
        dt = rng.uniform(5e-4, 2e-3)
        control(state, r, r_dot, y, y_dot, ff, dt)
        total += (r - y) * dt
        expected = proportional * (r - y) + integral * total + derivative * (r_dot - y_dot) + ff
        np.testing.assert_allclose(state["output"][0], expected, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(state["output"], state["unsaturated"])


signal = st.floats(-100, 100)
triple = st.tuples(signal, signal, signal).map(np.array)


@given(
    ticks=st.lists(st.tuples(triple, triple, triple, triple, triple, st.floats(1e-4, 0.1)), max_size=40),
    transfer=st.none() | triple,
)
def test_pid_integral_and_output_stay_within_limits(ticks: list[Any], transfer: Array | None) -> None:
    state = begun(integral=(1000.0, 50.0, 5.0))
    if transfer is not None:
        state["integral"] = transfer  # however it came beyond the limits
    floor, ceiling = np.minimum(-1.0, state["integral"][0]), np.maximum(1.0, state["integral"][0])
    for *signals, dt in ticks:
        before = state["integral"][0].copy()
        tick(state, *signals, dt)
        s = state[0]
        assert np.all(s["integral"] >= floor)
        assert np.all(s["integral"] <= ceiling)
        np.testing.assert_array_equal(s["output"], np.clip(s["unsaturated"], -1.0, 1.0))
        # A step of the integral never pushes the output beyond a limit.
        step = s["integral"] - before
        assert not ((np.abs(s["unsaturated"]) > 1.0 + 1e-9) & (step * s["unsaturated"] > 0)).any()


def test_pid_after_long_saturation_output_leaves_limit_at_once() -> None:
    state = begun()
    for _ in range(10_000):
        control(state, np.full(3, 10.0), ZERO, ZERO, ZERO, ZERO, PERIOD)
    assert state["output"][0].tolist() == [1.0, 1.0, 1.0]
    control(state, np.full(3, -0.01), ZERO, ZERO, ZERO, ZERO, PERIOD)
    assert np.all(state["output"][0] < 0)


def test_pid_integral_drives_output_to_limit() -> None:
    """Conditional integration must not stall short of the limit."""
    state = begun(integral=(1000.0, 1000.0, 1000.0))
    control(state, np.full(3, 0.1), ZERO, ZERO, ZERO, ZERO, 1.0)
    assert state["output"][0] == pytest.approx([1.0, 1.0, 1.0], abs=1e-15)
    assert state["unsaturated"][0] == pytest.approx([1.0, 1.0, 1.0], abs=1e-15)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # plain Python warns of 0 × inf
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("location", range(6))
def test_pid_non_finite_input_gives_nan_and_keeps_integral(bad: float, location: int) -> None:
    signals: list[Any] = [np.full(3, 0.01 * k) for k in range(5)]
    state = begun(derivative=(0.1, 0.2, 0.3))
    tick(state, *signals, PERIOD)
    before = state["integral"].copy()
    broken = [s.copy() for s in signals]
    dt = PERIOD
    if location < 5:
        broken[location][1] = bad
    else:
        dt = bad
    tick(state, *broken, dt)
    assert np.isnan(state["output"][0, 1])
    assert np.isnan(state["unsaturated"][0, 1])
    assert np.all(np.isfinite(state["output"][0, [0, 2]])) or location == 5
    assert state["integral"][0, 1] == before[0, 1]
    tick(state, *signals, PERIOD)
    assert np.all(np.isfinite(state["output"]))


def test_reset_integral_clears_all_terms() -> None:
    state = begun()
    control(state, np.full(3, 0.1), ZERO, ZERO, np.ones(3), ZERO, PERIOD)
    reset_integral(state)
    for name in ("proportional", "integral", "derivative", "unsaturated", "output"):
        assert state[name][0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_pid_compiled_equals_plain(plain: Callable[..., Any]) -> None:
    rng = np.random.default_rng(9)
    by_machine = begun(integral=(500.0, 20.0, 3.0))
    by_hand = by_machine.copy().view(np.recarray)
    plain_control = plain(control)
    for k in range(300):
        signals = list(rng.normal(0, 0.3, (5, 3)))
        if k % 50 == 49:
            signals[k % 5][1] = rng.choice([np.nan, np.inf])
        tick(by_machine, *signals, PERIOD)
        plain_control(by_hand, *signals, PERIOD)
        np.testing.assert_array_equal(by_machine.view("f8"), by_hand.view("f8"))
