from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import strategies as st

from bench.control.estimate.encoder import (
    ENCODER_STATE,
    FRESH,
    IMPLAUSIBLE,
    INVALID,
    REPEATED,
    STALE,
    decode_encoders,
    design_encoders,
)
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from tests.sampling import examples

PERIOD = 1e-3
COUNTS = 2**16
TURN = 2.0 * np.pi
RESOLUTION = TURN / COUNTS
ZERO = (100.0, 65_000.0, 32_768.0)
SIGN = (1, -1, 1)
TRAVEL = ((-2.5, 2.5), (np.pi, 1.5 * np.pi), (4.8, TURN))
SPEED = (20.0, 20.0, 60.0)

Array = np.ndarray[Any, Any]


def designed(**changes: Any) -> Array:
    given_values: dict[str, Any] = {
        "counts_per_revolution": COUNTS,
        "zero_count": ZERO,
        "sign": SIGN,
        "travel": TRAVEL,
    }
    parameters = design_encoders(**given_values | changes)
    parameters["max_speed"] = SPEED
    return parameters


def counts(angle: Any) -> Array:
    """The counts of real encoders at `angle` (3,) rad."""
    raw = np.array(ZERO) + np.array(SIGN) * np.asarray(angle) / RESOLUTION
    whole: Array = np.mod(np.round(raw), COUNTS).astype("i8")
    return whole


class Channel:
    """Encoders read tick by tick."""

    def __init__(self, **changes: Any) -> None:
        self.parameters = designed(**changes)
        self.record = new_record(ENCODER_STATE)
        self.readings = new_record(READINGS)
        self.readings["encoder_valid"] = 1

    def take(self, time: float, count: Any, sampled: Any = None, valid: Any = 1) -> Any:
        self.readings["encoder_count"] = count
        self.readings["encoder_time"] = time if sampled is None else sampled
        self.readings["encoder_valid"] = valid
        decode_encoders(self.record, self.parameters, self.readings, time)
        return self.record[0]


@examples(
    15, 50, start=st.tuples(*(st.floats(low, high) for low, high in TRAVEL)), seed=st.integers(0, 2**32 - 1)
)
def test_decode_encoders_motion_in_travel_is_exact_to_half_count(
    start: tuple[float, float, float], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    channel, angle, time = Channel(), np.array(start), 0.0
    low, high = np.array(TRAVEL).T
    for _ in range(100):
        time += PERIOD
        angle = np.clip(angle + rng.uniform(-1, 1, 3) * np.array(SPEED) * PERIOD, low, high)
        state = channel.take(time, counts(angle))
        assert state["verdict"].tolist() == [FRESH] * 3
        assert state["fresh"].tolist() == [1] * 3
        np.testing.assert_allclose(state["angle"], angle, rtol=0, atol=RESOLUTION * 0.5001)


def test_decode_encoders_wrap_around_is_continuous() -> None:
    channel = Channel(zero_count=(0.0, 0.0, 0.0), sign=(1, 1, 1), travel=((-3.0, 3.0),) * 3)
    for k, angle in enumerate(np.linspace(-0.3, 0.3, 61)):
        state = channel.take(k * PERIOD, np.full(3, round(angle / RESOLUTION) % COUNTS))
        assert state["angle"] == pytest.approx(np.full(3, angle), abs=RESOLUTION * 0.51)
    assert np.all(channel.record["unwrapped"] > 0)


def test_decode_encoders_jump_over_max_speed_is_implausible() -> None:
    channel = Channel()
    here = np.array([0.5, 4.0, 6.0])
    channel.take(0.0, counts(here))
    beyond = here + np.array([0.0, 0.0, -(SPEED[2] * PERIOD + 6 * RESOLUTION)])
    state = channel.take(PERIOD, counts(beyond))
    assert state["verdict"].tolist() == [FRESH, FRESH, IMPLAUSIBLE]
    assert state["fresh"].tolist() == [1, 1, 0]
    assert state["rejected"].tolist() == [0, 0, 1]
    assert state["angle"][2] == pytest.approx(6.0, abs=RESOLUTION)
    assert state["age"][2] == pytest.approx(PERIOD)
    possible = here - np.array([0.0, 0.0, 2 * SPEED[2] * PERIOD])
    state = channel.take(2 * PERIOD, counts(possible))
    assert state["verdict"][2] == FRESH
    assert state["rejected"][2] == 0


def test_decode_encoders_jump_of_half_range_is_implausible() -> None:
    channel = Channel()
    first = counts((0.0, 4.0, 6.0))
    channel.take(0.0, first)
    state = channel.take(PERIOD, (first + COUNTS // 2) % COUNTS)
    assert state["verdict"].tolist() == [IMPLAUSIBLE] * 3


@pytest.mark.parametrize("count", [-1, COUNTS, 2**40, -(2**40)])
def test_decode_encoders_count_outside_range_is_implausible(count: int) -> None:
    channel = Channel()
    for time in (0.0, 0.01):  # as the first sample and as a later one
        assert channel.take(time, np.full(3, count))["verdict"].tolist() == [IMPLAUSIBLE] * 3
        channel.take(time + PERIOD, counts((0.0, 4.0, 6.0)))


def test_decode_encoders_after_long_silence_travel_selects_turn() -> None:
    channel = Channel()
    channel.take(0.0, counts((-2.4, 3.2, 4.9)))
    state = channel.take(1.0, counts((2.4, 4.6, 6.2)))
    assert state["verdict"].tolist() == [FRESH] * 3
    assert state["angle"] == pytest.approx([2.4, 4.6, 6.2], abs=RESOLUTION)


def test_decode_encoders_verdict_separates_invalid_repeated_and_stale() -> None:
    channel = Channel()
    good = counts((0.0, 4.0, 6.0))
    channel.take(0.0, good)
    assert channel.take(PERIOD, good, valid=(0, 1, 1))["verdict"].tolist() == [INVALID, FRESH, FRESH]
    state = channel.take(2 * PERIOD, good, sampled=(2 * PERIOD, PERIOD, 0.5 * PERIOD))
    assert state["verdict"].tolist() == [FRESH, REPEATED, REPEATED]
    assert state["age"] == pytest.approx([0.0, PERIOD, PERIOD])
    state = channel.take(0.1, good, sampled=(0.094, 0.097, np.nan))
    assert state["verdict"].tolist() == [STALE, FRESH, STALE]
    assert state["age"][1] == pytest.approx(0.003)
    state = channel.take(0.2, good, sampled=(0.21, 0.2, np.inf))
    assert state["verdict"].tolist() == [STALE, FRESH, STALE]
    assert channel.take(np.nan, good, sampled=0.3)["verdict"].tolist() == [STALE] * 3
    assert state["fresh"].tolist() == [0] * 3


def test_decode_encoders_compiled_equals_plain(plain: Callable[..., Any]) -> None:
    rng = np.random.default_rng(7)
    parameters = designed()
    readings = new_record(READINGS)
    by_machine, by_hand = new_record(ENCODER_STATE), new_record(ENCODER_STATE).view(np.recarray)
    plain_decode = plain(decode_encoders)
    angle, time = np.array([0.0, 4.0, 5.5]), 0.0
    for _ in range(500):
        time += rng.choice([1e-3, 2e-3, 0.3], p=[0.9, 0.09, 0.01])
        angle = angle + rng.normal(0, 0.02, 3)
        readings["encoder_count"] = counts(angle) + rng.choice([0, 5000, 70_000], 3, p=[0.9, 0.05, 0.05])
        readings["encoder_time"] = time - rng.choice([0.0, 1e-3, 2e-2, np.nan], 3, p=[0.8, 0.1, 0.05, 0.05])
        readings["encoder_valid"] = rng.random(3) > 0.05
        decode_encoders(by_machine, parameters, readings, time)
        plain_decode(by_hand, parameters.view(np.recarray), readings.view(np.recarray), time)
        assert by_machine.tobytes() == by_hand.tobytes()


@pytest.mark.parametrize("travel", [(1.0, 0.0), (-4.0, 4.0), (np.nan, 1.0)])
def test_design_encoders_travel_outside_turn_is_refused(travel: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="joint 1: travel"):
        designed(travel=(TRAVEL[0], travel, TRAVEL[2]))
