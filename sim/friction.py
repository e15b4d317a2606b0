"""Dry friction of three coupled joints: its bound, and what bounded impulses do to the speeds.

Coulomb friction obeys a principle, not a formula: it stops the sliding if its bound allows, otherwise it acts
with its full bound against the sliding (Moreau, "Unilateral contact and dry friction in finite freedom
dynamics", 1988). With coupled joints that is a linear complementarity problem with a symmetric positive
definite matrix, so it has one solution; friction obeying it never adds energy.
"""

from __future__ import annotations

from math import exp

from drivers.base.compiled import compiled

_SWEEPS = 500
_CONVERGED = 1e-14


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
