"""The grid of `golfbench size` from its options."""

from __future__ import annotations

import pytest

from bench.base.errors import BenchError
from bench.commands.machine.size import _grid
from bench.design.sizing.search import SizingGrid


def test_grid_given_values_replace_defaults() -> None:
    given = ["vane=V250", "vane=V400", "absorbers=A40,A90", "pressure_bar=9", "lever_mm=50", "hose=none"]
    grid = _grid(given)
    assert (grid.vanes, grid.absorbers, grid.hoses) == (("V250", "V400"), (("A40", "A90"),), ("",))
    assert (grid.pressures, grid.levers) == ((9e5,), (0.05,))
    assert grid.cylinders == SizingGrid().cylinders


@pytest.mark.parametrize("text", ["colour=red", "van", "absorbers=A40", "lever_angle=steep"])
def test_grid_invalid_value_is_refused(text: str) -> None:
    with pytest.raises(BenchError, match=f"--grid.*{text}"):
        _grid([text])
