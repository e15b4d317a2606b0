"""The step's decision is compiled in another process, for the types that ticks use."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numba
import pytest

from bench.control.settings import build_controller
from bench.control.step import decide_tick
from bench.loop import compile_ahead as ahead
from bench.loop._compiled_tick import empty_parameters
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.compiled import IS_PLAIN
from drivers.base.kept_code import is_kept
from sim.plant import PlantParameters


def test_empty_parameters_have_types_of_controller() -> None:
    real = build_controller(PlantParameters(), load_profile(find_profile("default")))
    assert numba.typeof(empty_parameters()) == numba.typeof(real)


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No process was started before; nothing else is compiled or printed."""
    monkeypatch.setattr(ahead, "compile_rest", lambda: None)
    monkeypatch.setattr(ahead, "IS_PLAIN", False)
    ahead._other_process.cache_clear()
    yield
    ahead._other_process.cache_clear()


@pytest.mark.usefixtures("fresh")
def test_compile_ahead_kept_code_starts_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "is_kept", lambda _: True)
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    with ahead.compile_ahead() as compiling:
        assert not compiling


@pytest.mark.usefixtures("fresh")
def test_compile_ahead_no_memory_for_process_compiles_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError("no memory")

    monkeypatch.setattr(ahead, "is_kept", lambda _: False)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with ahead.compile_ahead() as compiling:
        assert not compiling


@pytest.mark.usefixtures("fresh")
def test_compile_ahead_starts_one_process_and_waits_for_end(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def start_noted(command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        started.append(start(command, **options))
        return started[-1]

    needed = iter([False])  # not on disk here; the process itself finds it there, or compiles it
    monkeypatch.setattr(ahead, "is_kept", lambda _: next(needed))
    monkeypatch.setattr(subprocess, "Popen", start_noted)
    answers = []
    for _ in range(2):
        with ahead.compile_ahead() as compiling:
            answers.append(compiling)
    assert answers == [True, False]
    assert [process.returncode for process in started] == [0]
    assert IS_PLAIN or is_kept(decide_tick)


@pytest.mark.usefixtures("fresh")
def test_compile_ahead_process_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    start = subprocess.Popen
    started: list[subprocess.Popen[bytes]] = []

    def start_hanging(_command: list[str], **options: Any) -> subprocess.Popen[bytes]:
        started.append(start([sys.executable, "-c", "import time; time.sleep(600)"], **options))
        return started[-1]

    reports: list[str] = []
    monkeypatch.setattr(ahead, "is_kept", lambda _: False)
    monkeypatch.setattr(ahead, "report_compilation", reports.append)
    monkeypatch.setattr(ahead, "_POLL_PERIOD", 0.05)
    monkeypatch.setattr(ahead, "_TIMEOUT", 0.2)
    monkeypatch.setattr(subprocess, "Popen", start_hanging)
    with ahead.compile_ahead() as compiling:
        assert compiling
    assert [process.returncode for process in started] == [-signal.SIGKILL]
    assert reports


def test_compile_ahead_process_of_ended_parent_compiles_nothing() -> None:
    command = [sys.executable, "-c", "from bench.loop.compile_ahead import main; main(1)"]
    with TemporaryDirectory() as folder:
        ended = subprocess.run(command, check=False, env=os.environ | {"NUMBA_CACHE_DIR": folder})
        assert ended.returncode == 1
        assert not list(Path(folder).rglob("decision.lock"))
