"""What the plant reports: sensor readings, its true state for the record, and the contact of club and ball.

Random numbers come from a stream that a record carries: the same seed gives the same run, compiled or not.
"""

from __future__ import annotations

from math import cos, floor, log, pi, sqrt
from typing import Any, NamedTuple

import numpy as np

from drivers.base import ABSENT, Launch
from drivers.base.compiled import compiled
from sim.impact import Delivery, delivery_from_plane, launch_from_motion
from sim.robot import RobotParameters
from sim.vectors import Vector

HISTORY = 64
"""Substeps of joint angles stored for the encoders' latency."""
_SPOOL_NOISE = 0.005
"""Largest error of the spools' feedback, share of the full opening."""


@compiled
def uniform(s: Any) -> float:
    """Return the next random number in (0, 1) of the stream `s.random` (xorshift64, Marsaglia 2003)."""
    z = s.random
    z = z ^ (z << np.uint64(13))
    z = z ^ (z >> np.uint64(7))
    z = z ^ (z << np.uint64(17))
    s.random = z
    return (float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0


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


@compiled
def note_truth(plant_state: Any, cycle: Any) -> None:
    """Write the true state in PLANT_STATE into the fields `plant_*` of a CYCLE record."""
    s, out = plant_state[0], cycle[0]
    for i in range(3):
        out.plant_angle[i], out.plant_velocity[i], out.plant_effort[i] = s.angle[i], s.speed[i], s.effort[i]
    for i in range(6):
        out.plant_pressure[i] = s.pressure[i]
    out.plant_head_position[0], out.plant_head_position[1] = s.head[0], s.head[1]
    out.plant_head_speed = sqrt(s.head[3] * s.head[3] + s.head[4] * s.head[4])


class Contact(NamedTuple):
    """State of club and ball at contact: club in the swing plane, ball in the golf frame."""

    time: float
    """Time on the plant's clock, s."""
    head: Vector
    """Face centre x, y (m) and theta_t (rad)."""
    head_velocity: Vector
    """Velocity of the face centre, m/s, m/s, rad/s."""
    ball_velocity: Vector
    """Velocity of the ball, m/s."""
    ball_spin: Vector
    """Spin of the ball, rad/s."""

    @property
    def launch(self) -> Launch:
        """Launch as reported by a launch monitor."""
        return launch_from_motion(self.ball_velocity, self.ball_spin)

    def delivery(self, robot: RobotParameters, ball_position: tuple[float, float]) -> Delivery:
        """Return the delivery of `robot`'s club to the ball at `ball_position` (m, in the swing plane)."""
        return delivery_from_plane(self.head, self.head_velocity, ball_position, robot.club, robot.lie)


def contact_in(plant_state: Any) -> Contact | None:
    """Return the contact since the ball was last put on the tee, None if it was not struck."""
    if not plant_state["struck"][0]:
        return None
    x, y, theta, vx, vy, omega = plant_state["impact_head"][0].tolist()
    v1, v2, v3 = plant_state["ball_velocity"][0].tolist()
    w1, w2, w3 = plant_state["ball_spin"][0].tolist()
    time = float(plant_state["impact_time"][0])
    return Contact(time, (x, y, theta), (vx, vy, omega), (v1, v2, v3), (w1, w2, w3))
