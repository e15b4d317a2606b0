"""A small part of the fuzz that `python -m tests.benchmarks frame_fuzz` runs at length."""

from __future__ import annotations

import numba
import pytest

from drivers.canopen._native_tick import IS_SUPPORTED
from tests.benchmarks.frame_fuzz import fuzz
from tests.benchmarks.native_fuzz import fuzz as fuzz_native
from tests.benchmarks.sdo_fuzz import fuzz as fuzz_startups


@pytest.mark.parametrize("listening", [True, False], ids=["latching", "never latched"])
def test_frame_fuzz_is_counted_without_motion(listening: bool) -> None:
    result = fuzz(10_000, 7, listening=listening)
    assert result.escaped == []
    assert result.motions == 0
    assert result.counted == result.frames
    assert result.frames > 10_000
    assert all(result.classes.values()), result.classes


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT) or not IS_SUPPORTED, reason="nothing is compiled")
def test_native_fuzz_matches_python_ticks() -> None:
    result = fuzz_native(3_000, 7)
    assert result.escaped == []
    assert result.differences == []
    assert (result.motions, result.uncounted) == (0, 0)
    assert 0 < result.declined < 2 * result.ticks


def test_sdo_fuzz_refusals_name_node_without_energy() -> None:
    result = fuzz_startups(3_000, 7)
    assert result.escaped == []
    assert result.unnamed == []
    assert (result.energised, result.slow) == (0, 0)
    assert 0 < result.opened < result.startups
