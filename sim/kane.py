"""Kane's dynamical equations of the robot, evaluated numerically (thesis section 2.3, Eqs. 11-38).

For each of the five bodies the method needs partial angular velocities, partial velocities of the
centre of mass, and the inertia force and torque; their dot products, summed, are three equations
F_r* + F_r = 0. Here they are evaluated with numbers instead of symbols: hours become 0.1 us
(erratum 11). Vectors are written in frame 1, which turns with the shoulder link, so that theta1
enters through gravity alone.

Generalised speeds u = dq/dt. Effort = [M_A N m on the shoulder link, F_E N along the right arm (positive
pushes R3 away from R6), M_C N m between left arm and club].

Errata corrected: 3 (direction of F_E), 4 (gravity lies in the swing plane and works), 5 (M_C reacts on
the left arm, so it works on u3 only), 6 (body E is written from R6 with the right arm's turning rate
from d l46/d theta2), 7 (dot products: three equations, not nine).
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.base.compiled import compiled
from sim.robot import RobotParameters

Array = NDArray[np.float64]
KaneTerms = tuple[float, float, float, float, float, float, float, float, float, float]
BodyTerms = tuple[float, float, float, float, float]


@compiled
def _body(
    mass: float,
    inertia: float,
    spin_2: float,
    spin_rate: float,
    px: float,
    py: float,
    p2x: float,
    p2y: float,
    ax: float,
    ay: float,
) -> BodyTerms:
    """Return m11, m12, m22, h1, h2 of a body that theta3 does not move.

    `spin_2` is its partial angular velocity for u2 (that of u1 is 1), p its centre of mass in frame 1 and
    p_2 = dp/dtheta2, so that its partial velocities are z x p and p_2. `spin_rate` and `a` are the parts of
    its angular and linear acceleration (less gravity) that remain when du/dt = 0.
    """
    torque_bias = inertia * spin_rate
    return (
        mass * (px * px + py * py) + inertia,
        mass * (px * p2y - py * p2x) + inertia * spin_2,
        mass * (p2x * p2x + p2y * p2y) + inertia * spin_2 * spin_2,
        mass * (px * ay - py * ax) + torque_bias,
        mass * (p2x * ax + p2y * ay) + torque_bias * spin_2,
    )


@compiled
def kane_terms(r: Any, q1: float, q2: float, q3: float, u1: float, u2: float, u3: float) -> KaneTerms:
    """Return (m11, m12, m13, m22, m23, m33, h1, h2, h3, lever) with M du/dt + h = Q.

    `r` is a ROBOT record. h holds the velocity products and gravity. `lever` = d l46/d theta2 (m/rad), so
    Q = (M_A, F_E lever, M_C).
    """
    m11, m12, m13, m22, m23, m33, h1, h2, h3, lever, _ = kane_terms_at(
        r, cos(q1), sin(q1), cos(q2), sin(q2), cos(q2 + q3), sin(q2 + q3), u1, u2, u3
    )
    return m11, m12, m13, m22, m23, m33, h1, h2, h3, lever


@compiled
def kane_terms_at(
    r: Any,
    c1: float,
    s1: float,
    c2: float,
    s2: float,
    c23: float,
    s23: float,
    u1: float,
    u2: float,
    u3: float,
) -> tuple[float, float, float, float, float, float, float, float, float, float, float]:
    """`kane_terms` from cosines and sines of theta1, theta2, theta2 + theta3; appends the arm's l46 (m)."""
    # Gravity taken as an upward acceleration of the frame: minus g along -y0, written in frame 1.
    gx, gy = r.gravity * s1, r.gravity * c1
    u11, w2 = u1 * u1, u1 + u2
    w2w2 = w2 * w2
    w3w3 = (w2 + u3) * (w2 + u3)

    # Right arm, R6 -> R3: unit vector n at angle phi in frame 1, length l46.
    dx, dy = r.l62 + r.l23 * c2, r.l23 * s2
    l46 = sqrt(dx * dx + dy * dy)
    nx, ny = dx / l46, dy / l46
    lever = -r.l62 * r.l23 * s2 / l46
    turn = r.l23 * (r.l62 * c2 + r.l23) / (l46 * l46)  # d phi/d theta2
    turn_slope = lever * (1.0 - 2.0 * turn) / l46
    w_arm = u1 + turn * u2
    arm_rate = turn_slope * u2 * u2

    # A: shoulder link, which u1 alone moves.
    a_11, a_h1 = r.mass_a * (r.com_a * r.com_a) + r.inertia_a, r.mass_a * (r.com_a * gy)
    # B: left arm.
    bx, by = r.com_b * c2, r.com_b * s2
    b_11, b_12, b_22, b_h1, b_h2 = _body(
        r.mass_b, r.inertia_b, 1.0, 0.0,
        r.l12 + bx, by, -by, bx,
        gx - u11 * r.l12 - w2w2 * bx, gy - w2w2 * by,
    )  # fmt: skip
    # C: club; its partial velocity for u3 is z x f.
    ex, ey = r.l23 * c2, r.l23 * s2
    fx, fy = r.com_c * c23, r.com_c * s23
    wrist_ax, wrist_ay = gx - u11 * r.l12 - w2w2 * ex, gy - w2w2 * ey
    cx, cy, c2x, c2y = r.l12 + ex + fx, ey + fy, -ey - fy, ex + fx
    c_ax, c_ay = wrist_ax - w3w3 * fx, wrist_ay - w3w3 * fy
    c_11, c_12, c_22, c_h1, c_h2 = _body(r.mass_c, r.inertia_c, 1.0, 0.0, cx, cy, c2x, c2y, c_ax, c_ay)
    # D: rod, back from R3 along -n. n' = n turned by a right angle.
    d_ax = wrist_ax + r.com_d * (w_arm * w_arm * nx + arm_rate * ny)
    d_ay = wrist_ay + r.com_d * (w_arm * w_arm * ny - arm_rate * nx)
    d_11, d_12, d_22, d_h1, d_h2 = _body(
        r.mass_d, r.inertia_d, turn, arm_rate,
        r.l12 + ex - r.com_d * nx, ey - r.com_d * ny,
        -ey + r.com_d * turn * ny, ex - r.com_d * turn * nx,
        d_ax, d_ay,
    )  # fmt: skip
    # E: cylinder, from R6 along n; its centre of mass does not slide along the arm (erratum 6).
    e_ax = gx + u11 * r.l16 - r.com_e * (w_arm * w_arm * nx + arm_rate * ny)
    e_ay = gy - r.com_e * (w_arm * w_arm * ny - arm_rate * nx)
    e_11, e_12, e_22, e_h1, e_h2 = _body(
        r.mass_e, r.inertia_e, turn, arm_rate,
        -r.l16 + r.com_e * nx, r.com_e * ny,
        -r.com_e * turn * ny, r.com_e * turn * nx,
        e_ax, e_ay,
    )  # fmt: skip
    return (
        a_11 + b_11 + c_11 + d_11 + e_11,
        b_12 + c_12 + d_12 + e_12,
        r.mass_c * (cx * fx + cy * fy) + r.inertia_c,
        b_22 + c_22 + d_22 + e_22,
        r.mass_c * (c2y * fx - c2x * fy) + r.inertia_c,
        r.mass_c * (fx * fx + fy * fy) + r.inertia_c,
        a_h1 + b_h1 + c_h1 + d_h1 + e_h1,
        b_h2 + c_h2 + d_h2 + e_h2,
        r.mass_c * (fx * c_ay - fy * c_ax),
        lever,
        l46,
    )


@compiled
def solve_symmetric(
    m11: float, m12: float, m13: float, m22: float, m23: float, m33: float, f1: float, f2: float, f3: float
) -> tuple[float, float, float]:
    """Return x with M x = f for a symmetric positive definite 3x3 matrix (Cholesky without roots)."""
    l21, l31 = m12 / m11, m13 / m11
    d2 = m22 - l21 * m12
    t32 = m23 - l21 * m13
    l32 = t32 / d2
    d3 = m33 - l31 * m13 - l32 * t32
    y2 = f2 - l21 * f1
    y3 = f3 - l31 * f1 - l32 * y2
    x3 = y3 / d3
    x2 = y2 / d2 - l32 * x3
    return f1 / m11 - l21 * x2 - l31 * x3, x2, x3


@compiled
def accelerations(
    r: Any,
    q1: float,
    q2: float,
    q3: float,
    u1: float,
    u2: float,
    u3: float,
    torque_a: float,
    force_e: float,
    torque_c: float,
) -> tuple[float, float, float]:
    """Return du/dt (rad/s2) as three floats; `r` a ROBOT record, efforts as in the module's text."""
    m11, m12, m13, m22, m23, m33, h1, h2, h3, lever = kane_terms(r, q1, q2, q3, u1, u2, u3)
    return solve_symmetric(m11, m12, m13, m22, m23, m33, torque_a - h1, force_e * lever - h2, torque_c - h3)


@compiled
def _forward_batch(robot: Any, q: Any, u: Any, effort: Any, out: Any) -> None:
    r = robot[0]
    for i in range(q.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = accelerations(
            r, q[i, 0], q[i, 1], q[i, 2], u[i, 0], u[i, 1], u[i, 2], effort[i, 0], effort[i, 1], effort[i, 2]
        )


@compiled
def _terms_batch(robot: Any, q: Any, u: Any, matrix: Any, bias: Any, lever: Any) -> None:
    r = robot[0]
    for i in range(q.shape[0]):
        m11, m12, m13, m22, m23, m33, h1, h2, h3, slope = kane_terms(
            r, q[i, 0], q[i, 1], q[i, 2], u[i, 0], u[i, 1], u[i, 2]
        )
        matrix[i, 0, 0], matrix[i, 0, 1], matrix[i, 0, 2] = m11, m12, m13
        matrix[i, 1, 0], matrix[i, 1, 1], matrix[i, 1, 2] = m12, m22, m23
        matrix[i, 2, 0], matrix[i, 2, 1], matrix[i, 2, 2] = m13, m23, m33
        bias[i, 0], bias[i, 1], bias[i, 2] = h1, h2, h3
        lever[i] = slope


def _rows(*arrays: ArrayLike) -> tuple[tuple[int, ...], list[Array]]:
    """Broadcast (..., 3) arrays together; return the common shape and contiguous (n, 3) copies."""
    common = np.broadcast_arrays(*(np.asarray(array, dtype=float) for array in arrays))
    shape = common[0].shape
    if not shape or shape[-1] != 3:
        raise ValueError(f"last axis is {shape[-1:] or 'absent'}, expected 3 (shoulder, arm, wrist)")
    return shape, [np.ascontiguousarray(array).reshape(-1, 3) for array in common]


def _terms(robot: RobotParameters, q: ArrayLike, u: ArrayLike) -> tuple[tuple[int, ...], Array, Array, Array]:
    shape, (q_rows, u_rows) = _rows(q, u)
    n = len(q_rows)
    matrix, bias, lever = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty(n)
    _terms_batch(robot.record, q_rows, u_rows, matrix, bias, lever)
    return shape, matrix, bias, lever


def mass_matrix(robot: RobotParameters, q: ArrayLike) -> Array:
    """Return the mass matrix (kg m2) at `q`; shape (..., 3, 3) for q of shape (..., 3)."""
    shape, matrix, _, _ = _terms(robot, q, np.zeros(3))
    return matrix.reshape(*shape, 3)


def bias_forces(robot: RobotParameters, q: ArrayLike, u: ArrayLike) -> Array:
    """Return velocity-product and gravity forces h of M du/dt + h = Q (N m); shape (..., 3)."""
    shape, _, bias, _ = _terms(robot, q, u)
    return bias.reshape(shape)


def forward_dynamics(robot: RobotParameters, q: ArrayLike, u: ArrayLike, effort: ArrayLike) -> Array:
    """Return du/dt (rad/s2) for `effort` = [M_A N m, F_E N, M_C N m]; shapes (3,) or (..., 3)."""
    shape, (q_rows, u_rows, effort_rows) = _rows(q, u, effort)
    out = np.empty_like(q_rows)
    _forward_batch(robot.record, q_rows, u_rows, effort_rows, out)
    return out.reshape(shape)


def inverse_dynamics(robot: RobotParameters, q: ArrayLike, u: ArrayLike, u_dot: ArrayLike) -> Array:
    """Return the effort [M_A N m, F_E N, M_C N m] that gives `u_dot` (rad/s2); shapes (3,) or (..., 3).

    At sin(theta2) = 0 the right arm has no lever and F_E is not finite (inf or NaN), not an error.
    """
    shape, (q_rows, u_rows, rate_rows) = _rows(q, u, u_dot)
    _, matrix, bias, lever = _terms(robot, q_rows, u_rows)
    effort: Array = np.einsum("nij,nj->ni", matrix, rate_rows) + bias
    with np.errstate(divide="ignore", invalid="ignore"):
        effort[:, 1] /= lever
    return effort.reshape(shape)
