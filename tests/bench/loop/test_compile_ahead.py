"""The step's decision is compiled in another process, for the types that ticks use."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import pytest

from bench.control.settings import build_controller
from bench.loop import compile_ahead as ahead
from bench.loop.compiled_tick import empty_parameters
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import compiled
from drivers.base.kept_code import is_kept
from sim.plant import PlantParameters


def test_empty_parameters_have_types_of_controller() -> None:
    real = build_controller(PlantParameters(), load_profile(find_profile("default")))
    assert numba.typeof(empty_parameters()) == numba.typeof(real)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compile_ahead_kept_code_starts_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead.compile_decision()
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    ahead._needed.cache_clear()
    with ahead.compile_ahead() as compiling:
        assert not compiling


@compiled
def _decide(state: Any, parameters: Any, readings: Any, time: float) -> float:
    return time


PROCESS = """
from bench.loop import compile_ahead
from tests.bench.loop import test_compile_ahead as test

compile_ahead.decide_tick = test._decide
compile_ahead.compile_decision()
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compile_ahead_other_process_keeps_decision_for_this_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start, commands = subprocess.Popen, list[list[str]]()

    def start_test(command: list[str], **options: Any) -> Any:
        commands.append(command)
        return start([sys.executable, "-c", PROCESS], cwd=Path(__file__).parents[3], **options)

    shown: list[str] = []
    monkeypatch.setattr(subprocess, "Popen", start_test)
    monkeypatch.setattr(ahead, "_needed", lambda: True)
    monkeypatch.setattr(ahead, "compile_rest", lambda: shown.append("rest"))
    monkeypatch.setattr(ahead, "report_compilation", shown.append)
    with ahead.compile_ahead() as compiling:
        assert compiling
    assert commands == [[sys.executable, "-P", "-m", "bench.loop.compile_ahead"]]
    assert shown[0] == "rest"
    assert is_kept(_decide)
