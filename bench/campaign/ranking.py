"""Ranking of a section's levels with letters: those without a letter in common differ, all pairs together.

Compact letter display by insertion and absorption (Piepho 2004), from the decisions of the confirmatory
analysis at its familywise level. A shared letter means that no difference was shown, not equality.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from bench.campaign.analysis import Comparison, Pair
from bench.campaign.differences import difference_to


@dataclass(frozen=True)
class RankedLevel:
    """One level at its place, in descending order."""

    rank: int
    name: str
    effect: float
    """Level less the mean of all levels, by the confirmatory model."""
    letters: str
    behind: float
    """Level less the first one; 0 of the first."""
    behind_low: float
    behind_high: float
    """Interval of `behind` that holds together with all pairs'."""
    scatter_letters: str
    """Levels without one in common scatter differently; empty where scatter was not compared."""


def ranking(comparison: Comparison | None) -> tuple[RankedLevel, ...]:
    """Return the compared levels in descending order; empty without a comparison."""
    if comparison is None or not comparison.pairs:
        return ()
    pairs = comparison.pairs
    names = list(dict.fromkeys(name for pair in pairs for name in (pair.first, pair.second)))
    effects = _effects(names, pairs)
    order = sorted(names, key=lambda name: (-effects[name], name))
    different = [(p.first, p.second) for p in pairs if p.verdict in {"different", "both"}]
    letters = compact_letters(order, different)
    scatter: dict[str, str] = {}
    if comparison.scatter:
        unequal = [
            (r.first, r.second) for r in comparison.scatter if r.p_adjusted < 1 - comparison.confidence
        ]
        compared = {name for ratio in comparison.scatter for name in (ratio.first, ratio.second)}
        scatter = compact_letters([name for name in order if name in compared], unequal)
    return tuple(
        RankedLevel(
            place, name, effects[name], letters[name], *_behind(pairs, name, order[0]), scatter.get(name, "")
        )
        for place, name in enumerate(order, 1)
    )


def compact_letters(order: Sequence[str], different: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return the letters of each name of `order`, so that exactly the `different` pairs share none."""
    groups: list[frozenset[str]] = [frozenset(order)]
    for one, two in different:
        split: list[frozenset[str]] = []
        for group in groups:
            split += [group - {one}, group - {two}] if {one, two} <= group else [group]
        unique = list(dict.fromkeys(split))
        groups = [group for group in unique if not any(group < other for other in unique)]
    place = {name: number for number, name in enumerate(order)}
    groups.sort(key=lambda group: sorted(place[name] for name in group))
    return {
        name: "".join(_letter(number) for number, group in enumerate(groups) if name in group)
        for name in order
    }


def _letter(number: int) -> str:
    """Return a to z, then a' to z' and so on."""
    return chr(ord("a") + number % 26) + "'" * (number // 26)


def _effects(names: Sequence[str], pairs: Sequence[Pair]) -> dict[str, float]:
    """Return the effects that the differences have in common, with mean 0."""
    code = {name: index for index, name in enumerate(names)}
    rows = np.zeros((len(pairs) + 1, len(names)))
    for row, pair in zip(rows, pairs, strict=False):
        row[code[pair.first]], row[code[pair.second]] = 1.0, -1.0
    rows[-1] = 1.0
    found = np.linalg.lstsq(rows, np.array([*(pair.difference for pair in pairs), 0.0]), rcond=None)[0]
    return {name: float(value) for name, value in zip(names, found, strict=True)}


def _behind(pairs: Sequence[Pair], name: str, first: str) -> tuple[float, float, float]:
    if name == first:
        return 0.0, 0.0, 0.0
    pair = difference_to(first, name, pairs)
    return (pair.difference, pair.low_together, pair.high_together) if pair else (float("nan"),) * 3
