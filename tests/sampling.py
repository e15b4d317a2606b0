"""Samples of cases for the everyday tests; all of them run in `make test-release`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from typing import Any

import pytest
from hypothesis import given, settings


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


Test = Callable[..., None]


def examples(daily: int, release: int, **strategies: Any) -> Callable[[Test], Test]:
    """Give a test `daily` random examples of the `strategies`, and `release` ones before a release."""

    def pair(test: Test) -> Test:
        @pytest.mark.parametrize("count", release_except({daily}, [daily, release]))
        def run(count: int) -> None:
            settings(max_examples=count, deadline=None)(given(**strategies)(test))()

        run.__name__, run.__qualname__, run.__doc__ = test.__name__, test.__qualname__, test.__doc__
        run.__module__ = test.__module__
        return run

    return pair
