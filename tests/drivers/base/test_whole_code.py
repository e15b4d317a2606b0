"""Parts have no separate machine code, unless Python calls them; numba's internals are as expected."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest

from drivers.base._whole_code import make_part
from drivers.base.compiled import compiled, fields, new_record
from drivers.base.kept_code import keep_code

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")


@compiled
def _square(number: float) -> float:
    return number * number


@compiled
def _sum_of_squares(a: float, b: float) -> float:
    return _square(a) + _square(b)


@compiled
def _length(a: float, b: float) -> float:
    return float(_sum_of_squares(a, b) ** 0.5)


def test_part_is_compiled_into_caller_only() -> None:
    assert _length(3.0, 4.0) == 5.0
    assert not _sum_of_squares.overloads  # type: ignore[attr-defined]


@compiled
def _chosen(number: float, squared: bool) -> float:
    return _square(number) if squared else number


@compiled
def _either(a: float, b: float) -> float:
    return _chosen(a, False) + _chosen(b, a > 0.0)  # the first version calls nothing


def test_part_dropped_in_caller_is_linked_for_another_part() -> None:
    assert _either(3.0, 4.0) == 19.0


def test_part_called_by_python_gets_machine_code() -> None:
    assert _length(3.0, 4.0) == 5.0
    assert _square(3.0) == 9.0
    assert len(_square.overloads) == 1  # type: ignore[attr-defined]


def test_part_with_kept_machine_code_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def double(number: float) -> float:
        return 2.0 * number

    def made() -> Any:
        function = numba.njit(double)
        make_part(function)
        keep_code(function, __name__)
        return function

    made()(1.0)
    again = made()
    caller = numba.njit(lambda number: again(number) + 1.0)
    assert caller(2.0) == 5.0
    assert again.stats.cache_hits
    assert not again.stats.cache_misses


def test_record_types_have_short_names_that_tell_apart() -> None:
    wide, other = (np.dtype(fields("f8", names)) for names in (" ".join(f"name{i}" for i in range(99)), "a"))
    names = [str(numba.typeof(new_record(dtype)).dtype) for dtype in (wide, other, wide)]
    assert len(set(names)) == 2
    assert names[0] == names[2]
    assert max(map(len, names)) < 30
