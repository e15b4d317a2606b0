"""Machine code is never older than the enums compiled into it."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

from drivers.base import compile_report
from drivers.base.compile_report import CompileProgress, announce_compilation
from drivers.base.compiled import compiled
from drivers.base.kept_code import _KeptCode

TOP = Path(__file__).parents[3]

USER = '''"""A compiled function that takes its constant from an enum."""

from bench.base.lifecycle import Refusal
from drivers.base.compiled import compiled


@compiled
def refusal() -> int:
    return Refusal.SUPPORT
'''


NATIVE = """'A native function whose constant is that of a function of another module.'

from bench.control.example import refusal
from drivers.base.native import compiled_call


@compiled_call
def sum_of(block, first, second, time):
    return first + refusal()
"""
CALL = """
import ctypes
from bench.control.native_example import sum_of
import bench.control.other_example  # decorated last
kind = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64, ctypes.c_double)
print(kind(sum_of.address)(0, 100, 0, 0.0))
"""
OTHER = """
from drivers.base.compiled import compiled


@compiled
def one():
    return 1
"""


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the packages in which only compiled files speak of compilation."""
    for package in ("bench", "drivers", "sim"):
        shutil.copytree(TOP / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    lifecycle = tmp_path / "bench/base/lifecycle.py"
    lifecycle.write_text(lifecycle.read_text().replace("compiled", "fast"))
    (tmp_path / "bench/control/example.py").write_text(USER)
    return tmp_path


def printed(copy: Path, code: str) -> str:
    """Return what `code` prints with the packages of `copy` and its cache."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy),
        "NUMBA_CACHE_DIR": str(copy / "cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    return subprocess.run(
        [sys.executable, "-c", code], cwd=copy, env=environment, capture_output=True, text=True, check=True
    ).stdout


def run(copy: Path) -> tuple[int, int]:
    """Return the example's result, and the number of versions of its machine code afterwards."""
    return int(printed(copy, "from bench.control.example import refusal; print(refusal())")), len(
        [*(copy / "cache/compiled/bench.control.example").iterdir()]
    )


def test_compiled_functions_without_references_return_no_arrays() -> None:
    """Numba does not notice: the caller would free an array that is still in use."""
    paths = (path for package in ("bench", "drivers", "sim") for path in (TOP / package).rglob("*.py"))
    trees = (ast.parse(path.read_text()) for path in paths)
    returned = [
        (node.name, ast.unparse(node.returns or ast.Name("Any")))
        for tree in trees
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and {ast.unparse(name) for name in node.decorator_list} & {"compiled", "compiled_in_place"}
    ]
    numbers = {"None", "bool", "int", "float", "tuple"}
    numbers |= {"Vector", "State", "Axes", "Head", "BodyTerms", "KaneTerms"}  # tuples of floats
    assert "move" in dict(returned)
    assert not [(name, kind) for name, kind in returned if set(re.findall(r"\w+", kind)) - numbers]


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compiled_function_that_makes_array_is_refused() -> None:
    with pytest.raises(NumbaError):
        _difference(np.ones(3), np.ones(3))


@compiled
def _difference(a: Any, b: Any) -> float:
    apart = a - b
    return float(apart[0])


@pytest.mark.slow
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compiled_changed_enum_recompiles(copy: Path) -> None:
    assert run(copy) == (8, 1)
    assert run(copy) == (8, 1)
    (kept,) = (copy / "cache").rglob("*.nbc")
    lifecycle = copy / "bench/base/lifecycle.py"
    lifecycle.write_text(lifecycle.read_text().replace("    SUPPORT = 8\n", "    SUPPORT = 88\n"))
    assert run(copy) == (88, 2)
    assert kept.exists()


class Place(IntEnum):
    TOP = 7


@numba.njit  # type: ignore[untyped-decorator]  # numba has no types
def _sum(number: int) -> int:
    return _twice(1) + _twice(2) + _twice(Place.TOP) + _twice(number)


@compiled
def _twice(number: int) -> int:
    return 2 * number


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compiled_calls_with_constants_and_enums_share_one_version() -> None:
    assert _sum(50) == 120
    assert len(_twice.get_call_template.__self__._versions) == 1  # type: ignore[attr-defined]


@pytest.mark.slow
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_compiled_unreadable_cache_recompiles(copy: Path, suffix: str) -> None:
    assert run(copy) == (8, 1)
    (kept,) = (copy / "cache").rglob(f"*.{suffix}")
    for broken in (kept.read_bytes()[:-20], kept.read_bytes().replace(b"numba", b"gonea"), b""):
        kept.write_bytes(broken)
        assert run(copy) == (8, 1)


@pytest.mark.slow
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_compiled_call_old_or_unreadable_cache_recompiles(copy: Path) -> None:
    (copy / "bench/control/native_example.py").write_text(NATIVE)
    (copy / "bench/control/other_example.py").write_text(OTHER)
    assert printed(copy, CALL) == "108\n"
    lifecycle = copy / "bench/base/lifecycle.py"
    lifecycle.write_text(lifecycle.read_text().replace("    SUPPORT = 8\n", "    SUPPORT = 88\n"))
    assert printed(copy, CALL) == "188\n"
    for kept in (copy / "cache").rglob("*sum_of*"):
        kept.write_bytes(b"")
    assert printed(copy, CALL) == "188\n"


def test_kept_code_two_processes_at_once_are_not_mixed_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second process has read the index before the first writes it, and saves before the first."""
    first, second = (_KeptCode(str(tmp_path), "react-12.py311", "stamp") for _ in range(2))
    save_data = first._save_data

    def interrupted(name: str, data: str) -> None:
        with monkeypatch.context() as stale:
            stale.setattr(second, "_load_index", dict)
            second.save("float", "code for float")
        save_data(name, data)

    monkeypatch.setattr(first, "_save_data", interrupted)
    first.save("int", "code for int")
    assert first.load("float") == "code for float"
    assert second.load("int") in ("code for int", None)


@pytest.fixture
def heard(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setattr(compile_report, "_report", str)
    lines: list[str] = []
    announce_compilation(lines.append)
    return lines


def _times(*times: float) -> Iterator[float]:
    yield from times


def test_compile_progress_long_compilation_reports_periodically(heard: list[str]) -> None:
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


def test_compiled_switched_off_by_settings_file_of_numba_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("yaml")  # else numba reads no such file
    (tmp_path / ".numba_config.yaml").write_text("disable_jit: 1\n")
    run = [sys.executable, "-c", "from drivers.base.compiled import compiled\ncompiled(abs)"]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(TOP)}
    ended = subprocess.run(
        run, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert ended.returncode == 1
    assert "set NUMBA_DISABLE_JIT=1" in ended.stderr
