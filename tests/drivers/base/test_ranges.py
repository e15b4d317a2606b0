"""Marks of valid values: two kinds with the same bound are never one."""

from __future__ import annotations

from itertools import permutations

import pytest

from drivers.base.ranges import Above, AtLeast, AtMost, Count, Gap, Range, read_number


def test_marks_of_different_kinds_with_equal_bound_differ() -> None:
    """Typing of Python 3.11.2 gives equal marks one cached annotation: `at least 0` became `above 0`."""
    marks = (AtLeast(0.0), Above(0.0), AtMost(0.0), Count(0), Gap(0.0, 0.0), Range(0.0, 0.0, ""))
    assert not any(one == other for one, other in permutations(marks, 2))
    assert AtLeast(0.0) == AtLeast(0.0)


@pytest.mark.parametrize("text", ["1_5", "1_000.0", "x", ""])
def test_read_number_invalid_text_raises(text: str) -> None:
    with pytest.raises(ValueError, match=r"no number|could not convert"):
        read_number(text)
