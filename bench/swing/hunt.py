"""Hunt's human swing: a 2-handicap golfer as two functions of time.

Source: E. A. Hunt (2002, 2003), quoted in tables 1 and 2 of Meymi, "Modeling and control of parallel
arm golfing robot", KTH 2009. The functions are as printed; `STEP` is ADAMS' cubic smooth step, not the
tanh the thesis takes it for.

Signs and offsets:
- `shoulder_turn` counts from address and is positive in the backswing; a robot following it has
  theta1 = theta1 at address - turn. Table 2 starts its turn at zero again, so the whole swing adds
  the turn at the top: 1.8104 rad at 0.686 s, -0.1571 rad at the end.
- `right_arm_length` is a displacement from Hunt's zero (unpublished): -0.03032 m at address,
  -0.23382 m at the top, negative is shorter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

BACKSWING_DURATION = 0.686
DOWNSWING_DURATION = 0.1667
SWING_DURATION = BACKSWING_DURATION + DOWNSWING_DURATION
DOWNSWING_TURN = 11.8028
"""Speed of the shoulder in the downswing, rad/s."""


def step(t: ArrayLike, t0: float, h0: float, t1: float, h1: float) -> NDArray[np.float64]:
    """Return ADAMS' STEP: h0 before t0, h1 after t1, h0 + (h1 - h0) s^2 (3 - 2 s) between.

    `t` has any shape; ValueError unless t0 < t1.
    """
    if not t0 < t1:
        raise ValueError(f"step: found t0 = {t0}, t1 = {t1}; t0 must lie before t1")
    s = np.clip((np.asarray(t, dtype=float) - t0) / (t1 - t0), 0.0, 1.0)
    return np.asarray(h0 + (h1 - h0) * s**2 * (3.0 - 2.0 * s))


def shoulder_turn(t: ArrayLike) -> NDArray[np.float64]:
    """Return the shoulder turn (rad) at time t (s) from the start of the backswing."""
    t = _inside(t)
    back = np.minimum(t, BACKSWING_DURATION)
    down = np.maximum(t - BACKSWING_DURATION, 0.0)
    return np.asarray(2.639 * back - DOWNSWING_TURN * down)


def right_arm_length(t: ArrayLike) -> NDArray[np.float64]:
    """Return the right arm's displacement (m) at time t (s) from the start of the backswing."""
    t = _inside(t)
    back = step(t, 0.2, 0.0, BACKSWING_DURATION, -0.2035) - 0.03032
    down = step(t - BACKSWING_DURATION, 0.0, 0.0, DOWNSWING_DURATION, 0.2035) - 0.23382
    return np.where(t < BACKSWING_DURATION, back, down)


def _inside(t: ArrayLike) -> NDArray[np.float64]:
    t = np.asarray(t, dtype=float)
    if not np.all((t >= 0.0) & (t <= SWING_DURATION + 1e-9)):
        raise ValueError(
            f"time outside the swing: found {t.min()} … {t.max()} s, expected 0 … {SWING_DURATION} s"
        )
    return t
