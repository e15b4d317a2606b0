"""Events of a swing: impact by two clues, top by the slowest hands. Pure functions, SI units."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOSS = "loss of head speed"
PLACE = "position at address"
GIVEN = "--events"
_MIN_LOSS = 0.06
"""Min loss of speed at a ball, as a fraction."""
_BEGUN = 0.15
"""Fraction of the loss at which it has begun."""
_STILL = 0.35
"""Max speed of a club that stands at the ball (m/s)."""
_STILL_TIME = 0.050
"""Time over which this speed is measured (s)."""
_NEAR_BALL = 0.3
"""Max distance of the position at address from the path around the fastest frame (m)."""
_SPREAD = 0.012
"""Max time between the two clues that mean one ball (s)."""
_HEAD_FASTEST = 0.080, 0.080
"""Max time of the ball before and after the fastest frame of the head (s)."""
_HANDS_FASTEST = 0.020, 0.200
"""Max time of the ball before and after the fastest frame of the hands (s)."""


class Impact(NamedTuple):
    """Instant of the ball."""

    frame: float
    """Frame and its fraction."""
    clue: str


def find_impact(path: Array, rate: float, *, is_head: bool = True) -> Impact | None:
    """Return where `path` (n, 3; m) meets the ball, None without either clue; hands lose no speed.

    A recording that ends before the ball has neither a loss of speed nor a pass of the address.
    """
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * rate
    steady = np.median(np.stack([speed[:-2], speed[1:-1], speed[2:]]), axis=0)
    fastest = int(np.argmax(steady)) + 1
    before, after = (max(int(t * rate), 2) for t in (_HEAD_FASTEST if is_head else _HANDS_FASTEST))
    rows = range(max(fastest - before, 1), min(fastest + after, len(path) - 1))
    place = _passing(path, fastest, rows, rate)
    loss = _loss(speed, rows, rate) if is_head else None
    if loss is not None and (place is None or abs(loss - place) <= _SPREAD * rate):
        return Impact(loss, LOSS)
    return None if place is None else Impact(place, PLACE)


def _passing(path: Array, fastest: int, rows: range, rate: float) -> float | None:
    """Return the frame in which `path` passes its position at address on its way to the target."""
    over = max(round(_STILL_TIME * rate), 1)
    moved = np.linalg.norm(path[over:] - path[:-over], axis=1)
    still = np.flatnonzero(moved[: max(fastest - over, 0)] < _STILL * _STILL_TIME)
    if not len(rows) or not len(still):
        return None
    # The top is a pause, too, but the way to the ball does not come near it.
    apart = np.linalg.norm(path[still, None] - path[None, rows.start : rows.stop], axis=2).min(axis=1)
    if not (apart < _NEAR_BALL).any():
        return None
    address = np.median(path[still[apart < _NEAR_BALL][-len(rows) :]], axis=0)
    nearest = rows.start + int(np.argmin(np.linalg.norm(path[rows.start : rows.stop] - address, axis=1)))
    along = path[nearest + 1] - path[nearest - 1]
    ahead = (path - address) @ along
    for k in range(max(nearest - 2, 0), min(nearest + 2, len(path) - 1)):
        if ahead[k] < 0.0 <= ahead[k + 1]:
            return float(k + ahead[k] / (ahead[k] - ahead[k + 1]))
    return None


def _loss(speed: Array, rows: range, rate: float) -> float | None:
    """Return the frame (with its fraction) between which `speed` (m/s, per interval) falls at once."""
    few, more = max(2, round(0.008 * rate)), max(3, round(0.020 * rate))
    falls = np.zeros(len(speed))
    for k in range(max(rows.start, few), min(rows.stop, len(speed) - 3)):
        before = float(np.median(speed[k - few : k]))
        fall = before - float(np.median(speed[k + 1 : k + 1 + more]))
        if fall > max(_MIN_LOSS * before, 3.0 * _scatter(speed[max(k - 4 * few, 0) : k])):
            falls[k] = fall
    if not falls.any():
        return None
    most = int(np.argmax(falls))
    before = float(np.median(speed[most - few : most]))
    after = float(np.median(speed[most + 1 : most + 1 + more]))
    first = max(most - 2 * few, few)
    peak = first + int(np.argmax([np.median(speed[k - 1 : k + 2]) for k in range(first, most + 1)]))
    # A marker may take more than one frame to slow down: the ball is where the fall begins.
    scatter = _scatter(speed[max(most - 5 * few, 0) : most])
    low = before - max(_BEGUN * (before - after), min(3.0 * scatter, 0.4 * (before - after)))
    found = peak + int(np.argmax(speed[peak : most + 2] < low))
    before = float(np.median(speed[found - few : found]))
    return found + float(np.clip((speed[found] - after) / (before - after), 0.0, 1.0))


def _scatter(speed: Array) -> float:
    """Return the standard deviation of the noise in `speed` (m/s), by its second differences."""
    return float(np.std(np.diff(speed, 2))) / 2.4 if len(speed) > 4 else 0.0


def find_top(time: Array, speed: Array, shortest: float = 0.10, longest: float = 0.75) -> int | None:
    """Return the row of the slowest hands before the ball, None where they slow down nowhere.

    `time` (s) ends at the ball with 0, `speed` (m/s) is that of the hands or the turning of the club.
    """
    rows = np.flatnonzero((time >= -longest) & (time <= -shortest))
    if len(rows) < 3:
        return None
    row = int(rows[np.argmin(speed[rows])])
    return row if rows[0] < row < rows[-1] else None
