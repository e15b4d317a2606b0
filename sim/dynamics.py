"""The plant between events: robot, air, shaft and ground as differential equations, and one step of them.

State vector `y`, `STATES` numbers: three joint angles (rad) and speeds (rad/s), six chamber pressures and
the manifold's (Pa), the head's deflection across the shaft (m) and its rate (m/s), the energy absorbed by
each end stop (J), and the air supplied by the regulator (as m R T, J).

Dry friction is no regularised force, which would let a loaded joint crawl. For the length of a step each
joint has a mode, `slip`: it slides in one direction (+1, -1; friction is then a smooth force) or is held
(0; it has no acceleration, so it stays where it is to the last bit). A held joint is released when its load
exceeds the static bound. If a joint's speed crossed zero within the step, friction acted in the wrong
direction for the rest of it; a bounded impulse corrects that, after which the joint rests or slides back.
This keeps second order through reversals.

Coulomb friction obeys a principle, not a formula: it stops the sliding if its bound allows, otherwise it acts
with its full bound against the sliding (Moreau, "Unilateral contact and dry friction in finite freedom
dynamics", 1988). With coupled joints that is a linear complementarity problem with a symmetric positive
definite matrix, so it has one solution; friction obeying it never adds energy.
"""

from __future__ import annotations

from math import cos, exp, inf, sin, sqrt
from typing import Any

from drivers.base.compiled import compiled, compiled_in_place
from sim.ground import ground_drag
from sim.kane import kane_terms_at, solve_symmetric
from sim.pneumatics import flow, stop_force

STATES = 19
SCRATCH = 6
"""Rows of length `STATES` that `move` works in."""
ANGLES = 5
"""Row of scratch with the last joint angles, their cosines and sines, so that rest needs no new ones."""

Head = tuple[float, float, float, float, float, float]

_WEIGHT = (1.0, 2.0, 2.0, 1.0)
_PART = (0.0, 0.5, 0.5, 1.0)
_FEED_RATIO = 0.3
"""Critical pressure ratio of regulator and dump valve."""
_TURF_DAMPING_SPEED = 5.0
"""Speed at which the turf's damping doubles its spring force (m/s, assumption)."""
_SWEEPS = 500
_CONVERGED = 1e-14


@compiled
def head_geometry(r: Any, p: Any, y: Any) -> Head:
    """Return the face centre's x, y (m), theta_t (rad), vx, vy (m/s), omega (rad/s) from state vector `y`.

    With a flexible shaft the face rides on the deflected head and turns with the shaft's end slope, 1.5
    times deflection over length (cantilever under an end load).
    """
    a1, a2, a3 = y[0], y[0] + y[1], y[0] + y[1] + y[2]
    w1, w2, w3 = y[3], y[3] + y[4], y[3] + y[4] + y[5]
    flex, flex_speed = y[13], y[14]
    x1, y1 = r.l12 * cos(a1), r.l12 * sin(a1)
    x2, y2 = r.l23 * cos(a2), r.l23 * sin(a2)
    c, s = cos(a3), sin(a3)
    x3, y3 = r.l3t * c - flex * s, r.l3t * s + flex * c
    slope = 1.5 / p.head_distance
    return (
        x1 + x2 + x3,
        y1 + y2 + y3,
        a3 + slope * flex,
        -y1 * w1 - y2 * w2 - y3 * w3 - s * flex_speed,
        x1 * w1 + x2 * w2 + x3 * w3 + c * flex_speed,
        w3 + slope * flex_speed,
    )


@compiled
def head_jacobian(r: Any, p: Any, q2: float, q3: float, flex: float) -> Head:
    """Return the motion of the head's mass per joint speed (m): three along the shaft, three across it."""
    along3, across3 = -flex, p.head_distance
    along2, across2 = along3 + r.l23 * sin(q3), across3 + r.l23 * cos(q3)
    along1, across1 = along2 + r.l12 * sin(q2 + q3), across2 + r.l12 * cos(q2 + q3)
    return along1, along2, along3, across1, across2, across3


@compiled
def stop_depth(p: Any, i: int, position: float) -> float:
    """Return the depth (rad, rod m) of joint coordinate i in its upper (+) or lower (-) stop."""
    depth: float = max(position - p.upper[i], 0.0) - max(p.lower[i] - position, 0.0)
    return depth


@compiled
def stop_push(p: Any, i: int, depth: float, speed: float) -> float:
    """Return the end stop's force on joint coordinate i, positive upwards, from `stop_depth`'s depth."""
    if depth > 0.0:
        return -stop_force(p.stop_stiffness[i], p.stop_travel[i], p.stop_damping_speed[i], depth, speed)
    if depth < 0.0:
        return stop_force(p.stop_stiffness[i], p.stop_travel[i], p.stop_damping_speed[i], -depth, -speed)
    return 0.0


@compiled
def _relief(p: Any, k: int, pressure: float) -> float:
    """Return the conductance of chamber k's relief valve, 6: the manifold's.

    It is fully open half a bar above its set pressure.
    """
    leakage: float = p.relief_leakage[k]
    if pressure <= p.relief_pressure[k]:
        return leakage
    opened: float = p.relief_conductance[k] * min((pressure - p.relief_pressure[k]) / 0.5e5, 1.0)
    return max(opened, leakage)


@compiled
def wrist_cylinder(p: Any, sine: float, cosine: float) -> tuple[float, float]:
    """Return coordinate and lever arm (m) of the wrist's cylinder from sine and cosine of theta3.

    Its coordinate is d sin(theta3 + mounting angle), -d cos(beta) of thesis Figure 11.
    """
    return p.lever_cos * sine + p.lever_sin * cosine, p.lever_cos * cosine - p.lever_sin * sine


@compiled_in_place
def chambers(
    p: Any, i: int, y: Any, dy: Any, opening: float, position: float, speed: float, vent: float
) -> tuple[float, float]:
    """Write actuator i's pressure rates; return its force (N, N m) and its supply flow (m' R T, W)."""
    a, b = 6 + 2 * i, 7 + 2 * i
    pa, pb, supply, atmosphere = y[a], y[b], y[12], p.atmosphere
    area_a, area_b, dead = p.area_a[i], p.area_b[i], p.dead_volume[i]
    # Metering edges: P->A with B->R when the opening is positive, mirrored when negative.
    band = p.dead_band[i]
    edge, ratio = p.conductance[i], p.critical_ratio[i]
    edge_a = edge * (p.leakage[i] + min(max((opening - band) / (1.0 - band), 0.0), 1.0))
    edge_b = edge * (p.leakage[i] + min(max((-opening - band) / (1.0 - band), 0.0), 1.0))
    into_a, into_b = flow(edge_a, supply, pa, ratio), flow(edge_b, supply, pb, ratio)
    across = flow(p.cross_leakage[i], pa, pb, ratio)
    # Valve edge, vent and relief valve lead to the same place: one orifice.
    vent_a, vent_b = vent * p.exhaust[2 * i], vent * p.exhaust[2 * i + 1]
    out_a = flow(edge_b + vent_a + _relief(p, 2 * i, pa), pa, atmosphere, ratio)
    out_b = flow(edge_a + vent_b + _relief(p, 2 * i + 1, pb), pb, atmosphere, ratio)
    volume_a = max(dead + area_a * (position - p.volume_lower[i]), 0.2 * dead)
    volume_b = max(dead + area_b * (p.volume_upper[i] - position), 0.2 * dead)
    dy[a] = p.exponent / volume_a * (into_a - across - out_a - pa * area_a * speed)
    dy[b] = p.exponent / volume_b * (into_b + across - out_b + pb * area_b * speed)
    return (pa - atmosphere) * area_a - (pb - atmosphere) * area_b, into_a + into_b


@compiled
def friction_bound(coulomb: float, static: float, stribeck_speed: float, speed: float) -> float:
    """Return the largest dry-friction force at `speed`: Coulomb plus Stribeck's rise towards standstill."""
    relative = speed / stribeck_speed
    squared = relative * relative
    if squared > 40.0:  # below 1e-17 of the rise
        return coulomb
    return coulomb + (static - coulomb) * exp(-squared)


@compiled
def friction_impulse(
    m11: float,
    m12: float,
    m13: float,
    m22: float,
    m23: float,
    m33: float,
    u1: float,
    u2: float,
    u3: float,
    b1: float,
    b2: float,
    b3: float,
) -> tuple[float, float, float]:
    """Return the joint speeds (rad/s) after dry friction has acted on speeds `u`.

    `m` is the mass matrix (kg m2), `b` the bounds of the friction impulses (N m s; inf for a joint that
    stays fixed). A joint that friction stops gets exactly 0.0. Accelerations and forces may stand for
    speeds and impulses. Projected Gauss-Seidel, which converges for such matrices, to rounding.
    """
    # Inverse of the symmetric 3x3 matrix.
    c11, c12, c13 = m22 * m33 - m23 * m23, m13 * m23 - m12 * m33, m12 * m23 - m13 * m22
    determinant = m11 * c11 + m12 * c12 + m13 * c13
    a11, a12, a13 = c11 / determinant, c12 / determinant, c13 / determinant
    a22 = (m11 * m33 - m13 * m13) / determinant
    a23 = (m12 * m13 - m11 * m23) / determinant
    a33 = (m11 * m22 - m12 * m12) / determinant
    p1 = p2 = p3 = 0.0
    for _ in range(_SWEEPS):
        before1, before2, before3 = p1, p2, p3
        p1 = min(max(-(u1 + a12 * p2 + a13 * p3) / a11, -b1), b1)
        p2 = min(max(-(u2 + a12 * p1 + a23 * p3) / a22, -b2), b2)
        p3 = min(max(-(u3 + a13 * p1 + a23 * p2) / a33, -b3), b3)
        change = max(abs(p1 - before1), abs(p2 - before2), abs(p3 - before3))
        if change <= _CONVERGED * max(abs(p1), abs(p2), abs(p3)):
            break
    return (
        0.0 if abs(p1) < b1 else u1 + a11 * p1 + a12 * p2 + a13 * p3,
        0.0 if abs(p2) < b2 else u2 + a12 * p1 + a22 * p2 + a23 * p3,
        0.0 if abs(p3) < b3 else u3 + a13 * p1 + a23 * p2 + a33 * p3,
    )


@compiled_in_place
def _cosine_sine(angles: Any, i: int, angle: float) -> tuple[float, float]:
    """Return cosine and sine of joint i's `angle`, from `angles` if it is the last one."""
    if angles[i] != angle:
        angles[i], angles[3 + i], angles[6 + i] = angle, cos(angle), sin(angle)
    return angles[3 + i], angles[6 + i]


@compiled
def _derivative(
    r: Any,
    p: Any,
    y: Any,
    x1: float,
    x2: float,
    x3: float,
    feed: float,
    vent: float,
    slip: Any,
    dy: Any,
    terms: Any,
    angles: Any,
) -> None:
    """Write dy/dt of `y` into `dy`, and the terms for friction events into `terms`.

    `x` are the spools' openings, `feed` the conductance from the regulator (zero: the manifold is dumped),
    `vent` that of each chamber's vent. `terms`: mass matrix (m11 m12 m13 m22 m23 m33), generalised forces
    without those that hold a joint, bounds of dry friction (N m), the head's motion across a flexible
    shaft per joint speed (m), the actuators' efforts. `angles` is the row ANGLES of scratch.
    """
    q1, q2, q3, u1, u2, u3 = y[0], y[1], y[2], y[3], y[4], y[5]
    flex, flex_speed = y[13], y[14]
    (c1, s1), (c2, s2), (c3, s3) = (
        _cosine_sine(angles, 0, q1),
        _cosine_sine(angles, 1, q2),
        _cosine_sine(angles, 2, q3),
    )
    c12, s12 = c1 * c2 - s1 * s2, s1 * c2 + c1 * s2
    c23, s23 = c2 * c3 - s2 * s3, s2 * c3 + c2 * s3
    c123, s123 = c1 * c23 - s1 * s23, s1 * c23 + c1 * s23
    m11, m12, m13, m22, m23, m33, h1, h2, h3, arm_lever, arm_length = kane_terms_at(
        r, c1, s1, c2, s2, c23, s23, u1, u2, u3
    )

    # Air, viscous friction and stops, each in its actuator's coordinate.
    extension, arm_speed = arm_length - r.l56, arm_lever * u2
    stroke, wrist_lever = wrist_cylinder(p, s3, c3)
    wrist_speed = wrist_lever * u3
    force1, taken1 = chambers(p, 0, y, dy, x1, q1, u1, vent)
    force2, taken2 = chambers(p, 1, y, dy, x2, extension, arm_speed, vent)
    force3, taken3 = chambers(p, 2, y, dy, x3, stroke, wrist_speed, vent)
    stop1 = stop_push(p, 0, stop_depth(p, 0, q1), u1)
    stop2 = stop_push(p, 1, stop_depth(p, 1, extension), arm_speed)
    stop3 = stop_push(p, 2, stop_depth(p, 2, q3), u3)
    f1 = force1 - p.viscous[0] * u1 + stop1 - h1
    f2 = (force2 - p.viscous[1] * arm_speed + stop2) * arm_lever - h2
    f3 = (force3 - p.viscous[2] * wrist_speed) * wrist_lever + stop3 - h3
    # Energy returned in the rebound is not subtracted.
    dy[15], dy[16], dy[17] = max(-stop1 * u1, 0.0), max(-stop2 * arm_speed, 0.0), max(-stop3 * u3, 0.0)
    supply = y[12]
    if feed > 0.0:
        fed = max(flow(feed, p.regulated, supply, _FEED_RATIO), 0.0)
    else:
        fed = -flow(p.dump_conductance * p.exhaust[6], supply, p.atmosphere, _FEED_RATIO)
    relieved = flow(_relief(p, 6, supply), supply, p.atmosphere, _FEED_RATIO)
    dy[12] = p.exponent / p.manifold * (fed - taken1 - taken2 - taken3 - relieved)
    dy[18] = max(fed, 0.0)

    # Dry friction of sliding joints.
    bound1 = friction_bound(p.coulomb[0], p.static[0], p.stribeck_speed[0], u1)
    bound2 = abs(arm_lever) * friction_bound(p.coulomb[1], p.static[1], p.stribeck_speed[1], arm_speed)
    bound3 = abs(wrist_lever) * friction_bound(p.coulomb[2], p.static[2], p.stribeck_speed[2], wrist_speed)
    f1 -= slip[0] * bound1
    f2 -= slip[1] * bound2
    f3 -= slip[2] * bound3

    # The ground pushes the head up, and a surface drags at the sole; `kick` is what both do across the shaft.
    push = kick = 0.0
    depth = p.ground + p.sole_depth - (r.l12 * s1 + r.l23 * s12 + r.l3t * s123 + c123 * flex)
    if depth > 0.0:
        x3t = r.l3t * c123 - s123 * flex
        x2t = x3t + r.l23 * c12
        x1t = x2t + r.l12 * c1
        push = stop_force(
            p.ground_stiffness,
            inf,
            _TURF_DAMPING_SPEED,
            depth,
            -(x1t * u1 + x2t * u2 + x3t * u3 + c123 * flex_speed),
        )
        f1 += x1t * push
        f2 += x2t * push
        f3 += x3t * push
        kick = c123 * push
        if p.ground_friction > 0.0:
            # The sole's way along the ground per joint speed: less the joint's height over it.
            y3t = p.sole_depth - r.l3t * s123 - c123 * flex
            y2t = y3t - r.l23 * s12
            y1t = y2t - r.l12 * s1
            bend = 1.5 / p.head_distance * p.sole_depth - s123
            drag = ground_drag(p, push, depth, y1t * u1 + y2t * u2 + y3t * u3 + bend * flex_speed)
            f1 += y1t * drag
            f2 += y2t * drag
            f3 += y3t * drag
            kick += bend * drag

    across1 = across2 = across3 = across_force = 0.0
    if p.flexible:
        # Head of mass m: its equation across the shaft is solved for the deflection's acceleration and
        # put into those of the joints, which then carry the head along the shaft only.
        mass = p.head_mass
        along1, along2, along3, across1, across2, across3 = head_jacobian(r, p, q2, q3, flex)
        w1, w2, w3 = u1 * u1, (u1 + u2) * (u1 + u2), u1 + u2 + u3
        along_bias = -w1 * r.l12 * c23 - w2 * r.l23 * c3 - w3 * w3 * p.head_distance
        along_bias += r.gravity * s123 - 2.0 * w3 * flex_speed
        across_bias = w1 * r.l12 * s23 + w2 * r.l23 * s3 - w3 * w3 * flex + r.gravity * c123
        spring = p.head_stiffness * flex + p.head_damping * flex_speed - kick
        across_force = -spring - mass * across_bias
        m11 += mass * along1 * along1
        m12 += mass * along1 * along2
        m13 += mass * along1 * along3
        m22 += mass * along2 * along2
        m23 += mass * along2 * along3
        m33 += mass * along3 * along3
        f1 += across1 * spring - mass * along1 * along_bias
        f2 += across2 * spring - mass * along2 * along_bias
        f3 += across3 * spring - mass * along3 * along_bias

    terms[0], terms[1], terms[2], terms[3], terms[4], terms[5] = m11, m12, m13, m22, m23, m33
    terms[6], terms[7], terms[8] = f1, f2, f3
    terms[9], terms[10], terms[11] = bound1, bound2, bound3
    terms[12], terms[13], terms[14] = across1, across2, across3
    terms[15], terms[16], terms[17] = force1, force2, force3 * wrist_lever

    # A held joint's friction is the force that keeps it at rest.
    if slip[0] == 0.0:
        m12 = m13 = f1 = 0.0
    if slip[1] == 0.0:
        m12 = m23 = f2 = 0.0
    if slip[2] == 0.0:
        m13 = m23 = f3 = 0.0
    a1, a2, a3 = solve_symmetric(m11, m12, m13, m22, m23, m33, f1, f2, f3)
    dy[0], dy[1], dy[2], dy[3], dy[4], dy[5] = u1, u2, u3, a1, a2, a3
    dy[13] = dy[14] = 0.0
    if p.flexible:
        dy[13] = flex_speed
        dy[14] = across_force / p.head_mass - across1 * a1 - across2 * a2 - across3 * a3


@compiled
def _release(terms: Any, dy: Any, slip: Any) -> bool:
    """Set `slip` of the held joints whose load exceeds their static friction; return whether any did."""
    m11, m12, m13, m22, m23, m33 = terms[0], terms[1], terms[2], terms[3], terms[4], terms[5]
    f1, f2, f3 = terms[6], terms[7], terms[8]
    a1, a2, a3 = dy[3], dy[4], dy[5]
    bound1 = terms[9] if slip[0] == 0.0 else 0.0
    bound2 = terms[10] if slip[1] == 0.0 else 0.0
    bound3 = terms[11] if slip[2] == 0.0 else 0.0
    if (
        (slip[0] != 0.0 or abs(m11 * a1 + m12 * a2 + m13 * a3 - f1) <= bound1)
        and (slip[1] != 0.0 or abs(m12 * a1 + m22 * a2 + m23 * a3 - f2) <= bound2)
        and (slip[2] != 0.0 or abs(m13 * a1 + m23 * a2 + m33 * a3 - f3) <= bound3)
    ):
        return False
    # Which joints move in which direction: the same problem as for impulses, one derivative higher.
    a1, a2, a3 = solve_symmetric(m11, m12, m13, m22, m23, m33, f1, f2, f3)
    a1, a2, a3 = friction_impulse(m11, m12, m13, m22, m23, m33, a1, a2, a3, bound1, bound2, bound3)
    slip[0] = _sign(a1) if slip[0] == 0.0 else slip[0]
    slip[1] = _sign(a2) if slip[1] == 0.0 else slip[1]
    slip[2] = _sign(a3) if slip[2] == 0.0 else slip[2]
    return True


@compiled
def _sign(value: float) -> float:
    return 1.0 if value > 0.0 else (-1.0 if value < 0.0 else 0.0)


@compiled
def _wrong_impulse(slip: float, before: float, after: float, bound: float, interval: float) -> float:
    """Return the maximum impulse (N m s) by which friction can correct a joint that reversed."""
    if slip == 0.0:
        return inf
    if slip * after >= 0.0:
        return 0.0
    return 2.0 * bound * interval * abs(after) / (abs(before) + abs(after))


@compiled
def _turn_round(y: Any, out: Any, slip: Any, terms: Any, interval: float) -> None:
    """Correct the speeds in `out` of joints whose speed crossed zero since `y`."""
    if slip[0] * out[3] >= 0.0 and slip[1] * out[4] >= 0.0 and slip[2] * out[5] >= 0.0:
        return
    u1, u2, u3 = friction_impulse(
        terms[0],
        terms[1],
        terms[2],
        terms[3],
        terms[4],
        terms[5],
        out[3],
        out[4],
        out[5],
        _wrong_impulse(slip[0], y[3], out[3], terms[9], interval),
        _wrong_impulse(slip[1], y[4], out[4], terms[10], interval),
        _wrong_impulse(slip[2], y[5], out[5], terms[11], interval),
    )
    # The head does not feel the joints' friction: across a flexible shaft it keeps its own speed.
    out[14] -= terms[12] * (u1 - out[3]) + terms[13] * (u2 - out[4]) + terms[14] * (u3 - out[5])
    out[3], out[4], out[5] = u1, u2, u3


@compiled
def _between(nodes: Any, i: int, part: float) -> float:
    """Return opening i at `part` (0..1) of a substep: the parabola through its three `nodes`."""
    start, middle, end = nodes[0, i], nodes[1, i], nodes[2, i]
    opening: float = (
        start * (1.0 - part) * (1.0 - 2.0 * part)
        + middle * 4.0 * part * (1.0 - part)
        + end * part * (2.0 * part - 1.0)
    )
    return opening


@compiled
def move(
    r: Any,
    p: Any,
    y: Any,
    nodes: Any,
    begin: float,
    end: float,
    step: float,
    feed: float,
    vent: float,
    scratch: Any,
    out: Any,
) -> None:
    """Write into `out` the state after the part begin..end (0..1) of a substep of `step` s from `y`.

    Runge-Kutta of fourth order. `nodes` (3, 3) are the spools' openings at start, middle and end of the
    substep; `feed`, `vent` as in `_derivative`; `scratch` (SCRATCH, STATES) is work space, NaN in
    row ANGLES at first, that afterwards holds the actuators' efforts at the end of row 4.
    """
    point, dy, total, slip, terms = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    angles = scratch[ANGLES]
    interval = (end - begin) * step
    for i in range(3):
        slip[i] = _sign(y[3 + i])
    for k in range(STATES):
        point[k], total[k] = y[k], 0.0
    for stage in range(4):
        at = begin + _PART[stage] * (end - begin)
        x1, x2, x3 = _between(nodes, 0, at), _between(nodes, 1, at), _between(nodes, 2, at)
        _derivative(r, p, point, x1, x2, x3, feed, vent, slip, dy, terms, angles)
        if stage == 0 and slip[0] * slip[1] * slip[2] == 0.0 and _release(terms, dy, slip):
            _derivative(r, p, point, x1, x2, x3, feed, vent, slip, dy, terms, angles)
        ahead = interval if stage == 2 else 0.5 * interval
        for k in range(STATES):
            total[k] += _WEIGHT[stage] * dy[k]
            point[k] = y[k] + ahead * dy[k]
    for k in range(STATES):
        out[k] = y[k] + interval / 6.0 * total[k]
    _turn_round(y, out, slip, terms, interval)


@compiled
def stop_coordinate(r: Any, y: Any, i: int) -> float:
    """Return the coordinate that stop i limits: theta1 (rad), the rod's extension (m), theta3 (rad)."""
    if i != 1:
        angle: float = y[i]
        return angle
    x, h = r.l62 + r.l23 * cos(y[1]), r.l23 * sin(y[1])
    return sqrt(x * x + h * h) - float(r.l56)
