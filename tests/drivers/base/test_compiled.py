"""Machine code is never older than the enums compiled into it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import pytest

TOP = Path(__file__).parents[3]

USER = '''"""A compiled function that takes its constant from an enum."""

from bench.base.lifecycle import Refusal
from drivers.base.compiled import compiled


@compiled
def refusal() -> int:
    return Refusal.SUPPORT
'''


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Return a copy of the packages in which only compiled files speak of compilation."""
    for package in ("bench", "drivers", "sim"):
        shutil.copytree(TOP / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    lifecycle = tmp_path / "bench/base/lifecycle.py"
    lifecycle.write_text(lifecycle.read_text().replace("compiled", "fast"))
    (tmp_path / "bench/control/example.py").write_text(USER)
    return tmp_path


def run(copy: Path) -> tuple[int, int]:
    """Return what the example returns, and how many versions of its machine code there are then."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy),
        "NUMBA_CACHE_DIR": str(copy / "cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    code = "from bench.control.example import refusal; print(refusal())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=copy, env=environment, capture_output=True, text=True, check=True
    )
    return int(done.stdout), len([*(copy / "cache/compiled/bench.control.example").iterdir()])


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_a_changed_enum_in_a_file_without_compiled_functions_is_compiled_again(copy: Path) -> None:
    assert run(copy) == (8, 1)
    assert run(copy) == (8, 1)
    (kept,) = (copy / "cache").rglob("*.nbc")
    lifecycle = copy / "bench/base/lifecycle.py"
    lifecycle.write_text(lifecycle.read_text().replace("    SUPPORT = 8\n", "    SUPPORT = 88\n"))
    assert run(copy) == (88, 2)
    assert kept.exists()


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_machine_code_that_cannot_be_read_is_compiled_again(copy: Path, suffix: str) -> None:
    assert run(copy) == (8, 1)
    (kept,) = (copy / "cache").rglob(f"*.{suffix}")
    for broken in (kept.read_bytes()[:-20], kept.read_bytes().replace(b"numba", b"gonea"), b""):
        kept.write_bytes(broken)
        assert run(copy) == (8, 1)
