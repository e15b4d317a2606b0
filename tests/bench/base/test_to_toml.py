"""Values as TOML that its reader gives back."""

from __future__ import annotations

import tomllib
from math import isnan
from typing import Any

import numpy as np
import pytest

from bench.base.to_toml import toml_value


def read(text: str) -> Any:
    return tomllib.loads(f"value = {text}")["value"]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float64(19.971885329808778), 19.971885329808778),
        (np.int64(-3), -3),
        (1e-07, 1e-07),
        (float("inf"), float("inf")),
        (True, True),
        ((np.float64(0.5), 2), [0.5, 2]),
        ({"body": 12.0, "club": [1, 2]}, {"body": 12.0, "club": [1, 2]}),
        ('"é\\\x7f\n', '"é\\\x7f\n'),
    ],
)
def test_toml_value_reads_back_unchanged(value: object, expected: object) -> None:
    found = read(toml_value(value))
    assert found == expected
    assert type(found) is type(expected)


def test_toml_value_none_becomes_nan() -> None:
    assert isnan(read(toml_value(None)))


def test_toml_value_unsupported_type_is_refused() -> None:
    with pytest.raises(TypeError, match="ndarray"):
        toml_value(np.zeros(2))
