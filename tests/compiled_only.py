"""Marks for what takes minutes where nothing is compiled, as in a run that measures branches."""

from __future__ import annotations

import numba
import pytest

needs_speed = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="whole swings take minutes without compilation"
)
