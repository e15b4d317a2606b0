"""Watch over the supply manifold: its pressure must fall once the supply is shut, and not faster than it can.

Two bounds, by ISO 6358, with the assumed manifold and dump valve:

- With the supply shut, one falls from the pressure at which it was shut, through a dump valve that passes a
  quarter of the assumed flow. Above it the supply valve did not shut, the dump valve did not open, or the
  sensor is frozen.
- In any tick, one falls from the highest reading, through a dump valve that passes three times as much.
  A lower reading is a sensor fault: no manifold empties that fast. Its value then is no proof that the
  manifold is empty, until a later venting was seen to take its time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from drivers.base.compiled import compiled
from sim.pneumatics import flow

MIN_FLOW_SHARE, MAX_FLOW_SHARE = 0.25, 3.0
"""Fractions of the assumed dump valve's flow: silencers clog, and spools still open also take air."""
SHUTTING = 0.3
"""Max closing time of the supply valve (s)."""
MARGIN = 0.3e5
"""Margin between a bound and a violation (Pa): noise, and samples as old as a message."""
LATE, EARLY = 0.1, 0.02
"""Times above and below the bounds that count as a fault (s)."""
PROOF_FROM = 3e5
"""Pressure from which slow venting proves the sensor (Pa)."""
PROOF_TIME = 1.5
"""Time from closing until a venting is over (s)."""
_CHOKED = 0.3
"""Critical pressure ratio of the dump valve."""
_MAX_STEP = 0.02
"""Max tick that shows how fast the pressure fell (s)."""


@compiled
def monitor_manifold(s: Any, p: Any, plant: Any, readings: Any, powered: bool, step: float) -> None:
    """Judge the manifold's sensor `step` s after the last tick, in which the supply was `powered`.

    `plant` is one of PLANT_PARAMETERS.
    """
    m = s.manifold
    shown = readings[0].supply_pressure
    known = bool(p.lowest_pressure <= shown <= p.highest_pressure)  # False with NaN
    fell_too_fast = _is_too_low(s, plant, shown, known, step)
    if powered or s.tick <= 1:
        m.late = m.shut = 0.0
        m.wrong = False
        if known:
            m.start = m.slow = shown
        if s.tick <= 1:  # unknown before
            m.start, m.slow = plant.atmosphere, plant.regulated
    else:
        m.shut += step
        if m.shut > SHUTTING:
            m.slow = _fallen(plant, m.slow, MIN_FLOW_SHARE, step)
        elif known:
            m.slow = max(m.slow, shown)
    if not known:
        return
    above = not powered and shown > max(m.slow + MARGIN, p.vented_pressure)
    m.late = min(m.late + step, LATE) if above else 0.0
    m.wrong = m.late >= LATE
    if fell_too_fast:
        m.unproven, m.excused, m.start = True, False, plant.atmosphere
    elif m.shut > PROOF_TIME and m.start > PROOF_FROM and not above:
        m.unproven = False


@compiled
def _is_too_low(s: Any, plant: Any, shown: float, known: bool, step: float) -> bool:
    """Return whether the pressure `shown` is lower than the manifold's can be after the readings so far.

    Inputs that did not arrive keep their values, and a stalled loop saw none: no fall is judged across that.
    """
    m = s.manifold
    bound = _fallen(plant, m.fast, MAX_FLOW_SHARE, step)
    if not known:
        m.fast = bound
        return False
    if s.encoder_fault != 0 or not s.device_operational or step > _MAX_STEP:
        bound = -np.inf
    # One reading that is too high is no pressure to fall from.
    m.fast = max(bound, min(shown, m.before))
    m.before = shown
    m.early = m.early + step if shown < bound - MARGIN else 0.0
    return bool(m.early >= EARLY)


@compiled
def _fallen(plant: Any, pressure: float, share: float, step: float) -> float:
    """Return `pressure` (Pa) after `step` s through `share` of the dump valve; never below the atmosphere."""
    if not pressure > plant.atmosphere:
        return pressure
    out = flow(share * plant.dump_conductance, pressure, plant.atmosphere, _CHOKED)
    fallen: float = max(pressure - step * plant.exponent / plant.manifold * out, plant.atmosphere)
    return fallen
