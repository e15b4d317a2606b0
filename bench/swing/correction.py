"""A learned correction: tables that are added to a profile's reference and feed-forward."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import BenchError
from bench.swing.profile import Profile

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Correction:
    """Additions to a profile's tables, each (n, 3), joints in order."""

    angle: Array
    """Shift of the angles (rad)."""
    velocity: Array
    """Shift of the velocities (rad/s)."""
    valve: Array
    """Opening."""

    def applied_to(self, profile: Profile) -> Profile:
        """Return `profile` with the correction; openings stay within -1 to 1.

        Raises:
            BenchError: the tables are not as long as the profile's.
        """
        if self.angle.shape != profile.angle.shape:
            raise BenchError(
                f"correction of {profile.name}",
                f"{len(self.angle)} samples",
                f"{len(profile.angle)}, as the profile has",
                "Learn it again for this profile.",
            )
        return replace(
            profile,
            # In C order as a profile's own: the controller is compiled for that.
            angle=np.ascontiguousarray(profile.angle + self.angle),
            velocity=np.ascontiguousarray(profile.velocity + self.velocity),
            valve=np.ascontiguousarray(np.clip(profile.valve + self.valve, -1.0, 1.0)),
            corrected=True,
        )


def digest_of(profile: Profile) -> str:
    """Return a digest of the tables that a correction of `profile` is added to."""
    tables = [profile.angle, profile.velocity, profile.valve, np.array(profile.begins, dtype=float)]
    if profile.air:
        tables.append(np.array([*profile.air, profile.air_supply]))
    return sha256(b"".join(np.ascontiguousarray(table).tobytes() for table in tables)).hexdigest()[:16]


@dataclass(frozen=True)
class Basis:
    """Smooth functions of time that corrections are made of: cubic B-splines, one row each.

    A point (m,) holds their weights, in units of `opening` and `shift`: those of the feed-forward, joint by
    joint, then those of the reference. Address and the swing up to the top stay as planned.
    """

    valve: Array
    """(k, n)"""
    angle: Array
    """(l, n)"""
    slope: Array
    """(l, n), 1/s"""
    opening: float = 0.2
    """Valve opening that a weight of 1 stands for."""
    shift: float = 0.05
    """Shift of the reference that a weight of 1 stands for, rad."""

    @property
    def size(self) -> int:
        """Number of weights."""
        return 3 * (len(self.valve) + len(self.angle))

    def correction(self, point: Array) -> Correction:
        """Return the correction for the weights `point` (m,)."""
        split = 3 * len(self.valve)
        valve = self.opening * point[:split].reshape(3, -1)
        shift = self.shift * point[split:].reshape(3, -1)
        return Correction((shift @ self.angle).T, (shift @ self.slope).T, (valve @ self.valve).T)

    def corrected(self, profile: Profile, weights: Sequence[float]) -> Profile:
        """Return `profile` with the corrections of `weights` (m,) added."""
        return self.correction(np.array(weights)).applied_to(profile)


def basis_of(profile: Profile, valve_spacing: float = 0.025, angle_spacing: float = 0.060) -> Basis:
    """Return the basis functions for `profile`, with their centres at a spacing in s.

    The feed-forward is corrected in the downswing, the reference from shortly before the top on: an error
    at the top is carried into the downswing.
    """
    tick, top, down, impact = profile.period, profile.begins[2], profile.begins[3], profile.begins[5]
    valve, _ = _splines(profile, down, impact, round(valve_spacing / tick))
    lead, spacing = round(0.05 / tick), round(angle_spacing / tick)
    angle, slope = _splines(profile, max(top - lead, 2 * spacing), impact, spacing)
    return Basis(valve, angle, slope)


def _splines(profile: Profile, first: int, last: int, spacing: int) -> tuple[Array, Array]:
    """Return cubic B-splines with centres from sample `first` to `last`, and their slopes (1/s)."""
    knots = np.arange(-2.0, 3.0) * spacing
    away = np.arange(len(profile.angle)) - np.arange(first, last + 1, spacing)[:, None]
    rise = 1.0 / spacing
    slope = rise * _spline(away, knots[:-1]) - rise * _spline(away, knots[1:])
    return 1.5 * _spline(away, knots), 1.5 * slope / profile.period  # a spline's peak is 2/3


def _spline(at: NDArray[np.int64], knots: Array) -> Array:
    """Return the B-spline on `knots` (k + 2,) of degree k at each position of `at` (Cox and de Boor).

    Bit-equal to scipy's, whose interpolation a bench would import for this alone.
    """
    parts: list[Array] = [((a <= at) & (at < b)).astype(float) for a, b in pairwise(knots)]
    for degree in range(1, len(parts)):
        width = knots[degree:] - knots[:-degree]
        parts = [
            parts[i] / width[i] * (at - knots[i]) + parts[i + 1] / width[i + 1] * (knots[i + degree + 1] - at)
            for i in range(len(parts) - 1)
        ]
    return parts[0]
