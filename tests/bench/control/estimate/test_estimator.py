from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from filterpy.common import Q_continuous_white_noise, Q_discrete_white_noise
from hypothesis import strategies as st

from bench.base.lifecycle import Phase, Request
from bench.control.estimate.estimator import ESTIMATOR_STATE, design_estimator, estimate
from bench.control.estimate.reference_filter import Samples, filterpy_estimates, velocity_difference
from bench.control.settings import build_controller
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LockstepEngine
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import new_record
from sim.plant import PlantParameters, build_plant
from tests.sampling import examples, release_except

PERIOD = 1e-3
COUNTS = 2**16
IMPACT = 0.93
RESOLUTION = 2.0 * np.pi / COUNTS
JITTER = (2e-6, 2e-6, 2e-6)
CHANGE = (50.0, 50.0, 100.0)
JUMP = (0.3, 0.3, 1.0)

Array = np.ndarray[Any, Any]


def designed(**changes: Any) -> Array:
    given_values: dict[str, Any] = {
        "period": PERIOD,
        "counts_per_revolution": COUNTS,
        "jitter": JITTER,
        "acceleration_change": CHANGE,
        "velocity_jump": JUMP,
    }
    return design_estimator(**given_values | changes)


class Track:
    """Values of a run of the estimator, one row per tick."""

    def __init__(self, ticks: int) -> None:
        self.x = np.empty((ticks, 3, 3))
        self.covariance = np.empty((ticks, 3, 6))
        self.innovation = np.empty((ticks, 3))
        self.normalised = np.empty((ticks, 3))


def run(angle: Array, age: Array, valid: Array, dt: Array, window: Array, parameters: Array) -> Track:
    state = new_record(ESTIMATOR_STATE)
    track = Track(len(angle))
    for k in range(len(angle)):
        estimate(state, parameters, angle[k], age[k], valid[k], dt[k], bool(window[k]))
        track.x[k] = np.stack([state["angle"][0], state["velocity"][0], state["acceleration"][0]], axis=1)
        track.covariance[k] = state["covariance"][0]
        track.innovation[k] = state["innovation"][0]
        track.normalised[k] = state["normalised_innovation"][0]
    return track


def assert_equal_to_filterpy(angle: Array, age: Array, valid: Array, dt: Array, window: Array) -> None:
    """Angle and velocity within 1e-9, acceleration within 1e-9 of 1000 rad/s², covariances of their scale."""
    samples, parameters = Samples(angle, age, valid, dt, window), designed()
    track = run(*samples, parameters)
    for joint in range(3):
        if not valid[:, joint].any():
            continue
        first = int(np.argmax(valid[:, joint]))
        x, P, y = filterpy_estimates(samples, parameters, joint)
        own = track.x[first + 1 :, joint]
        np.testing.assert_allclose(own[:, 0], x[:, 0], rtol=0, atol=1e-9)
        np.testing.assert_allclose(own[:, 1], x[:, 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(own[:, 2] / 1e3, x[:, 2] / 1e3, rtol=0, atol=1e-9)
        deviation = np.sqrt(P[:, [0, 3, 5]])
        scale = deviation[:, [0, 0, 0, 1, 1, 2]] * deviation[:, [0, 1, 2, 1, 2, 2]]
        np.testing.assert_allclose(track.covariance[first + 1 :, joint] / scale, P / scale, rtol=0, atol=1e-9)
        np.testing.assert_allclose(track.innovation[first + 1 :, joint], y, rtol=0, atol=1e-9)


def sampled(angle: Array) -> Array:
    return np.round(angle / RESOLUTION) * RESOLUTION


def in_window(time: Array) -> Array:
    return (time > IMPACT - 0.004) & (time < IMPACT + 0.008)


def test_estimate_swing_with_drop_outs_and_impact_equals_filterpy(swing: Callable[..., Any]) -> None:
    s = swing()
    rng = np.random.default_rng(1)
    valid = (rng.random(s.angle.shape) > 0.05).astype("u1")
    valid[300:340, 0] = 0
    valid[925:933, 2] = 0  # lost over the impact
    valid[:5] = 0  # starts late
    dt = np.full(len(s.time), PERIOD)
    age = np.zeros(s.angle.shape)
    assert_equal_to_filterpy(sampled(s.angle), age, valid, dt, in_window(s.time))


@pytest.mark.slow
def test_estimate_simulated_swing_equals_filterpy() -> None:
    profile = load_profile(find_profile("default"))
    parameters = PlantParameters()
    bench = Lockstep(build_plant(parameters), build_controller(parameters, profile), profile.angle[0])
    engine = LockstepEngine(bench)
    assert engine.arm()
    assert engine.await_air()
    bench.state.control["tee"] = True
    cycles = bench.advance(len(profile.angle), Request.SWING)
    assert bench.plant_state["struck"][0]
    counts = cycles["encoder_count"]
    # Continuous angles from absolute counts, as the records hold them.
    angle = np.unwrap(counts * (2 * np.pi / parameters.encoders.counts_per_revolution), axis=0)
    valid = (np.random.default_rng(7).random(angle.shape) > 0.05).astype("u1")
    impact = profile.begins[-2]
    valid[400:430, 0] = 0
    valid[impact + 1 : impact + 7, 2] = 0  # lost over the impact
    window = cycles["phase"] == Phase.IMPACT
    assert_equal_to_filterpy(angle, cycles["encoder_age"].copy(), valid, np.full(len(angle), PERIOD), window)


def test_estimate_measured_ticks_and_aged_samples_equals_filterpy(swing: Callable[..., Any]) -> None:
    s = swing()
    rng = np.random.default_rng(2)
    keep = np.sort(rng.choice(len(s.time), 900, replace=False))  # missed ticks make long ones
    dt = np.diff(s.time[keep], prepend=s.time[keep[0]] - PERIOD) + rng.normal(0, 2e-5, 900)
    age = rng.uniform(0, 1e-3, (900, 3))
    valid = (rng.random((900, 3)) > 0.02).astype("u1")
    assert_equal_to_filterpy(sampled(s.angle[keep]), age, valid, dt, in_window(s.time[keep]))


@examples(
    8,
    30,
    silences=st.lists(st.tuples(st.integers(0, 249), st.integers(1, 80), st.integers(0, 2)), max_size=8),
    scattered=st.floats(0, 0.6),
    seed=st.integers(0, 2**32 - 1),
    opening=st.integers(0, 249),
)
def test_estimate_random_missing_samples_equals_filterpy(
    silences: list[tuple[int, int, int]], scattered: float, seed: int, opening: int
) -> None:
    rng = np.random.default_rng(seed)
    ticks = 250
    acceleration = np.cumsum(rng.normal(0, 100, (ticks, 3)), axis=0)
    velocity = np.cumsum(acceleration, axis=0) * PERIOD
    velocity[opening:] -= 12.0
    angle = sampled(np.cumsum(velocity, axis=0) * PERIOD)
    valid = (rng.random((ticks, 3)) >= scattered).astype("u1")
    for begin, length, joint in silences:
        valid[begin : begin + length, joint] = 0
    dt = rng.uniform(0.5, 1.5, ticks) * PERIOD
    window = np.abs(np.arange(ticks) - opening) < 6
    assert_equal_to_filterpy(angle, rng.uniform(0, 5e-4, (ticks, 3)), valid, dt, window)


def test_velocity_difference_of_compiled_filter_is_rounding() -> None:
    assert 0 < velocity_difference() < 1e-9


def test_design_estimator_noise_equals_filterpy() -> None:
    parameters = designed()[0]
    for joint in range(3):
        q = Q_discrete_white_noise(3, PERIOD, CHANGE[joint] ** 2)
        assert parameters["density"][joint] * PERIOD == pytest.approx(q[2, 2], rel=1e-15)
        jump = Q_continuous_white_noise(2, PERIOD, JUMP[joint] ** 2 / PERIOD)
        assert parameters["jump_density"][joint] * PERIOD == pytest.approx(jump[1, 1], rel=1e-15)
        assert parameters["quantisation"][joint] == pytest.approx(RESOLUTION**2 / 12, rel=1e-15)


def test_estimate_missing_sample_predicts_and_grows_covariance() -> None:
    state = new_record(ESTIMATOR_STATE)
    parameters = designed()
    ones, zeros = np.ones(3, "u1"), np.zeros(3, "u1")
    for k in range(200):
        estimate(state, parameters, np.full(3, 5.0 * k * PERIOD), np.zeros(3), ones, PERIOD, False)
    last = state.copy()
    for k in range(1, 21):
        before = state.copy()
        estimate(state, parameters, np.full(3, 99.0), np.zeros(3), zeros, PERIOD, False)
        for diagonal in (0, 3, 5):
            assert np.all(state["covariance"][0, :, diagonal] > before["covariance"][0, :, diagonal])
        elapsed = k * PERIOD
        assert state["angle"][0] == pytest.approx(
            last["angle"][0] + elapsed * last["velocity"][0] + elapsed**2 / 2 * last["acceleration"][0],
            abs=1e-12,
        )
        assert np.all(state["normalised_innovation"][0] == 0)
        assert state["without_sample"][0] == pytest.approx(np.full(3, elapsed))
    estimate(state, parameters, state["angle"][0].copy(), np.zeros(3), ones, PERIOD, False)
    assert np.all(state["without_sample"][0] == 0)


def test_estimate_before_first_sample_is_zero() -> None:
    state = new_record(ESTIMATOR_STATE)
    parameters = designed()
    estimate(state, parameters, np.full(3, 7.0), np.zeros(3), np.array([1, 0, 0], "u1"), PERIOD, False)
    assert state["started"][0].tolist() == [1, 0, 0]
    assert state["angle"][0].tolist() == [7.0, 0.0, 0.0]
    assert state["without_sample"][0].tolist() == [0.0, PERIOD, PERIOD]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["angle", "age"])
def test_estimate_non_finite_sample_is_ignored_with_nan_innovation(bad: float, where: str) -> None:
    state, twin = new_record(ESTIMATOR_STATE), new_record(ESTIMATOR_STATE)
    parameters = designed()
    ones = np.ones(3, "u1")
    for k in range(50):
        for record in (state, twin):
            estimate(record, parameters, np.full(3, k * 1e-3), np.zeros(3), ones, PERIOD, False)
    angle, age = np.full(3, 0.05), np.zeros(3)
    {"angle": angle, "age": age}[where][2] = bad
    estimate(state, parameters, angle, age, ones, PERIOD, False)
    estimate(twin, parameters, np.full(3, 0.05), np.zeros(3), np.array([1, 1, 0], "u1"), PERIOD, False)
    assert np.isnan(state["normalised_innovation"][0, 2])
    assert np.all(np.isfinite(state["normalised_innovation"][0, :2]))
    for name in ("angle", "velocity", "acceleration", "covariance", "without_sample"):
        np.testing.assert_array_equal(state[name], twin[name])


def test_estimate_nan_tick_returns_nan() -> None:
    state = new_record(ESTIMATOR_STATE)
    parameters = designed()
    for dt in (PERIOD, np.nan):
        estimate(state, parameters, np.ones(3), np.zeros(3), np.ones(3, "u1"), dt, False)
    assert np.all(np.isnan(state["angle"][0]))


def test_estimate_long_silence_keeps_covariance_positive() -> None:
    state = new_record(ESTIMATOR_STATE)
    parameters = designed()
    ones, zeros = np.ones(3, "u1"), np.zeros(3, "u1")
    for k in range(20_000):
        estimate(state, parameters, np.zeros(3), np.zeros(3), ones if k < 10 else zeros, PERIOD, False)
    for k in range(200):
        estimate(state, parameters, np.full(3, 0.3), np.zeros(3), ones, PERIOD, False)
        c = state["covariance"][0]
        assert np.all(c[:, [0, 3, 5]] > 0)
        assert np.all(state["innovation_variance"][0] > 0)
        if k < 3:  # angle, velocity and acceleration are not yet told apart
            continue
        P = np.stack([c[:, [0, 1, 2]], c[:, [1, 3, 4]], c[:, [2, 4, 5]]], axis=1)
        scale = 1.0 / np.sqrt(np.einsum("nii->ni", P))
        assert np.linalg.eigvalsh(P * scale[:, :, None] * scale[:, None, :]).min() > 0
    assert state["angle"][0] == pytest.approx(np.full(3, 0.3), abs=1e-6)
    assert state["velocity"][0] == pytest.approx(np.zeros(3), abs=1e-3)


def test_estimate_constant_latency_leaves_no_lag() -> None:
    """A constant, known latency leaves no lag: the angle of 0.7 ms ago is used as just that."""
    state = new_record(ESTIMATOR_STATE)
    parameters = designed(jitter=(0.0, 0.0, 0.0))
    age = 0.7e-3
    times = np.arange(400) * PERIOD
    for t in times:
        angle = np.full(3, 100.0 * (t - age) ** 2)
        estimate(state, parameters, angle, np.full(3, age), np.ones(3, "u1"), PERIOD, False)
    assert state["angle"][0] == pytest.approx(np.full(3, 100.0 * times[-1] ** 2), abs=1e-9)
    assert state["velocity"][0] == pytest.approx(np.full(3, 200.0 * times[-1]), abs=1e-6)


@pytest.mark.parametrize("runs", release_except({40}, [40, 400]))
def test_estimate_nees_and_nis_are_consistent(runs: int) -> None:
    """Monte Carlo: NEES averages 3, NIS 1, also after drop-outs and after jumps inside the window.

    3 joints × `runs` of signals drawn from the filter's model; jumps at a random instant of the tick. The
    bounds are 5 standard deviations of a mean of that many chi-squares.
    """
    rng, ticks = np.random.default_rng(20), 120
    parameters = designed(jitter=(0.0, 0.0, 0.0), acceleration_change=(80.0,) * 3, velocity_jump=(5.0,) * 3)
    noise = np.sqrt(parameters["quantisation"][0, 0])
    g = np.array([PERIOD**2 / 2, PERIOD, 1.0])
    F = np.array([[1.0, PERIOD, PERIOD**2 / 2], [0.0, 1.0, PERIOD], [0.0, 0.0, 1.0]])
    nees, nis = np.zeros(ticks), np.zeros(ticks)
    lost = {30, 31, 32, 61, 62, 63, 64}
    for _ in range(runs):
        state = new_record(ESTIMATOR_STATE)
        x = np.stack([np.zeros(3), rng.normal(0, 1, 3), rng.normal(0, 10, 3)], axis=1)
        for k in range(ticks):
            window = 60 <= k < 70
            if k:
                x = x @ F.T + rng.normal(0, 80.0, (3, 1)) * g
            if window:
                jump, part = rng.normal(0, 5.0, 3), rng.random(3)
                x[:, 0] += jump * part * PERIOD
                x[:, 1] += jump
            z = x[:, 0] + rng.normal(0, noise, 3)
            valid = np.full(3, k not in lost, "u1")
            estimate(state, parameters, z, np.zeros(3), valid, PERIOD, window)
            c = state["covariance"][0]
            P = np.stack([c[:, [0, 1, 2]], c[:, [1, 3, 4]], c[:, [2, 4, 5]]], axis=1)
            e = x - np.stack([state["angle"][0], state["velocity"][0], state["acceleration"][0]], axis=1)
            nees[k] += np.sum(e * np.linalg.solve(P, e[..., None])[..., 0])
            nis[k] += np.sum(state["normalised_innovation"][0] ** 2)
    samples = 3 * runs
    nees, nis = nees / samples, nis / samples
    late = slice(1, None)
    assert np.all(np.abs(nees[late] - 3.0) < 5 * np.sqrt(6.0 / samples)), nees
    measured = np.array([k not in lost and k > 0 for k in range(ticks)])
    assert np.all(np.abs(nis[measured] - 1.0) < 5 * np.sqrt(2.0 / samples)), nis
    assert abs(nees[late].mean() - 3.0) < 3.5 / np.sqrt(samples)
    assert abs(nis[measured].mean() - 1.0) < 1.0 / np.sqrt(samples)


def test_estimate_downswing_velocity_lags_under_twentieth_of_tick(
    swing: Callable[..., Any],
) -> None:
    """The figures of the module's text: rms and lag of the wrist's velocity in the downswing."""
    s = swing()
    n = len(s.time)
    closed = np.zeros(n, dtype=bool)
    parameters = designed(jitter=(0.0,) * 3)
    track = run(
        sampled(s.angle), np.zeros((n, 3)), np.ones((n, 3), "u1"), np.full(n, PERIOD), closed, parameters
    )
    down = (s.time > 0.75) & (s.time < IMPACT - PERIOD / 2)
    error = track.x[down, :, 1] - s.velocity[down]
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.07)
    lag = -np.polyfit(s.acceleration[down, 2], error[:, 2], 1)[0]
    assert abs(lag) < PERIOD / 20
    # The head moves with the sum of the joints at about 1.09 m: below 0.2 m/s over the last 10 ms.
    last = error[-10:].sum(axis=1) * 1.09
    assert np.abs(last).max() < 0.2


@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5, 0.75])
def test_estimate_impact_velocity_settles_within_three_ticks(swing: Callable[..., Any], phase: float) -> None:
    s = swing(phase)
    n = len(s.time)
    ages, valid, dt = np.zeros((n, 3)), np.ones((n, 3), "u1"), np.full(n, PERIOD)
    parameters = designed(jitter=(0.0,) * 3)
    first = int(np.searchsorted(s.time, IMPACT - 1e-9))

    def error(window: Array) -> Array:
        track = run(sampled(s.angle), ages, valid, dt, window, parameters)
        difference: Array = np.abs(track.x[:, 2, 1] - s.velocity[:, 2])
        return difference

    inside = error(in_window(s.time))
    outside = error(np.zeros(n, dtype=bool))
    assert inside[first + 3 : first + 7].max() < 0.5
    assert outside[first + 2 : first + 7].max() > 1.0
    assert inside[first - 3 : first].max() < 0.5


def test_estimate_compiled_equals_plain(plain: Callable[..., Any]) -> None:
    rng = np.random.default_rng(5)
    parameters = designed()
    by_machine, by_hand = new_record(ESTIMATOR_STATE), new_record(ESTIMATOR_STATE).view(np.recarray)
    plain_estimate = plain(estimate)
    for k in range(300):
        angle = np.array([0.1, 0.2, -0.3]) + rng.normal(0, 1e-3, 3)
        valid = (rng.random(3) > 0.2).astype("u1")
        if k == 150:
            angle[1] = np.nan
        given_values = (angle, rng.uniform(0, 1e-3, 3), valid, rng.uniform(5e-4, 3e-3), bool(k % 7 == 0))
        estimate(by_machine, parameters, *given_values)
        plain_estimate(by_hand, parameters.view(np.recarray), *given_values)
        assert by_machine.tobytes() == by_hand.tobytes()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"jitter": (-1e-6, 0.0, 0.0)}, "jitter"),
        ({"acceleration_change": (0.0, 1.0, 1.0)}, "acceleration_change"),
        ({"velocity_jump": (np.nan, 1.0, 1.0)}, "velocity_jump"),
        ({"noise": (np.inf, 0.0, 0.0)}, "noise"),
    ],
)
def test_design_estimator_invalid_parameter_is_refused(changes: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        designed(**changes)
