"""A sample of a grid of cases for the everyday tests; the whole grid runs in `make test-release`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

import pytest


def release_except(
    sample: Collection[Any], cases: Iterable[Any], name: Callable[[Any], Any] = lambda value: value
) -> list[Any]:
    """Return `cases` for parametrize; `release` marks those whose first value has no `name` in `sample`.

    Raises:
        ValueError: a value of `sample` is not among the cases.
    """
    missing, marked = set(sample), []
    for case in cases:
        values = case if type(case) is tuple else (case,)  # a named tuple is one value
        missing.discard(named := name(values[0]))
        marked.append(pytest.param(*values, marks=() if named in sample else pytest.mark.release))
    if missing:
        raise ValueError(f"not among the cases: {sorted(map(str, missing))}")
    return marked
