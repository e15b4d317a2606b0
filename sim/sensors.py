"""Sensors of the plant: encoders with latency, jitter, noise and resolution, and the inputs."""

from __future__ import annotations

from math import cos, floor, log, pi, sqrt
from typing import Any

from drivers.base import ABSENT
from drivers.base.compiled import compiled
from sim.random_stream import uniform

HISTORY = 64
"""Substeps of joint angles stored for the encoders' latency."""
_SPOOL_NOISE = 0.005
"""Largest error of the spools' feedback, share of the full opening."""


@compiled
def _normal(s: Any) -> float:
    """Return the next normally distributed number (Box and Muller 1958)."""
    return sqrt(-2.0 * log(uniform(s))) * cos(2.0 * pi * uniform(s))


@compiled
def sense(plant: Any, state: Any, readings: Any) -> None:
    """Write the sensor readings of `state` into `readings` (READINGS), with noise from its random stream."""
    p, s, out = plant[0], state[0], readings[0]
    substep = p.tick / p.substeps
    out.time = s.time
    for i in range(3):
        age = p.latency
        if p.jitter > 0.0:
            age = max(age + p.jitter * _normal(s), 0.0)
        back = min(age / substep, HISTORY - 2.0)
        whole = int(back)
        part = back - whole
        newer = s.history[(s.history_index - whole + HISTORY) % HISTORY, i]
        older = s.history[(s.history_index - whole - 1 + HISTORY) % HISTORY, i]
        angle = newer + part * (older - newer)
        if p.noise > 0.0:
            angle += p.noise * _normal(s)
        count = floor(angle * p.encoder_scale[i] + p.encoder_zero[i])
        if s.encoder_indexed[i] == 0:
            count -= s.encoder_start[i]  # relative to power-up
        out.encoder_count[i] = count % p.encoder_counts
        out.encoder_time[i] = s.time - p.latency
        out.encoder_valid[i] = s.encoder_valid[i]
        out.encoder_age[i] = p.latency
        out.encoder_indexed[i] = s.encoder_indexed[i]
    out.emergency_stop_clear = s.emergency_stop_clear
    out.guard_closed = s.guard_closed
    out.guard_locked = s.guard_locked
    out.supply_pressure = s.supply_pressure
    out.local_reset = s.local_reset
    out.ball_present = s.ball_present
    for k in range(2):
        out.vent_open[k] = float(s.vent_open[k]) if p.vent_feedback else ABSENT
    out.shut_off_open = float(s.shut_off_open) if p.shut_off_feedback else ABSENT
    for i in range(6):
        out.chamber_pressure[i] = s.pressure[i] if p.pressure_sensors else ABSENT
    for i in range(3):
        out.spool_position[i] = ABSENT
        if p.spool_feedback:
            out.spool_position[i] = s.spool[i] + _SPOOL_NOISE * (2.0 * uniform(s) - 1.0)
