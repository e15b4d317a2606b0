"""An encoder that delivered garbage is never left off by whole turns."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
import pytest

from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.estimate.encoder import ENCODER_STATE, FRESH, decode_encoders
from drivers.base.compiled import new_record
from drivers.base.records import READINGS
from tests.bench.control.operating import asked, press, reach
from tests.bench.control.puppet import ADDRESS, COUNTS, Puppet

TURN = 2 * pi
HERE = ADDRESS
"""Where the joints rest (rad): within the travel of all three."""


def parameters() -> Any:
    return Puppet().parameters.encoder


def decoded(counts: np.ndarray[Any, Any], *, indexed: int = 1) -> np.ndarray[Any, Any]:
    """Return the joint angles (n, 3) rad that ticks of 1 ms with `counts` (n, 3) lead to."""
    record, readings, design = new_record(ENCODER_STATE), new_record(READINGS), parameters()
    readings["encoder_valid"], readings["encoder_indexed"] = 1, indexed
    angles = np.empty((len(counts), 3))
    for k, count in enumerate(counts):
        readings["encoder_count"], readings["encoder_time"] = count, 1.0 + 1e-3 * k
        decode_encoders(record, design, readings, 1.0 + 1e-3 * k)
        angles[k] = record["angle"][0]
    assert record["verdict"][0].tolist() == [FRESH] * 3
    return angles


def here(ticks: int) -> np.ndarray[Any, Any]:
    return np.tile(np.round(HERE * COUNTS / TURN).astype(int) % COUNTS, (ticks, 1))


@pytest.mark.parametrize("seconds", [0.02, 0.1, 0.5, 3.0])
def test_decode_encoders_garbage_leaves_no_turn_error(seconds: float) -> None:
    rng = np.random.default_rng(round(1000 * seconds))
    for _ in range(20):
        garbage = rng.integers(0, COUNTS, (round(1000 * seconds), 3))
        angles = decoded(np.vstack([here(10), garbage, here(600)]))
        assert angles[-1] == pytest.approx(HERE, abs=1e-3)


@pytest.mark.parametrize("speed", [-30.0, 30.0])
def test_decode_encoders_spinning_count_returns_to_travel(speed: float) -> None:
    """As a slipping cable or a rotating magnetic field makes it: every single step is plausible."""
    turning = np.round((HERE + speed * 1e-3 * np.arange(1000)[:, None]) * COUNTS / TURN).astype(int) % COUNTS
    angles = decoded(np.vstack([here(10), turning, here(600)]))
    assert angles[-1] == pytest.approx(HERE, abs=1e-3)


def test_decode_encoders_unindexed_count_continues_past_range_end() -> None:
    """Before its index it has no zero, so that only differences mean anything."""
    turning = np.round((HERE + 5e-3 * np.arange(2000)[:, None]) * COUNTS / TURN).astype(int) % COUNTS
    angles = decoded(turning, indexed=0)
    assert angles[-1] - angles[0] == pytest.approx(np.full(3, 5e-3 * 1999), abs=1e-3)


def disturb(puppet: Puppet, turns: float, ticks: int) -> None:
    """Make the shoulder's encoder report `turns` while the robot is at rest, then the truth again."""
    for share in np.linspace(0.0, 1.0, ticks):
        puppet.offset[0] = share * turns * TURN
        puppet.tick()
    puppet.offset[0] = 0.0
    puppet.run(600)


@pytest.mark.parametrize("turns", [1.0, -1.0, 2.0])
def test_reset_after_encoder_turns_keeps_true_angle(turns: float) -> None:
    puppet = reach(State.READY, local_reset=True)
    disturb(puppet, turns, 1500)
    assert puppet.state.estimator["angle"][0] == pytest.approx(ADDRESS, abs=2e-3)
    if puppet.bench is not State.READY:
        press(puppet)
        assert asked(puppet, Request.RESET) is Refusal.NONE
    puppet.run(20)
    assert puppet.state.estimator["angle"][0] == pytest.approx(ADDRESS, abs=2e-3)


def test_home_after_encoder_turns_succeeds() -> None:
    puppet = reach(State.SAFE)
    disturb(puppet, 2.0, 1500)
    if puppet.bench is State.FAULT:
        assert asked(puppet, Request.RESET) is Refusal.NONE
    assert asked(puppet, Request.HOME) is Refusal.NONE
    puppet.run(200)
    assert (puppet.bench, puppet.cause) == (State.READY, Cause.NONE)
