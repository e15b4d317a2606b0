"""True state of the plant: motion for the record, and the contact of club and ball."""

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
