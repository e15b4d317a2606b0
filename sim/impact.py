"""Club meets ball: the geometry of delivery, defined here once, and the collision.

Golf frame: X along the target line, Y up, Z to the right of it (X x Y = Z). Everything inside is for a
right-handed golfer, who stands on the -Z side.

Swing plane, tilted so that it makes the angle `lie` with the ground: x0 = X, y0 = (0, sin lie, -cos lie)
up the plane towards the golfer, z0 = (0, cos lie, sin lie). The club turns about z0 only; its shaft points
along (cos theta_t, sin theta_t) in the plane, straight down at theta_t = 3 pi/2. `shaft_lean` is theta_t
less 3 pi/2 in (-pi, pi]: positive with the head ahead of the hands, which adds loft.

Face: unit normal n, h up the face, t from heel to toe (n x h = t), all at the face's geometric centre,
the reference point of every figure here. Soled with the shaft straight down, n = (cos L cos f, sin L,
cos L sin f) with loft L and face angle f; a plane lie above the club's own tips the toe down and n to the
right; then the club turns about z0, which changes loft, face angle and lie together. Bulge and roll turn
n towards the toe and up by the strike's distance over their radii.

Ball: its in-plane position is where the face centre must be for a centred strike. A ball met elsewhere
lies off centre along the line in which the swing plane cuts the face: one in-plane number
(`in_plane_error`, positive up the plane), of which `strike_x` and `strike_y` are projections.

Collision: contact lasts 0.45 ms, in which the shaft takes no part: the head is a free rigid body. A club with
`tangential_stiffness` has the contact of `sim._contact`: springs along and across the face, with friction.
Without it (0), Newton's restitution holds along the normal. The friction impulse is the fraction
`tangential_factor` of the one that would end all slip (the ball rolls at exit, Penner 2001). It is less where
Coulomb friction does not suffice or where it would gain energy. Restitution is that at an approach of 40 m/s
and changes by `restitution_slope` with it. Gear effect needs no formula: it comes from the head's inertia and
the depth of its centre of mass. This also lets the head yield to friction and reduces the spin of Penner's
point mass by about 5 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan2, cos, hypot, isfinite, nan, pi, sin, sqrt
from typing import Any, Literal, TypeAlias

import numpy as np

from drivers.base import Launch
from drivers.base.compiled import compiled, copy_fields, fields, new_record
from sim._contact import contact_impulse
from sim.ball import Ball
from sim.robot import Club
from sim.vectors import Vector, across_flight, added, cross, dot, norm, scaled, unit

Array: TypeAlias = np.ndarray[Any, Any]
Source = Literal["simulated", "encoders+model", "launch monitor"]

Axes = tuple[Vector, Vector, Vector]
"""Unit vectors (n, h, t) of the face: outward normal, up the face, from heel to toe."""

SHAFT_DOWN = 1.5 * pi
"""theta_t of a shaft straight down the swing plane (rad)."""

FACE_HALF_WIDTH, FACE_HALF_HEIGHT = 0.055, 0.030
"""Half axes (m) of an ellipse close to a modern driver's face (assumption)."""

_USUAL = 40.0
"""Approach (m/s) at which a club's restitution is stated."""
_MIN_RESTITUTION = 0.1

IMPACT = np.dtype(
    [
        *fields("f8", "plane_lie club_lie loft face_angle"),
        *fields("f8", "head_mass head_inertia_n head_inertia_h head_inertia_t head_depth"),
        *fields("f8", "bulge_radius roll_radius restitution restitution_slope"),
        *fields("f8", "tangential_factor tangential_stiffness tangential_loss"),
        *fields("f8", "ball_mass ball_radius ball_inertia friction tee_shift"),
    ],
    align=True,
)
"""Parameters of a collision, for compiled code (`impact_parameters`)."""


def impact_parameters(club: Club, ball: Ball, lie: float) -> Array:
    """Return one `IMPACT` record of `club` and `ball` in a swing plane at `lie` (rad) to the ground.

    The head's inertia about the face normal, which a club does not state, is taken equal to the one
    about the heel-toe axis; it matters only for friction off the centre. Restitution and friction are the
    club's times the ball's, restitution at most 1.
    """
    record = new_record(IMPACT)
    copy_fields(record, club, "loft face_angle head_mass head_depth bulge_radius roll_radius tee_shift")
    copy_fields(record, club, "tangential_factor tangential_stiffness tangential_loss")
    for name, value in {
        "plane_lie": lie,
        "club_lie": club.lie,
        "head_inertia_n": club.head_inertia_vertical,
        "head_inertia_h": club.head_inertia_horizontal,
        "head_inertia_t": club.head_inertia_vertical,
        "restitution": min(1.0, club.restitution * ball.restitution_factor),
        "restitution_slope": club.restitution_slope * ball.restitution_factor,
        "ball_mass": ball.mass,
        "ball_radius": ball.radius,
        "ball_inertia": ball.inertia,
        "friction": ball.friction * club.friction_factor,
    }.items():
        record[name] = value
    for name in IMPACT.names or ():
        if not isfinite(found := float(record[name][0])):
            raise ValueError(f"impact: {name} of club {club.name!r} or ball {ball.name!r}: found {found!r}")
    return record


# --- Geometry ---------------------------------------------------------------------------------------


@compiled
def plane_to_golf(x: float, y: float, z: float, lie: float) -> Vector:
    """Return the golf-frame vector of the swing-plane vector x x0 + y y0 + z z0."""
    return (x, y * sin(lie) + z * cos(lie), z * sin(lie) - y * cos(lie))


@compiled
def golf_to_plane(v: Vector, lie: float) -> Vector:
    """Return the components along x0, y0, z0 of a golf-frame vector; inverse of `plane_to_golf`."""
    return (v[0], v[1] * sin(lie) - v[2] * cos(lie), v[1] * cos(lie) + v[2] * sin(lie))


@compiled
def _about_x(v: Vector, angle: float) -> Vector:
    c, s = cos(angle), sin(angle)
    return (v[0], c * v[1] - s * v[2], s * v[1] + c * v[2])


@compiled
def _about_z0(v: Vector, angle: float, lie: float) -> Vector:
    p = golf_to_plane(v, lie)
    c, s = cos(angle), sin(angle)
    return plane_to_golf(c * p[0] - s * p[1], s * p[0] + c * p[1], p[2], lie)


@compiled
def _axes_of(face_angle: float, loft: float, toe_tilt: float) -> Axes:
    """Face axes with n at azimuth `face_angle` and elevation `loft`, turned by `toe_tilt` (toe up)."""
    n = (cos(loft) * cos(face_angle), sin(loft), cos(loft) * sin(face_angle))
    level = (-sin(face_angle), 0.0, cos(face_angle))
    up = cross(level, n)
    c, s = cos(toe_tilt), sin(toe_tilt)
    return n, added(scaled(c, up), -s, level), added(scaled(c, level), s, up)


@compiled
def face_axes(theta_t: float, parameters: Array) -> Axes:
    """Return (n, h, t) at the face centre in the golf frame for a club at `theta_t` (rad)."""
    p = parameters[0]
    turn = theta_t - SHAFT_DOWN
    tip = p.plane_lie - p.club_lie
    n, h, t = _axes_of(p.face_angle, p.loft, 0.0)
    return (
        _about_z0(_about_x(n, tip), turn, p.plane_lie),
        _about_z0(_about_x(h, tip), turn, p.plane_lie),
        _about_z0(_about_x(t, tip), turn, p.plane_lie),
    )


@compiled
def face_gap(x: float, y: float, theta_t: float, ball_x: float, ball_y: float, parameters: Array) -> float:
    """Return how far (m, along the face normal) the ball is ahead of the face; impact is its zero, falling.

    (x, y) is the face centre and (ball_x, ball_y) the ball in the swing plane (m).
    """
    n = face_axes(theta_t, parameters)[0]
    return dot(_ball_ahead(ball_x - x, ball_y - y, parameters), n)


@compiled
def _ball_ahead(x: float, y: float, parameters: Array) -> Vector:
    """Return the ball's position from the face centre (golf frame, m) by `x` and `y` in the plane."""
    location = plane_to_golf(x, y, 0.0, parameters[0].plane_lie)
    return (location[0], location[1], location[2] + parameters[0].tee_shift)


@compiled
def in_plane_error(
    x: float, y: float, theta_t: float, ball_x: float, ball_y: float, parameters: Array
) -> float:
    """Return where along the line 'swing plane cuts face' the ball is met (m from the centre, + up plane).

    Without the tee's shift out of the plane, which no swing can correct.
    """
    lie = parameters[0].plane_lie
    g = _cut(face_axes(theta_t, parameters)[0], lie)
    return dot(plane_to_golf(ball_x - x, ball_y - y, 0.0, lie), g)


@compiled
def _cut(n: Vector, lie: float) -> Vector:
    """Unit vector of the line in which the swing plane cuts the face, pointing up the plane."""
    return unit(cross((0.0, cos(lie), sin(lie)), n))


@compiled
def strike_point(
    x: float, y: float, theta_t: float, ball_x: float, ball_y: float, parameters: Array
) -> tuple[float, float]:
    """Return (strike_x towards the toe, strike_y up the face) in m; arguments as `face_gap`."""
    axes = face_axes(theta_t, parameters)
    if parameters[0].tee_shift != 0.0:
        ahead = _ball_ahead(ball_x - x, ball_y - y, parameters)
        return dot(ahead, axes[2]), dot(ahead, axes[1])
    g = _cut(axes[0], parameters[0].plane_lie)
    error = in_plane_error(x, y, theta_t, ball_x, ball_y, parameters)
    return error * dot(g, axes[2]), error * dot(g, axes[1])


@compiled
def meets_face(strike_x: float, strike_y: float) -> bool:
    """Return whether a strike at (toe, high) m lies on the face; beyond it the club misses the ball."""
    return (strike_x / FACE_HALF_WIDTH) ** 2 + (strike_y / FACE_HALF_HEIGHT) ** 2 <= 1.0


# --- Collision --------------------------------------------------------------------------------------


@compiled
def collide(
    head_velocity: Vector, head_spin: Vector, normal: Vector, arm: Vector, axes: Axes, parameters: Array
) -> tuple[Vector, Vector, Vector, Vector, Vector]:
    """Return (ball velocity, ball spin, impulse on the ball, head velocity, head spin) after the contact.

    The head is free: `head_velocity` (m/s) of its centre of mass, `head_spin` (rad/s), its inertia about
    `axes`; the ball rests. `normal` points out of the face at the contact, `arm` (m) from the head's centre
    of mass to the contact. All vectors in one frame. `parameters` are IMPACT. Impulse in N s; zero when the
    face does not approach the ball.
    """
    p = parameters[0]
    head_inertia = (p.head_inertia_n, p.head_inertia_h, p.head_inertia_t)
    zero = (0.0, 0.0, 0.0)
    face = added(head_velocity, 1.0, cross(head_spin, arm))
    approach = dot(face, normal)
    if approach <= 0.0:
        return zero, zero, zero, head_velocity, head_spin

    # K maps an impulse on the ball to the change of contact velocity, ball less head; it is symmetric.
    inverse_mass = 1.0 / p.ball_mass + 1.0 / p.head_mass
    rolling = p.ball_radius * p.ball_radius / p.ball_inertia
    first = _response((1.0, 0.0, 0.0), normal, arm, axes, head_inertia, inverse_mass, rolling)
    second = _response((0.0, 1.0, 0.0), normal, arm, axes, head_inertia, inverse_mass, rolling)
    third = _response((0.0, 0.0, 1.0), normal, arm, axes, head_inertia, inverse_mass, rolling)
    response = (first, second, third)
    restitution = p.restitution
    if p.restitution_slope != 0.0:
        restitution = min(1.0, max(_MIN_RESTITUTION, restitution + p.restitution_slope * (approach - _USUAL)))
    if p.tangential_stiffness > 0.0:
        impulse = contact_impulse(
            response, face, normal, restitution, p.friction, p.tangential_stiffness, p.tangential_loss
        )
    else:
        impulse = _rolling_share(
            response, face, normal, approach, restitution, p.friction, p.tangential_factor
        )

    ball_spin = scaled(-p.ball_radius / p.ball_inertia, cross(normal, impulse))
    kick = _inverse_inertia(cross(arm, impulse), axes, head_inertia)
    return (
        scaled(1.0 / p.ball_mass, impulse),
        ball_spin,
        impulse,
        added(head_velocity, -1.0 / p.head_mass, impulse),
        added(head_spin, -1.0, kick),
    )


@compiled
def _rolling_share(
    response: tuple[Vector, Vector, Vector],
    face: Vector,
    normal: Vector,
    approach: float,
    restitution: float,
    friction: float,
    tangential_factor: float,
) -> Vector:
    """Return the impulse on the ball whose friction is a share of what makes the ball roll at exit."""
    first, second, third = response
    k_normal = (dot(first, normal), dot(second, normal), dot(third, normal))

    pressing = approach / dot(k_normal, normal)  # normal impulse that ends the approach without friction
    slip_at_rest = added(scaled(-1.0, face), pressing, k_normal)  # after it, and after restitution as well:
    slip = added(slip_at_rest, restitution * pressing, k_normal)
    slip = added(slip, -dot(slip, normal), normal)
    pressing_out = (1.0 + restitution) * pressing

    # `shear` ends the slip and leaves the normal velocity alone; the ball takes a share of it.
    shear = scaled(-1.0, _solved(first, second, third, slip))
    share = tangential_factor
    shear_normal = dot(shear, normal)
    beyond = norm(added(shear, -shear_normal, normal)) - friction * shear_normal
    if share * beyond > friction * pressing_out:  # friction does not suffice: the ball slides throughout
        share = friction * pressing_out / beyond
    work = -dot(shear, slip)
    if work > 0.0:  # the largest share that gains no energy (quadratic in the share)
        loss = (1.0 - restitution * restitution) * pressing * approach
        half = -dot(shear, slip_at_rest)
        share = min(share, (half + sqrt(half * half + work * max(loss, 0.0))) / work)
    return added(scaled(pressing_out, normal), max(share, 0.0), shear)


@compiled
def _response(
    impulse: Vector,
    normal: Vector,
    arm: Vector,
    axes: Axes,
    head_inertia: Vector,
    inverse_mass: float,
    rolling: float,
) -> Vector:
    """Change of the contact's relative velocity (ball less head) that `impulse` on the ball makes."""
    tangential = added(impulse, -dot(impulse, normal), normal)
    change = added(scaled(inverse_mass, impulse), rolling, tangential)
    turn = _inverse_inertia(cross(arm, impulse), axes, head_inertia)
    return added(change, 1.0, cross(turn, arm))


@compiled
def _inverse_inertia(v: Vector, axes: Axes, inertia: Vector) -> Vector:
    n, h, t = axes
    result = scaled(dot(v, n) / inertia[0], n)
    result = added(result, dot(v, h) / inertia[1], h)
    return added(result, dot(v, t) / inertia[2], t)


@compiled
def _solved(a: Vector, b: Vector, c: Vector, right: Vector) -> Vector:
    """Solve (a b c) x = right, a, b, c the columns (Cramer)."""
    bc = cross(b, c)
    determinant = dot(a, bc)
    x, y, z = dot(right, bc), dot(right, cross(c, a)), dot(right, cross(a, b))
    return scaled(1.0 / determinant, (x, y, z))


@compiled
def _collide_at(
    face_velocity: Vector, spin: Vector, axes: Axes, strike_x: float, strike_y: float, parameters: Array
) -> tuple[Vector, Vector, Vector, Vector, Vector, Vector]:
    """`collide` for a face centre moving with `face_velocity`; appends the contact point from that centre."""
    p = parameters[0]
    n, h, t = axes
    slope_x, slope_y = strike_x / p.bulge_radius, strike_y / p.roll_radius
    normal = unit(added(added(n, slope_x, t), slope_y, h))
    sagitta = (strike_x * slope_x + strike_y * slope_y) / 2.0
    contact = added(added(scaled(strike_x, t), strike_y, h), -sagitta, n)
    arm = added(contact, p.head_depth, n)
    velocity = added(face_velocity, -p.head_depth, cross(spin, n))
    result = collide(velocity, spin, normal, arm, axes, parameters)
    return result[0], result[1], result[2], result[3], result[4], contact


@compiled
def impact_in_plane(
    x: float,
    y: float,
    theta_t: float,
    vx: float,
    vy: float,
    omega: float,
    ball_x: float,
    ball_y: float,
    parameters: Array,
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return (ball velocity, ball spin, impulse on the ball, in-plane impulse on the club) at contact.

    (x, y) m and (vx, vy) m/s are the face centre's in the swing plane, `omega` (rad/s) the club's turning
    rate, (ball_x, ball_y) the ball. First three in the golf frame; the last is (x0 N s, y0 N s, moment
    about z0 and the face centre N m s): the opposite impulse, ready for the robot's equations. Its part
    normal to the plane is taken by the bearings.
    """
    lie = parameters[0].plane_lie
    axes = face_axes(theta_t, parameters)
    strike_x, strike_y = strike_point(x, y, theta_t, ball_x, ball_y, parameters)
    ball_velocity, ball_spin, impulse, _, _, contact = _collide_at(
        plane_to_golf(vx, vy, 0.0, lie),
        plane_to_golf(0.0, 0.0, omega, lie),
        axes,
        strike_x,
        strike_y,
        parameters,
    )
    push = golf_to_plane(impulse, lie)
    moment = golf_to_plane(cross(contact, impulse), lie)
    return ball_velocity, ball_spin, impulse, (-push[0], -push[1], -moment[2])


# --- Values at the edge -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Delivery:
    """Club delivery: at contact, at the face's geometric centre, golf frame, SI.

    Angles: `face_angle` positive open (right), `dynamic_loft` above the horizontal, `shaft_lean` positive
    with the head ahead of the hands, `toe_tilt` the heel-toe line's turn about the normal, toe up positive.
    Strike (m): `strike_x` + toe, `strike_y` + high; `in_plane_error` is the number both project, NaN where
    the source has two independent ones. `source` names the origin of the figures.
    """

    velocity: Vector
    face_angle: float
    dynamic_loft: float
    shaft_lean: float = 0.0
    toe_tilt: float = 0.0
    strike_x: float = 0.0
    strike_y: float = 0.0
    in_plane_error: float = float("nan")
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    """Angular velocity of the head (rad/s)."""
    source: Source = "simulated"
    shaft_loft: float = 0.0
    """Part of `dynamic_loft` that the shaft's bend adds (rad), where it is stated."""

    def __post_init__(self) -> None:
        angles = (self.face_angle, self.dynamic_loft, self.shaft_lean, self.toe_tilt, self.shaft_loft)
        for value in (*self.velocity, *self.angular_velocity, *angles, self.strike_x, self.strike_y):
            if not isfinite(value):
                raise ValueError(f"Delivery: found {value!r} in {self!r}, expected finite numbers")
        if not 0.0 < self.speed < 100.0:
            raise ValueError(f"Delivery.speed: found {self.speed:g} m/s, expected above 0 and below 100 m/s")

    @property
    def speed(self) -> float:
        """Speed of the face centre (m/s)."""
        return norm(self.velocity)

    @property
    def attack_angle(self) -> float:
        """Elevation of the velocity (rad, + up)."""
        return atan2(self.velocity[1], hypot(self.velocity[0], self.velocity[2]))

    @property
    def path(self) -> float:
        """Azimuth of the velocity (rad, + in-to-out, to the right)."""
        return atan2(self.velocity[2], self.velocity[0])

    @property
    def axes(self) -> Axes:
        """Face axes (n, h, t) at the centre."""
        return _axes_of(self.face_angle, self.dynamic_loft, self.toe_tilt)

    @property
    def spin_loft(self) -> float:
        """Angle between velocity and face normal in space (rad)."""
        along = dot(self.velocity, self.axes[0])
        return atan2(norm(cross(self.velocity, self.axes[0])), along)


def delivery_from_plane(
    head: tuple[float, float, float],
    velocity: tuple[float, float, float],
    ball_position: tuple[float, float],
    club: Club,
    lie: float,
    source: Source = "simulated",
) -> Delivery:
    """Return the delivery of a head at `head` [x m, y m, theta_t rad] with `velocity` [m/s, m/s, rad/s].

    All in the swing plane at `lie` (rad) to the ground; the pose is that at contact (`face_gap` zero), x
    and y the face centre; `ball_position` (m) is where that would have to be for a centred strike.
    Raises ValueError for a head at rest or a figure that is not finite.
    """
    parameters = impact_parameters(club, Ball(), lie)
    x, y, theta_t = (float(v) for v in head)
    vx, vy, omega = (float(v) for v in velocity)
    ball = (float(ball_position[0]), float(ball_position[1]))
    n, _, t = face_axes(theta_t, parameters)
    face_angle, loft = atan2(n[2], n[0]), asin(max(-1.0, min(1.0, n[1])))
    _, up, level = _axes_of(face_angle, loft, 0.0)
    strike_x, strike_y = strike_point(x, y, theta_t, *ball, parameters)
    return Delivery(
        velocity=plane_to_golf(vx, vy, 0.0, lie),
        face_angle=face_angle,
        dynamic_loft=loft,
        shaft_lean=-((SHAFT_DOWN - theta_t + pi) % (2.0 * pi) - pi),
        toe_tilt=atan2(dot(t, up), dot(t, level)),
        strike_x=strike_x,
        strike_y=strike_y,
        in_plane_error=nan if club.tee_shift else in_plane_error(x, y, theta_t, *ball, parameters),
        angular_velocity=plane_to_golf(0.0, 0.0, omega, lie),
        source=source,
    )


def strike(delivery: Delivery, club: Club, ball: Ball | None = None) -> Launch:
    """Return the launch of `ball` (default `Ball()`) struck by `club`'s head in `delivery`.

    Raises ValueError when the face moves away from the ball, so that nothing is struck.
    """
    parameters = impact_parameters(club, ball or Ball(), club.lie)
    d = delivery
    ball_velocity, ball_spin, impulse, *_ = _collide_at(
        d.velocity, d.angular_velocity, d.axes, d.strike_x, d.strike_y, parameters
    )
    if impulse == (0.0, 0.0, 0.0):
        raise ValueError(f"strike: spin loft is {d.spin_loft:g} rad, so the face moves away from the ball")
    return launch_from_motion(ball_velocity, ball_spin)


def launch_from_motion(velocity: Vector, spin: Vector) -> Launch:
    """Return a monitor's report of a ball with `velocity` (m/s) and `spin` (rad/s), golf frame.

    Spin about the direction of flight (some per mille off centre, none at centre) does nothing
    to the flight in any of our models and is left out.
    """
    azimuth = atan2(velocity[2], velocity[0])
    level = hypot(velocity[0], velocity[2])
    elevation = atan2(velocity[1], level)
    right, up = across_flight(elevation, azimuth)
    back, side = dot(spin, right), 0.0 - dot(spin, up)
    return Launch(sqrt(dot(velocity, velocity)), elevation, azimuth, hypot(back, side), atan2(side, back))
