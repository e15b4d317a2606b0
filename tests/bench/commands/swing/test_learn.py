"""`golfbench learn`: its table fits a terminal of 80 columns, causes stand below it."""

from __future__ import annotations

from io import StringIO
from math import nan
from types import SimpleNamespace
from typing import Any

from rich.console import Console

from bench.base.lifecycle import Cause
from bench.commands.swing.learn import _table, _verdict


def figures(*values: float | None) -> Any:
    return SimpleNamespace(shown=dict(enumerate(values)))


def attempt(cause: Cause, *values: float | None) -> Any:
    return SimpleNamespace(cause=cause, figures=figures(*values), saturated=0.12)


def test_learn_table_with_causes_shows_complete_figures() -> None:
    result: Any = SimpleNamespace(
        target=figures(-0.01, 44.82, -10.03, -7.23),
        attempts=[
            attempt(Cause.WRIST_SENSOR, -10.22, 44.7, -10.01, -8.72),
            attempt(Cause.GROUND, *[None] * 4),
        ],
        chosen=0,
        within=False,
        used=12,
        path_error=lambda attempt: nan,
    )
    console = Console(width=80, file=StringIO(), record=True)
    console.print(_table(result, "iron"))
    text = console.export_text()
    assert "…" not in text
    for value in ("-10.22", "44.70", "-10.01", "-8.72", "WRIST_SENSOR", "GROUND"):
        assert value in text
    entry: Any = SimpleNamespace(profile="iron", conditions=SimpleNamespace(text="iron7"))
    below = _verdict(result, entry, 1).splitlines()
    assert below[0].startswith("WRIST_SENSOR: one wrist chamber")
    assert below[1].startswith("GROUND: club head too near")
