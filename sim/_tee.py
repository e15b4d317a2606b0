"""Impact in the plant: instant of contact between face and ball, and the impulse on both."""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any

from drivers.base.compiled import compiled
from sim.dynamics import head_geometry, head_jacobian, move
from sim.impact import face_gap, impact_in_plane, meets_face, strike_point
from sim.kane import kane_terms, solve_symmetric

_FACE_REACH = 0.07
"""Max distance of a contact point from the face's centre (m)."""
_GAP_FOUND = 1e-12
_FASTER = 300.0
"""Speed (m/s) that no head reaches."""


@compiled
def _gap(r: Any, p: Any, impact: Any, y: Any) -> float:
    """Return how far the ball is ahead of the face (m); below zero the face has passed it."""
    x, h, theta, _, _, _ = head_geometry(r, p, y)
    return face_gap(x, h, theta, p.ball_x, p.ball_y, impact)


@compiled
def is_near_ball(r: Any, p: Any, y: Any) -> bool:
    """Return whether the face may meet the ball in the tick that begins with `y`."""
    x, h, _, _, _, _ = head_geometry(r, p, y)
    far = _FACE_REACH + 2.0 * _FASTER * p.tick
    return not (x - p.ball_x) ** 2 + (h - p.ball_y) ** 2 > far * far  # so that NaN is near


@compiled
def find_contact(
    r: Any,
    p: Any,
    impact: Any,
    y: Any,
    nodes: Any,
    step: float,
    feed: float,
    vent: float,
    scratch: Any,
    trial: Any,
) -> float:
    """Return the part (0..1) of the substep y..trial at which the face meets the ball; -1.0 if it does not.

    `trial` then becomes the state at contact. Illinois method on partial steps, to 1e-12 m of gap. A face
    misses if only its plane, outside its edge, meets the ball. Other arguments as `sim.dynamics.move`.
    """
    x, h, theta, vx, vy, _ = head_geometry(r, p, trial)
    reach = _FACE_REACH + step * sqrt(vx * vx + vy * vy)
    if (x - p.ball_x) ** 2 + (h - p.ball_y) ** 2 > reach * reach:
        return -1.0
    gap_high, gap_low = face_gap(x, h, theta, p.ball_x, p.ball_y, impact), _gap(r, p, impact, y)
    if gap_high > 0.0 or gap_low <= 0.0:
        return -1.0
    low, high, side, part = 0.0, 1.0, 0, 1.0
    for _ in range(40):
        part = (low * gap_high - high * gap_low) / (gap_high - gap_low)
        move(r, p, y, nodes, 0.0, part, step, feed, vent, scratch, trial)
        gap = _gap(r, p, impact, trial)
        if abs(gap) < _GAP_FOUND:
            break
        if gap > 0.0:
            low, gap_low = part, gap
            gap_high *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            high, gap_high = part, gap
            gap_low *= 0.5 if side == -1 else 1.0
            side = -1
    x, h, theta, _, _, _ = head_geometry(r, p, trial)
    strike_x, strike_y = strike_point(x, h, theta, p.ball_x, p.ball_y, impact)
    if meets_face(strike_x, strike_y):
        return part
    move(r, p, y, nodes, 0.0, 1.0, step, feed, vent, scratch, trial)
    return -1.0


@compiled
def strike_ball(r: Any, p: Any, impact: Any, s: Any, y: Any) -> None:
    """Apply the impact: one impulse on the ball and, reversed, on the robot at state vector `y`.

    The part of the impulse normal to the swing plane is taken by the bearings. In 0.45 ms a flexible
    shaft's spring moves nothing: across the shaft the head alone takes the impulse.
    """
    x, h, theta, vx, vy, omega = head_geometry(r, p, y)
    s.impact_head[0], s.impact_head[1], s.impact_head[2] = x, h, theta
    s.impact_head[3], s.impact_head[4], s.impact_head[5] = vx, vy, omega
    velocity, spin, _, push = impact_in_plane(x, h, theta, vx, vy, omega, p.ball_x, p.ball_y, impact)
    for k in range(3):
        s.ball_velocity[k], s.ball_spin[k], s.impulse[k] = velocity[k], spin[k], push[k]
    s.struck, s.ball_present = True, False

    m11, m12, m13, m22, m23, m33, _, _, _, _ = kane_terms(r, y[0], y[1], y[2], 0.0, 0.0, 0.0)
    a12 = y[0] + y[1]
    x2, h2 = x - r.l12 * cos(y[0]), h - r.l12 * sin(y[0])
    x3, h3 = x2 - r.l23 * cos(a12), h2 - r.l23 * sin(a12)
    j1 = x * push[1] - h * push[0] + push[2]
    j2 = x2 * push[1] - h2 * push[0] + push[2]
    j3 = x3 * push[1] - h3 * push[0] + push[2]
    if not p.flexible:
        d1, d2, d3 = solve_symmetric(m11, m12, m13, m22, m23, m33, j1, j2, j3)
    else:
        # As in sim.dynamics: the head's equation across the shaft is solved first and put into the joints'.
        mass = p.head_mass
        along1, along2, along3, across1, across2, across3 = head_jacobian(r, p, y[1], y[2], y[13])
        a3 = a12 + y[2]
        kick = cos(a3) * push[1] - sin(a3) * push[0] + 1.5 / p.head_distance * push[2]
        d1, d2, d3 = solve_symmetric(
            m11 + mass * along1 * along1,
            m12 + mass * along1 * along2,
            m13 + mass * along1 * along3,
            m22 + mass * along2 * along2,
            m23 + mass * along2 * along3,
            m33 + mass * along3 * along3,
            j1 - across1 * kick,
            j2 - across2 * kick,
            j3 - across3 * kick,
        )
        y[14] += kick / mass - across1 * d1 - across2 * d2 - across3 * d3
    y[3] += d1
    y[4] += d2
    y[5] += d3
