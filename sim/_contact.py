"""Contact of ball and club face: springs along and across the face, with Coulomb friction.

The lumped model of oblique impact with compliance: N. Maw, J. R. Barber and J. N. Fawcett, Wear 38 (1976)
101; W. J. Stronge, *Impact Mechanics*, 2000, chapter 5; for golf S. H. Johnson and B. B. Lieberman, Science
and Golf II, 1994, and PING's engineers, Proceedings 49 (2020) 27; with damping S. W. Biber, A. R. Champneys
and R. Szalai, IMA J. Appl. Math. 88 (2023) 498.

Along the normal a spring gives back the share e^2 of the energy it took. Across it a spring with a dashpot is
wound up while the contact sticks; friction limits its force, so that the contact slides first (steep loft),
sticks, and always slides at the end. A ball struck at small spin loft leaves with less than rolling spin, at
25 to 45 degrees with more; beyond that it slides throughout.
"""

from __future__ import annotations

from math import pi, sqrt

from drivers.base.compiled import compiled
from sim.vectors import Vector, added, dot, norm, scaled

STEPS = 200
"""Integration steps of the compression: impulses within 2 per mille of the exact ones (tests)."""
_MAX_STEPS = 40 * STEPS
"""Steps after which a contact is taken as ended; usual is 2 STEPS."""


@compiled
def contact_impulse(
    response: tuple[Vector, Vector, Vector],
    face: Vector,
    normal: Vector,
    restitution: float,
    friction: float,
    stiffness: float,
    loss: float,
) -> Vector:
    """Return the impulse on the ball (N s) of a contact with compliance.

    `response` holds the columns of the symmetric matrix that maps an impulse on the ball (N s) to the change
    of the contact's velocity, ball less head (m/s); `face` is the velocity (m/s) of the face against the
    resting ball, `normal` the unit vector out of the face. `stiffness` is that across the face over that
    along the normal, `loss` the loss factor of the former at the contact's own frequency. The normal
    stiffness itself does not matter. Energy is never gained.
    """
    first, second, third = response
    zero = (0.0, 0.0, 0.0)
    along = (dot(first, normal), dot(second, normal), dot(third, normal))
    frequency = sqrt(dot(along, normal))  # of a normal spring of 1 N/m, rad/s
    step = pi / 2.0 / frequency / STEPS
    lag = loss / frequency
    velocity = scaled(-1.0, face)
    impulse, wound = zero, zero
    depth, unloaded, gain = 0.0, 0.0, 1.0
    loading = True
    ahead = 0.5 * step  # depth and winding are taken in the middle of a step
    for _ in range(_MAX_STEPS):
        speed = dot(velocity, normal)
        depth -= 0.5 * step * speed
        pressure = gain * (depth - unloaded)
        if pressure <= 0.0:
            break
        slip = added(velocity, -speed, normal)
        shear, wound, slides = _sheared(wound, slip, ahead, stiffness, lag, friction * pressure)
        push = added(scaled(step * pressure, normal), -step, shear)
        impulse = added(impulse, 1.0, push)
        velocity = added(velocity, 1.0, _mapped(first, second, third, push))
        speed = dot(velocity, normal)
        depth -= 0.5 * step * speed
        if slides:
            ahead = step
        else:
            wound = added(wound, 0.5 * step, added(velocity, -speed, normal))
            ahead = 0.5 * step
        if loading and speed >= 0.0:
            loading = False
            gain = 1.0 / (restitution * restitution)
            unloaded = depth * (1.0 - 1.0 / gain)
            step *= restitution
            ahead *= restitution
    return _without_gain(impulse, _mapped(first, second, third, impulse), face)


@compiled
def _sheared(
    wound: Vector, slip: Vector, time: float, stiffness: float, lag: float, limit: float
) -> tuple[Vector, Vector, bool]:
    """Return the force across the face, the winding of its spring and whether the contact slides.

    `wound` is from `time` before; a sliding spring and dashpot move as the force, limited to `limit`, makes
    them.
    """
    trial = added(wound, time, slip)
    shear = scaled(stiffness, added(trial, lag, slip))
    size = norm(shear)
    if size <= limit:
        return shear, trial, False
    shear = scaled(limit / size, shear)
    slow = lag / time
    return shear, scaled(1.0 / (1.0 + slow), added(scaled(slow, wound), 1.0 / stiffness, shear)), True


@compiled
def _without_gain(impulse: Vector, change: Vector, face: Vector) -> Vector:
    """Return `impulse`, which makes `change` of velocity, less what its steps added where little is lost."""
    work = 0.5 * dot(impulse, change) - dot(impulse, face)
    if work > 0.0:
        impulse = scaled(2.0 * dot(impulse, face) / dot(impulse, change), impulse)
    return impulse


@compiled
def _mapped(first: Vector, second: Vector, third: Vector, v: Vector) -> Vector:
    return added(added(scaled(v[0], first), v[1], second), v[2], third)
