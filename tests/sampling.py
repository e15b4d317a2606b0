"""A sample of a grid of cases for the fast tests; the whole grid runs in `make test-all`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_except(fast: Collection[Any], cases: Iterable[Any]) -> list[Any]:
    """Return `cases` for parametrize, those whose (first) value is not in `fast` marked slow.

    Raises:
        ValueError: a value of `fast` is not among the cases.
    """
    missing, made = set(fast), []
    for case in cases:
        values = case if isinstance(case, tuple) else (case,)
        missing.discard(values[0])
        made.append(pytest.param(*values, marks=() if values[0] in fast else pytest.mark.slow))
    if missing:
        raise ValueError(f"not among the cases: {sorted(map(str, missing))}")
    return made
