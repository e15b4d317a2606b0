"""Paths over time: gaps, jumps, smoothing, continuation up to the ball. Pure functions, SI units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

Array = NDArray[np.float64]

MAX_GAP = 0.040
"""Max length of a gap in the downswing that is filled (s)."""
_AHEAD = 0.060
"""Duration of the continuation beyond the last frame (s); the filter needs it, the result does not."""


def missing_runs(path: Array) -> list[tuple[int, int]]:
    """Return the gaps of `path` (n, 3) as (first missing frame, first frame after it)."""
    lost = np.isnan(path[:, 0]).astype(int)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], lost, [0]])))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def filled(path: Array, rate: float) -> Array:
    """Return `path` (n, 3) without gaps: cubic up to MAX_GAP, linear beyond, constant at its ends.

    `rate` is the frame rate (Hz). At least four frames must be present.
    """
    seen = np.flatnonzero(~np.isnan(path[:, 0]))
    frames = np.arange(len(path))
    whole = np.column_stack([np.interp(frames, seen, path[seen, i]) for i in range(path.shape[1])])
    curve = CubicSpline(seen, path[seen])
    for first, end in missing_runs(path):
        if first > seen[0] and end - 1 < seen[-1] and end - first <= MAX_GAP * rate:
            whole[first:end] = curve(frames[first:end])
    return whole


def second_differences(path: Array) -> Array:
    """Return the length of the second difference at each frame (m), 0 at ends and beside gaps."""
    found = np.zeros(len(path))
    found[1:-1] = np.nan_to_num(np.linalg.norm(np.diff(path, 2, axis=0), axis=1))
    return found


def smooth(path: Array, rate: float, cutoff: float) -> Array:
    """Return `path` (n, k) through a second-order Butterworth filter, forth and back; `cutoff` in Hz."""
    b, a = butter(2, min(cutoff, 0.4 * rate) / (rate / 2.0))
    smoothed: Array = filtfilt(b, a, path, axis=0, padlen=min(len(path) - 2, int(rate)))
    return smoothed


def continued(path: Array, rate: float, centre: Array | None = None) -> Array:
    """Return `path` (n, 3) with its motion continued, as if there were no ball.

    With a `centre` (3,) its angle and distance in the plane of the last frames are continued, else its
    coordinates: each by a polynomial through the last frames.
    """
    count = int(np.ceil(_AHEAD * rate))
    if centre is None:
        return np.concatenate([path, _polynomial(path, rate, count, 0.080, 3)])
    last = path[-max(int(0.080 * rate), 8) :] - centre
    _, _, axes = np.linalg.svd(last - last.mean(axis=0), full_matrices=False)
    local = last @ axes.T
    angle = np.unwrap(np.arctan2(local[:, 1], local[:, 0]))
    polar = np.column_stack([angle, np.hypot(local[:, 0], local[:, 1]), local[:, 2]])
    ahead = _polynomial(polar, rate, count, 0.015, 2)
    turned = np.column_stack(
        [ahead[:, 1] * np.cos(ahead[:, 0]), ahead[:, 1] * np.sin(ahead[:, 0]), ahead[:, 2]]
    )
    return np.concatenate([path, centre + turned @ axes])


def _polynomial(values: Array, rate: float, count: int, span: float, degree: int) -> Array:
    """Return the next `count` rows of `values`, by least squares over the last `span` (s)."""
    fit = min(max(round(span * rate), degree + 3), len(values))
    at = np.arange(1 - fit, 1) / rate
    next_ = np.arange(1, count + 1) / rate
    found: Array = np.vander(next_, degree + 1) @ np.polyfit(at, values[-fit:], degree)
    return found


def at_times(path: Array, rate: float, start: float, time: Array) -> tuple[Array, Array]:
    """Return values and derivatives of the frames `path` (n, k), the first at `start` (s), at `time` (s)."""
    curve = CubicSpline(start + np.arange(len(path)) / rate, path)
    return curve(time), curve(time, 1)
