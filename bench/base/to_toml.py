"""Values as TOML text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from numbers import Integral, Real
from typing import Any


def toml_value(value: Any) -> str:
    """Return `value` as TOML, numbers of numpy as Python's; None, a value that was not measured, as nan.

    Raises:
        TypeError: TOML has no such value.
    """
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_value(below)}" for key, below in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Integral):
        return repr(int(value))
    if isinstance(value, Real) or value is None:
        return repr(float("nan" if value is None else value))
    raise TypeError(f"TOML has no {type(value).__name__}")
