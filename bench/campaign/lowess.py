"""Locally weighted scatterplot smoothing (Cleveland 1979): a curve through points, outliers discounted."""

from __future__ import annotations

import numpy as np

from bench.campaign.block_model import Array


def lowess(x: Array, y: Array, at: Array, share: float, passes: int = 3) -> Array:
    """Return the smoothed y at `at` (rising) of points x (n,), y (n,), x rising.

    Each value is that of a line through the nearest `share` of the points, weighted by distance; `passes`
    more fits discount points that lie off the curve.
    """
    near = max(int(share * len(x) + 1e-10), 2)
    trust = np.ones(len(x))
    curve = _fit(x, y, at, near, trust)
    for _ in range(passes):
        off = np.abs(y - np.interp(x, at, curve))
        scale = 6.0 * float(np.median(off))
        if scale == 0.0:
            break
        trust = np.clip(1.0 - (off / scale) ** 2, 0.0, None) ** 2
        curve = _fit(x, y, at, near, trust)
    return curve


def _fit(x: Array, y: Array, at: Array, near: int, trust: Array) -> Array:
    """Return at each of `at` the value of the line through the `near` nearest points."""
    curve = np.empty(len(at))
    for index, place in enumerate(at):
        distance = np.abs(x - place)
        reach = np.partition(distance, near - 1)[near - 1]
        weight = trust * np.clip(1.0 - (distance / max(reach, 1e-300)) ** 3, 0.0, None) ** 3
        total = weight.sum()
        if total == 0.0:  # only points that are discounted: as if they were not
            weight = (distance <= reach).astype(float)
            total = weight.sum()
        weight = weight / total
        middle = weight @ x
        spread = weight @ (x - middle) ** 2
        slope = weight @ ((x - middle) * y) / spread if spread > 1e-12 * (x[-1] - x[0]) ** 2 else 0.0
        curve[index] = weight @ y + slope * (place - middle)
    return curve
