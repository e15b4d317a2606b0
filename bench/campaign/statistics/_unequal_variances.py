"""Errors of differences if each level has a separate scatter, and balls, not shots, are random samples.

Estimates are least squares within blocks (`bench.campaign.statistics.block_model`). A *unit* is independent
from all others: a ball of its model with all its hits, or one shot where a level has one ball only. Each
level's variance is estimated from the sums of its units' residuals, unbiased whatever the scatter of the
other levels (quadratic unbiased estimation, MINQUE); the variance of a difference is a sum of them, with
Satterthwaite's degrees of freedom. Complete designs give the classical nested analysis: two levels, the
paired t test of balls.

Not a likelihood: REML sets a negative variance between balls to zero and then takes their hits for
independent. Neither does statsmodels do: its mixed model has one residual variance for all levels and no
degrees of freedom, its cluster-robust errors are valid for many clusters only, and one fit takes seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from math import inf, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import special
from scipy.stats import qmc

from bench.campaign.plan.plan import CampaignPlan, levels
from bench.campaign.statistics.block_model import Array, BlockFit, Codes, Contrast
from bench.records.shot.shot import Shot, ShotStatus

Single = NDArray[np.float32]

_MAX_UNITS = 480
"""Max number of separate units; above it, some of one level are combined."""

_MAX_CELLS = 2_400_000
"""Max number of shots times units, so that ten thousand shots take some ten megabytes."""

_SINGULAR = 0.05
"""Share of the largest singular value below which variances of levels cannot be separated."""

_MIN_VARIANCE_SHARE = 0.1
"""Lower bound of a difference's variance, as a fraction of the assumed variance."""

_FEW_UNITS = 64
"""Number of units up to which sums of squares are drawn as they come about, unit by unit."""

_DRAWS = 13
"""Log2 of the number of draws of the joint distribution of all pairs."""

_TAIL = 20
"""Number of draws beyond a limit up to which Bonferroni is more reliable."""

_FEW_FREEDOM = 10.0
"""Degrees of freedom below which Wallace's normal figure of Student's t is not near enough."""

_OWN_SCATTER = 10
"""Mountings of each club from which on each club's scatter is estimated for itself."""

_OWN_VARIANCE = 3
"""Median number of units from which on each level has its own variance; two lead to false differences."""


class Units(NamedTuple):
    """Which shots belong together."""

    of_shot: Codes
    """Unit of each shot, from 0."""
    level: Codes
    balls: Codes
    """Number of balls of each level."""


def are_pooled(units: Units, *, split: bool) -> bool:
    """Return whether all levels are taken to scatter alike; `split`: a unit is a club's mounting."""
    if split:
        return int(units.balls.min()) < _OWN_SCATTER
    counts = np.bincount(units.level)
    return float(np.median(counts[counts > 0])) < _OWN_VARIANCE


class UnitErrors(NamedTuple):
    """Covariance of the levels' effects, and its own uncertainty."""

    parts: Array
    """(levels, levels, levels): covariance of all effects from one unit of each level's variance."""
    variances: Array
    """Variance of one shot of each level, that between balls left out; unbiased, so below 0 now and then."""
    ratio: float
    """Variance between balls over that of one shot."""
    assumed: Array
    """The same, none below 0, shrunk towards equality by what chance explains: as the degrees of freedom and
    the joint distribution of all pairs assume them."""
    inverse: Array
    """(levels, levels) matrix from each level's sum of squares over its units to variances."""
    expected: Array
    """(levels, levels): the sums of squares to expect from one unit of each level's variance."""
    spread: Array
    """Covariance of the sums of squares."""
    sums: Array
    """(units, units): covariance of the sums of residuals of all units; empty for many units."""
    level: Codes
    pooled: bool
    """Whether all levels have one variance."""

    @property
    def covariance(self) -> Array:
        """Covariance of the levels' effects, as the degrees of freedom assume it."""
        return np.asarray(np.tensordot(self.assumed, self.parts, axes=1))

    def contrast(self, fit: BlockFit, first: int, second: int) -> Contrast | None:
        """Return level `first` less level `second`; None if no blocks connect the two."""
        plain = fit.contrast(first, second)
        if plain is None:
            return None
        error, dof = self.of_pair(first, second)
        return Contrast(plain.estimate, error, min(dof, fit.dof))

    def weights(self, first: int, second: int) -> Array:
        """Return the share of each level's variance in that of a difference."""
        p = self.parts
        return np.asarray(p[:, first, first] + p[:, second, second] - 2 * p[:, first, second])

    def of_pair(self, first: int, second: int) -> tuple[float, float]:
        """Return standard error and degrees of freedom of a difference."""
        each = self.weights(first, second)
        # Unbiased variance estimates can be negative: their sum is at least a tenth of the assumed one.
        variance = max(float(each @ self.variances), _MIN_VARIANCE_SHARE * float(each @ self.assumed))
        error, made = sqrt(max(variance, 0.0)), each @ self.inverse
        spread = float(made @ self.spread @ made)
        if spread <= 0:
            return error, inf
        return error, max(2 * float(each @ self.assumed) ** 2 / spread, 1.0)


def units_of(level: Codes, ball: Codes, levels: int) -> Units:
    """Return the unit (ball) of each shot by its code in `ball`; one code at two levels means two balls."""
    kept = min(_MAX_UNITS, _MAX_CELLS // max(len(level), 1))
    most = max(kept // max(levels, 1), 4)
    of_shot = np.zeros(len(level), dtype=np.intp)
    of_level: list[int] = []
    balls = np.zeros(levels, dtype=np.intp)
    for code in range(levels):
        mine = np.flatnonzero(level == code)
        if not len(mine):
            continue
        names, own = np.unique(ball[mine], return_inverse=True)
        balls[code] = len(names)
        own = (own if len(names) > 1 else np.arange(len(mine))) % most
        of_shot[mine] = own + len(of_level)
        of_level += [code] * (int(own.max()) + 1)
    return Units(of_shot, np.array(of_level, dtype=np.intp), balls)


class UnitLayout:
    """Sums of residuals by unit and their covariance: a design, whatever was measured."""

    def __init__(self, fit: BlockFit, units: Units, *, pooled: bool = False) -> None:
        """Take the design of `fit`; `pooled`: all levels have one variance."""
        self._units, levels = units, len(units.balls)
        self._pooled = pooled
        self._order = np.argsort(units.of_shot, kind="stable")
        self._starts = np.searchsorted(units.of_shot[self._order], np.arange(len(units.level)))
        self._level = units.level[units.of_shot]
        count = len(units.level)
        blocks = np.bincount(fit.block)
        sums = np.bincount(fit.block * count + units.of_shot, minlength=len(blocks) * count)
        shares = sums.reshape(len(blocks), count) / blocks[:, None]
        spanned = fit.design @ fit.inverse
        self._made = -shares[fit.block] - spanned @ self._by_unit(fit.design).T
        self._made[np.arange(len(self._level)), units.of_shot] += 1.0
        self._within = self._by_unit(self._made)
        self._dof = fit.dof
        weights = np.column_stack([np.zeros(len(spanned)), spanned[:, : levels - 1]])
        totals = self._by_unit(weights)
        self._shot_parts = np.array([_square(weights[self._level == code]) for code in range(levels)])
        self._ball_parts = np.array([_square(totals[units.level == code]) for code in range(levels)])
        self._products = np.array([_square(self._made[self._level == code]) for code in range(levels)])
        self._shots = np.array([np.diag(product) for product in self._products])

    def _by_unit(self, rows: Array) -> Array:
        return np.asarray(np.add.reduceat(rows[self._order], self._starts, axis=0))

    def _many(self, ratio: float) -> Array:
        """Return the ratio of each level; with one ball nothing is between balls."""
        return np.where(self._units.balls > 1, ratio, 0.0)

    def ratio(self, residuals: Array) -> float:
        """Return the variance between balls over that of one shot, of all levels together."""
        many = self._units.balls[self._units.level] > 1
        if not many.any() or len(self._units.level) == len(self._level):
            return 0.0
        sums, within = np.bincount(self._units.of_shot, residuals)[many], self._within[np.ix_(many, many)]
        values, vectors = np.linalg.eigh(within)
        kept = values > 1e-9 * values[-1]
        left = self._dof - kept.sum()
        if left < 1:
            return 0.0
        # Balls as fixed effects leave the scatter of one shot (Henderson's third method).
        explained = float(((vectors[:, kept].T @ sums) ** 2 / values[kept]).sum())
        of_shot = (float(residuals @ residuals) - explained) / left
        between = (float(sums @ sums) - of_shot * float(np.trace(within))) / float((within**2).sum())
        return max(between / of_shot, 0.0) if of_shot > 0 else 0.0

    def estimate(self, residuals: Array) -> UnitErrors:
        """Return the errors by the `residuals` (n,) of the fit."""
        ratio = self.ratio(residuals)
        sums = np.bincount(self._units.of_shot, residuals)
        found = np.bincount(self._units.level, sums**2, minlength=len(self._units.balls))
        inverse = self._inverse(ratio)
        variances = inverse @ found
        middle = float(
            np.average(
                variances, weights=np.maximum(np.bincount(self._level, minlength=len(variances)), 1e-9)
            )
        )
        positive = np.maximum(variances, 1e-2 * max(middle, 0.0))
        # How sure each would be if all were equal says how much of their differences is chance.
        equal = self._spread_of(self._sums(ratio, np.ones(len(positive))))
        chance = np.diag(inverse @ equal @ inverse.T)
        sure = 2 / np.maximum(chance, 1e-12)
        # An error that is small by chance must not also count for less: differences that chance makes in 1 of
        # 200 campaigns do not enter the degrees of freedom.
        assumed = _shrunk(positive, sure, 0.995)
        # A geometric mean of few degrees of freedom each is too small: all sums together say how large.
        assumed *= float(found.sum()) / max(float((self._expected(ratio) @ assumed).sum()), 1e-300)
        return self._errors(ratio, variances, assumed, inverse)

    def foreseen(self, variances: Array, ratio: float) -> UnitErrors:
        """Return the errors to expect with these true variances of one shot and this ratio."""
        true = np.asarray(variances, dtype=float)
        return self._errors(ratio, true, true, self._inverse(ratio))

    def _expected(self, ratio: float) -> Array:
        """Return the expected sums of squares of each level's units, from one unit of each variance."""
        shape, level, many = len(self._units.balls), self._units.level, self._many(ratio)
        each = self._shots + many[:, None] * np.array(
            [(self._within[level == code] ** 2).sum(0) for code in range(shape)]
        )
        return np.array([[row[level == code].sum() for row in each] for code in range(shape)])

    def _inverse(self, ratio: float) -> Array:
        expected = self._expected(ratio)
        if self._pooled:
            return np.full(expected.shape, 1 / max(float(expected.sum()), 1e-300))
        scale = np.sqrt(np.maximum(np.diag(expected), 1e-300))
        scale[np.diag(expected) <= 0] = 1.0
        return np.asarray(
            np.linalg.pinv(expected / np.outer(scale, scale), rcond=_SINGULAR) / np.outer(scale, scale)
        )

    def _errors(self, ratio: float, variances: Array, assumed: Array, inverse: Array) -> UnitErrors:
        parts = self._shot_parts + self._many(ratio)[:, None, None] * self._ball_parts
        sums = self._sums(ratio, assumed)
        few = len(sums) <= _FEW_UNITS
        return UnitErrors(
            parts,
            variances,
            ratio,
            assumed,
            inverse,
            self._expected(ratio),
            self._spread_of(sums),
            sums if few else np.zeros((0, 0)),
            self._units.level,
            self._pooled,
        )

    def _sums(self, ratio: float, variances: Array) -> Array:
        """Return the covariance of the units' sums of residuals, where these are the true variances."""
        level = self._units.level
        covariance = np.tensordot(variances, self._products, axes=1)
        if ratio:
            within = self._within * np.sqrt((self._many(ratio) * variances)[level])[:, None]
            covariance += within.T @ within
        return np.asarray(covariance)

    def _spread_of(self, covariance: Array) -> Array:
        """Return the covariance of the levels' sums of squares, with this one of the units' sums."""
        order = np.eye(len(self._units.balls))[self._units.level]
        return np.asarray(2 * order.T @ covariance**2 @ order)


def _shrunk(variances: Array, dof: Array, chance: float) -> Array:
    """Return variances shrunk towards their geometric mean by the spread that has this chance."""
    some = (dof >= 1) & (variances > 0)
    if some.sum() < 2:
        return variances
    logs = np.log(variances[some])
    weights = dof[some] / dof[some].sum()
    middle = float(weights @ logs)
    seen = float(((logs - middle) ** 2).sum()) / (some.sum() - 1)
    likely = float(special.chdtri(some.sum() - 1, 1 - chance)) / (some.sum() - 1)
    expected = float(special.polygamma(1, dof[some] / 2).mean()) * likely
    kept = max(0.0, 1 - expected / seen) if seen > 0 else 0.0
    shrunk = variances.copy()
    shrunk[some] = np.exp(middle + kept * (logs - middle))
    return shrunk


def _square(rows: Array) -> Array:
    return np.asarray(rows.T @ rows)


@cache
def _draws(width: int) -> Single:
    """Return normal draws (2^13, width), evenly spread and always the same."""
    even = qmc.Sobol(width, rng=np.random.default_rng(1)).random_base2(_DRAWS)
    return np.asarray(special.ndtri(np.clip(even, 1e-12, 1 - 1e-12)), dtype=np.float32)


class JointErrors(NamedTuple):
    """Distribution of the largest |t| of all pairs if no levels differ, each t as a normal figure."""

    largest: Array
    """Sorted draws."""
    pairs: int
    exact: bool = False
    """Whether the draws know more than the pairs' own degrees of freedom, so that Bonferroni is no bound."""

    def adjusted(self, p: float) -> float:
        """Return a pair's p value for all pairs together (single step)."""
        if self.pairs < 2:
            return p
        above = len(self.largest) - int(np.searchsorted(self.largest, -float(special.ndtri(p / 2))))
        bound = 1.0 if self.exact and above > _TAIL else min(1.0, self.pairs * p)
        return max(p, min(bound, (above + 1) / (len(self.largest) + 1)))

    def single(self, alpha: float) -> float:
        """Return the level of one pair at which all together err with `alpha`."""
        if self.pairs < 2:
            return alpha
        if alpha * len(self.largest) <= _TAIL:
            return alpha / self.pairs
        beyond = 2 * float(special.ndtr(-np.quantile(self.largest, 1 - alpha)))
        return min(alpha, beyond if self.exact else max(beyond, alpha / self.pairs))


class Draws(NamedTuple):
    """Differences of all pairs and their estimated variances, drawn as if no levels differed."""

    differences: Single
    """(draws, pairs)"""
    variances: Single
    dof: Array
    """Degrees of freedom of each pair."""


def drawn_pairs(errors: UnitErrors, pairs: Sequence[tuple[int, int]], most: float) -> Draws:
    """Return draws of differences with these errors and at `most` so many degrees of freedom.

    They include the correlation of pairs with a common level, in the differences and in their standard
    errors.
    """
    width = len(errors.assumed)
    unit = max(float(errors.assumed.max()), 1e-300)  # single precision has few powers of ten
    drawn = _draws(width + (len(errors.sums) or width))
    means = drawn[:, :width] @ _root(errors.covariance / unit).T
    if len(errors.sums):
        sums = drawn[:, width:] @ _root(errors.sums / unit).T
        squares = sums**2 @ (errors.level[:, None] == np.arange(width)).astype(np.float32)
    else:
        squares = _squares(errors, unit, drawn[:, width:])
    first, second = np.array(pairs).T
    weights = np.array([errors.weights(one, two) for one, two in pairs])
    share = 0.0 if errors.pooled else _MIN_VARIANCE_SHARE  # a pooled variance is the assumed one: no bound
    least = (share / unit * (weights @ errors.assumed)).astype(np.float32)
    variances = np.maximum(squares @ (weights @ errors.inverse).T.astype(np.float32), least)
    dof = np.array([min(errors.of_pair(one, two)[1], most, 1e6) for one, two in pairs])
    differences = (means[:, first] - means[:, second]) * np.float32(sqrt(unit))
    return Draws(differences, np.maximum(variances, np.float32(1e-30)) * np.float32(unit), dof)


def _squares(errors: UnitErrors, unit: float, drawn: Single) -> Single:
    """Return sums of squares of many units over `unit`: each like chi-square (Wilson and Hilferty)."""
    middle, spread = errors.expected @ errors.assumed / unit, errors.spread / unit**2
    sd = np.sqrt(np.maximum(np.diag(spread), 1e-300))
    step = (sd / np.maximum(middle, 1e-300)) ** 2 / 9
    linked = drawn @ _root(spread / np.outer(sd, sd)).T
    cubed = np.maximum((1 - step + linked * np.sqrt(step)), 0.0) ** 3
    return np.asarray(middle * cubed, dtype=np.float32)


def together(errors: UnitErrors, pairs: Sequence[tuple[int, int]], most: float) -> JointErrors:
    """Return the joint distribution of all pairs, as `drawn_pairs` draws them."""
    if len(pairs) < 2:
        return JointErrors(np.zeros(0), len(pairs))
    differences, variances, dof = drawn_pairs(errors, pairs, most)
    # Student's t as a normal figure (Wallace 1959).
    factor = (dof * ((8 * dof + 1) / (8 * dof + 3)) ** 2).astype(np.float32)
    squared = np.log1p(differences**2 / variances / dof.astype(np.float32)) * factor
    if np.ptp(dof) < 1e-9:  # the largest stays the largest
        squared = squared.max(axis=1, keepdims=True)
    for pair in np.flatnonzero(dof[: squared.shape[1]] < _FEW_FREEDOM):
        squared[:, pair] = _normal_square(squared[:, pair], float(dof[pair]))
    largest = np.sqrt(np.sort(squared.max(axis=1)).astype(float))
    return JointErrors(largest, len(pairs), len(errors.sums) > 0)


def _normal_square(squared: Single, dof: float) -> Single:
    """Return the square of the normal figure of Student's t whose figure by Wallace has this square."""
    wallace = np.linspace(0.0, 8.0, 161)
    factor = dof * ((8 * dof + 1) / (8 * dof + 3)) ** 2
    t = np.sqrt(dof * np.expm1(np.minimum(wallace**2 / factor, 600.0)))
    exact = -special.ndtri(special.stdtr(dof, -t))
    return np.asarray(np.interp(np.sqrt(squared), wallace, exact) ** 2, dtype=np.float32)


def _root(covariance: Array) -> Single:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), dtype=np.float32)


def common_errors(plan: CampaignPlan, shots: Sequence[Shot]) -> Mapping[str, float]:
    """Return the standard uncertainty (m) of each ball's carry from its measured aerodynamics.

    Empty where they do not separate the levels: clubs and swings hit the same ball, and carry of another
    source, or another quantity, does not come from them. The total has the uncertainty of its carry.
    """
    if plan.design.compare != "ball" or plan.analysis.quantity not in {"carry_m", "total_m"}:
        return {}
    found = {}
    for name in levels(plan):
        errors = [
            error
            for shot in shots
            if shot.ball == name and shot.status is ShotStatus.VALID and shot.carry_source == "measured"
            if (error := shot.carry_measured_error_m) is not None
        ]
        if errors:
            found[name] = float(np.mean(errors))
    return found
