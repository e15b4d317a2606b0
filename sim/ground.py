"""The ground: what turf, a mat or a bare floor take from a head that touches them; run of the ball.

Sole. The ground pushes the sole up with a spring that is damped by depth (`sim.pneumatics.stop_force`). On
turf and mats it also drags: dry friction of the push; the ploughing of soil, whose strength acts on the area
that the sole cuts, its width times its depth; and the acceleration of that soil, which grows with the square
of the speed. All three act against the motion of the sole, so the ground gives no energy back but what its
spring stores. Depth is measured in the swing plane. The values are assumptions: no measured force of a golf
head in turf was found. Their order: an undrained root zone has a shear strength of about 20 kPa, and a blade
cut through it meets about five times that; loam weighs 1,600 kg/m3, of which half is taken along at the
head's speed.

Ball. A. R. Penner, "The run of a golf ball", Can. J. Phys. 80 (2002) 931. Turf gives way under the ball,
which acts like a rigid surface leaning back against the ball by theta_c = tilt (v / 18.6 m/s)(phi / 44.4
deg), phi from the vertical; restitution falls with the normal speed; the ball leaves rolling when friction
suffices and sliding otherwise. The constants come from secondary texts, the paper was not at hand; our
extension is only that slip is a vector, so that side spin makes the ball kick sideways. Roll is the least
certain part of a flight: carry is the primary figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import acos, cos, hypot, radians, sin, sqrt
from typing import Annotated, Any, Literal

from drivers.base.compiled import compiled
from drivers.base.ranges import Range, check_ranges
from sim.vectors import Vector, added, cross, dot, norm, scaled, unit

SurfaceName = Literal["none", "turf", "mat"]

_SLIDING = 0.5
"""Speed (m/s) below which the drag fades, so that a resting head is not shaken."""


@dataclass(frozen=True)
class Surface:
    """A surface on which a ball may lie, as the sole meets it."""

    friction: float = 0.0
    """Friction of the sole."""
    strength: float = 0.0
    """Resistance to a cut, Pa."""
    density: float = 0.0
    """Mass that is taken along at the head's speed, kg/m3 of the cut."""
    width: float = 0.05
    """Width of the cut, m: the middle of a sole that is curved from heel to toe."""


SURFACES: dict[SurfaceName, Surface] = {
    "none": Surface(),
    "turf": Surface(friction=0.4, strength=1.0e5, density=800.0),
    "mat": Surface(friction=0.35),
}
"""A bare floor without drag; turf; a mat of artificial turf, which is pressed in but not cut."""


@compiled
def ground_drag(p: Any, push: float, depth: float, speed: float) -> float:
    """Return the force (N) along the ground on a sole at `depth` (m) with `speed` (m/s) along it.

    `push` (N) is the ground's force upwards. The sign is against `speed`.
    """
    size = p.ground_friction * push + (p.ground_strength + p.ground_density * speed * speed) * depth
    force: float = -size * speed / sqrt(speed * speed + _SLIDING * _SLIDING)
    return force


@dataclass(frozen=True)
class Turf:
    """A level surface for the ball; defaults are Penner's for a fairway.

    `rolling_resistance` (assumption) is deceleration over gravity. A value outside its physical range
    raises ValueError.
    """

    name: str = "fairway"
    """Name for reports."""
    friction: Annotated[float, Range(0.0, 2.0, "")] = 0.40
    """Friction of the ball on turf."""
    tilt: Annotated[float, Range(0.0, 0.6, "rad")] = radians(15.4)
    """Lean of the effective surface at 18.6 m/s, 44.4 degrees (rad); smaller on firmer turf."""
    restitution_factor: Annotated[float, Range(0.0, 2.0, "")] = 1.0
    """Factor on Penner's restitution."""
    rolling_resistance: Annotated[float, Range(0.01, 2.0, "(deceleration over gravity)")] = 0.131
    """Deceleration over gravity; assumption for a medium fairway."""

    model = "Penner 2002"

    def __post_init__(self) -> None:
        check_ranges(self)


@compiled
def bounce(
    velocity: Vector, spin: Vector, radius: float, friction: float, tilt: float, factor: float
) -> tuple[Vector, Vector]:
    """Return velocity (m/s) and spin (rad/s) after touching level turf (normal +Y).

    `velocity` must point down. `factor` multiplies Penner's restitution. The ball is a uniform sphere.
    """
    speed = norm(velocity)
    level = unit((velocity[0], 0.0, velocity[2]))
    steepness = acos(min(1.0, -velocity[1] / speed))
    # Never lean beyond the line of flight: the ball must meet the surface from above.
    lean = min(tilt * (speed / 18.6) * (steepness / radians(44.4)), steepness)
    normal = (-sin(lean) * level[0], cos(lean), -sin(lean) * level[2])

    approach = -dot(velocity, normal)
    slip = slip_velocity(velocity, spin, normal, radius)
    normal_impulse = (1.0 + factor * restitution(approach)) * approach
    tangential_impulse = 2.0 / 7.0  # of the slip: stops it, the ball then rolls
    if tangential_impulse * norm(slip) > friction * normal_impulse:
        tangential_impulse = friction * normal_impulse / norm(slip)
    velocity = added(added(velocity, normal_impulse, normal), -tangential_impulse, slip)
    return velocity, added(spin, 2.5 * tangential_impulse / radius, cross(normal, slip))


@compiled
def restitution(speed: float) -> float:
    """Penner's coefficient of restitution of turf at normal `speed` (m/s)."""
    return 0.510 - 0.0375 * speed + 0.000903 * speed * speed if speed < 20.0 else 0.120


@compiled
def slip_velocity(velocity: Vector, spin: Vector, normal: Vector, radius: float) -> Vector:
    """Velocity (m/s) of the ball's lowest point along the surface with unit `normal`."""
    contact = added(velocity, -radius, cross(spin, normal))
    return added(contact, -dot(contact, normal), normal)


@compiled
def roll(
    velocity: Vector, spin: Vector, radius: float, resistance: float, gravity: float
) -> tuple[float, float, float]:
    """Return the roll distance in X and Z (m) and its duration (s).

    It first turns into rolling at once (2/7 of its slip), then slows at `resistance` x `gravity`.
    """
    slip = slip_velocity(velocity, spin, (0.0, 1.0, 0.0), radius)
    rolling = added((velocity[0], 0.0, velocity[2]), -2.0 / 7.0, slip)
    speed = hypot(rolling[0], rolling[2])
    time = speed / (resistance * gravity)
    run = scaled(time / 2.0, rolling)
    return run[0], run[2], time
