from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.control.law.gain_table import Gains, Triple, constant_gains, interpolate_gains
from bench.control.law.pid import PID_STATE, control, design_pid, reset_integral
from drivers.base.compiled import new_record

PERIOD = 1e-3
Array = np.ndarray[Any, Any]
ZERO = np.zeros(3)

# So that signals may be given as *signals.
tick: Callable[..., None] = control


NONE = (0.0, 0.0, 0.0)


def designed(
    proportional: Triple = (4.0, 2.0, 3.0),
    integral: Triple = (10.0, 0.0, 5.0),
    derivative: Triple = (0.1, 0.2, 0.0),
    **changes: Any,
) -> Array:
    limits: dict[str, Any] = {"lowest": (-1.0, -1.0, -0.5), "highest": (1.0, 1.0, 1.0)}
    gains = Gains(proportional, integral, derivative, NONE, NONE)
    return design_pid(constant_gains(gains), **limits | changes)


def begun(parameters: Array) -> Array:
    """Return the state with the gains of `parameters` taken."""
    state = new_record(PID_STATE)
    interpolate_gains(state["gains"][0], parameters[0], ZERO, 1.0)
    return state


def test_pid_first_step_is_exact() -> None:
    parameters = designed()
    state = begun(parameters)
    reference, reference_velocity = np.array([0.1, 0.2, -0.3]), np.array([1.0, -1.0, 2.0])
    angle, velocity = np.array([0.05, 0.25, -0.1]), np.array([0.5, 0.5, 0.5])
    control(state, parameters, reference, reference_velocity, angle, velocity, np.array([0.1, 0, 0]), PERIOD)
    s = state[0]
    assert s["proportional"] == pytest.approx([4 * 0.05, 2 * -0.05, 3 * -0.2], abs=1e-15)
    # The wrist is at its limit.
    assert s["integral"] == pytest.approx([10 * 0.05 * 1e-3, 0.0, 0.0], abs=1e-15)
    assert s["derivative"] == pytest.approx([0.1 * 0.5, 0.2 * -1.5, 0.0], abs=1e-15)
    assert s["unsaturated"] == pytest.approx([0.2 + 5e-4 + 0.05 + 0.1, -0.1 - 0.3, -0.6], abs=1e-15)
    assert s["output"] == pytest.approx([0.3505, -0.4, -0.5], abs=1e-15)


def test_pid_within_limits_equals_textbook_form() -> None:
    rng = np.random.default_rng(3)
    parameters = designed(lowest=(-1e6,) * 3, highest=(1e6,) * 3)
    state = begun(parameters)
    proportional, integral, derivative = state["gains"][0][:3]
    total = np.zeros(3)
    for _ in range(500):
        r, r_dot, y, y_dot, ff = rng.normal(0, 1, (5, 3))
        dt = rng.uniform(5e-4, 2e-3)
        control(state, parameters, r, r_dot, y, y_dot, ff, dt)
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
    parameters = designed(integral=(1000.0, 50.0, 5.0))
    low, high = parameters["lowest"][0], parameters["highest"][0]
    state = begun(parameters)
    if transfer is not None:
        state["integral"] = transfer  # however it came beyond the limits
    floor, ceiling = np.minimum(low, state["integral"][0]), np.maximum(high, state["integral"][0])
    for *signals, dt in ticks:
        before = state["integral"][0].copy()
        tick(state, parameters, *signals, dt)
        s = state[0]
        assert np.all(s["integral"] >= floor)
        assert np.all(s["integral"] <= ceiling)
        np.testing.assert_array_equal(s["output"], np.clip(s["unsaturated"], low, high))
        # A step of the integral never pushes the output beyond a limit.
        step = s["integral"] - before
        pushed = ((s["unsaturated"] > high + 1e-9) & (step > 0)) | (
            (s["unsaturated"] < low - 1e-9) & (step < 0)
        )
        assert not pushed.any()


def test_pid_after_long_saturation_output_leaves_limit_at_once() -> None:
    parameters = designed()
    state = begun(parameters)
    for _ in range(10_000):
        control(state, parameters, np.full(3, 10.0), ZERO, ZERO, ZERO, ZERO, PERIOD)
    assert state["output"][0].tolist() == [1.0, 1.0, 1.0]
    control(state, parameters, np.full(3, -0.01), ZERO, ZERO, ZERO, ZERO, PERIOD)
    assert np.all(state["output"][0] < 0)


def test_pid_integral_drives_output_to_limit() -> None:
    """Conditional integration must not stall short of the limit."""
    parameters = designed(integral=(1000.0, 1000.0, 1000.0))
    state = begun(parameters)
    control(state, parameters, np.full(3, 0.1), ZERO, ZERO, ZERO, ZERO, 1.0)
    assert state["output"][0] == pytest.approx([1.0, 1.0, 1.0], abs=1e-15)
    assert state["unsaturated"][0] == pytest.approx([1.0, 1.0, 1.0], abs=1e-15)


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # plain Python warns of 0 × inf
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("location", range(6))
def test_pid_non_finite_input_gives_nan_and_keeps_integral(bad: float, location: int) -> None:
    parameters = designed(derivative=(0.1, 0.2, 0.3))
    signals: list[Any] = [np.full(3, 0.01 * k) for k in range(5)]
    state = begun(parameters)
    tick(state, parameters, *signals, PERIOD)
    before = state["integral"].copy()
    broken = [s.copy() for s in signals]
    dt = PERIOD
    if location < 5:
        broken[location][1] = bad
    else:
        dt = bad
    tick(state, parameters, *broken, dt)
    assert np.isnan(state["output"][0, 1])
    assert np.isnan(state["unsaturated"][0, 1])
    assert np.all(np.isfinite(state["output"][0, [0, 2]])) or location == 5
    assert state["integral"][0, 1] == before[0, 1]
    tick(state, parameters, *signals, PERIOD)
    assert np.all(np.isfinite(state["output"]))


def test_reset_integral_clears_all_terms() -> None:
    parameters = designed()
    state = begun(parameters)
    control(state, parameters, np.full(3, 0.1), ZERO, ZERO, np.ones(3), ZERO, PERIOD)
    reset_integral(state)
    for name in ("proportional", "integral", "derivative", "unsaturated", "output"):
        assert state[name][0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
def test_pid_compiled_equals_plain(plain: Callable[..., Any]) -> None:
    rng = np.random.default_rng(9)
    parameters = designed(integral=(500.0, 20.0, 3.0))
    by_machine, by_hand = begun(parameters), begun(parameters).view(np.recarray)
    plain_control = plain(control)
    for k in range(300):
        signals = list(rng.normal(0, 0.3, (5, 3)))
        if k % 50 == 49:
            signals[k % 5][1] = rng.choice([np.nan, np.inf])
        tick(by_machine, parameters, *signals, PERIOD)
        plain_control(by_hand, parameters.view(np.recarray), *signals, PERIOD)
        np.testing.assert_array_equal(by_machine.view("f8"), by_hand.view("f8"))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"proportional": (np.nan, 1.0, 1.0)}, "proportional"),
        ({"integral": (-1.0, 1.0, 1.0)}, "integral"),
        ({"lowest": (0.5, -1.0, -1.0)}, "lowest"),
        ({"highest": (-0.5, 1.0, 1.0)}, "highest"),
        ({"lowest": (0.0, 0.0, 0.0), "highest": (0.0, 1.0, 1.0)}, "lowest"),
        ({"highest": (np.inf, 1.0, 1.0)}, "highest"),
    ],
)
def test_design_pid_invalid_parameter_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        designed(**changes)
