"""What only the plant knows: its true motion for the record, and how club and ball met."""

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

from drivers.base import Launch
from drivers.base.compiled import compiled
from sim.impact import Delivery, delivery_from_plane, launch_from_motion
from sim.robot import RobotParameters
from sim.vectors import Vector


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
    """Club and ball at contact, found between ticks: club in the swing plane, ball in the golf frame."""

    time: float
    """s on the plant's clock."""
    head: Vector
    """x, y (m) and theta_t (rad) of the face centre."""
    head_velocity: Vector
    """m/s, m/s, rad/s."""
    ball_velocity: Vector
    """m/s."""
    ball_spin: Vector
    """rad/s."""

    @property
    def launch(self) -> Launch:
        """What a launch monitor would report."""
        return launch_from_motion(self.ball_velocity, self.ball_spin)

    def delivery(self, robot: RobotParameters, ball_position: tuple[float, float]) -> Delivery:
        """Return how the club of `robot` came to the ball at `ball_position` (m, in the swing plane)."""
        return delivery_from_plane(self.head, self.head_velocity, ball_position, robot.club, robot.lie)


def contact_in(plant_state: Any) -> Contact | None:
    """Return the contact since the ball was last put on the tee, None when it was not struck."""
    if not plant_state["struck"][0]:
        return None
    x, y, theta, vx, vy, omega = plant_state["impact_head"][0].tolist()
    v1, v2, v3 = plant_state["ball_velocity"][0].tolist()
    w1, w2, w3 = plant_state["ball_spin"][0].tolist()
    time = float(plant_state["impact_time"][0])
    return Contact(time, (x, y, theta), (vx, vy, omega), (v1, v2, v3), (w1, w2, w3))
