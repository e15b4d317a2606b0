"""A compilation is reported while it lasts."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from drivers.base import compile_report
from drivers.base.compile_report import CompileProgress, announce_compilation


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(compile_report, "_report", str)
    lines: list[str] = []
    announce_compilation(lines.append)
    return lines


def _times(*times: float) -> Iterator[float]:
    yield from times


def test_compile_progress_long_compilation_reports_periodically(
    heard: list[str],
) -> None:
    times = _times(100.0, 100.5, 101.5, 103.0, 104.1)
    progress = CompileProgress(lambda: next(times))
    progress.known = 180
    for done in (None, None, "a function", "a function", "another"):
        progress.note(done)
    assert heard == [
        "compiling, once for each version: 1 of at most 180 functions, 2 s",
        "compiling, once for each version: 2 of at most 180 functions, 4 s",
    ]


def test_compile_progress_below_1_s_reports_nothing(heard: list[str]) -> None:
    times = _times(100.0, 100.9)
    progress = CompileProgress(lambda: next(times))
    progress.note()
    progress.note("a function")
    assert heard == []
