"""What each process of a bench imports and holds: heavy packages by process, and memory when it is ready."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.base.compiled import PLAIN
from tests.running_bench import BenchProcess, running_bench, write_configuration

TOP = Path(__file__).resolve().parents[3]
MEBIBYTE = 1 << 20

CALCULATES = frozenset({"llvmlite", "numba", "scipy"})
ALLOWED = {
    "bench.supervisor.daemon": CALCULATES | {"sqlalchemy", "zenoh"},
    "bench.supervisor.loop_process": CALCULATES,
    "bench.supervisor.recorder": {"pyarrow"},
    "bench.supervisor.publisher": {"pyarrow", "zenoh"},
    "bench.supervisor.launch_monitor": {"asyncio"},
}
"""Modules of the processes with the heavy packages that each may import; numba imports the top of scipy.

The recorder computes the shots in plain Python: the supervisor's heartbeat must not wait for them."""
PLAIN_PROCESSES = {"bench.supervisor.recorder", "bench.supervisor.launch_monitor"}
"""Processes that are started without compilation."""
HEAVY = frozenset(
    {
        *CALCULATES,
        "PIL",
        "asyncio",
        "can",
        "canopen",
        "cryptography",
        "dask",
        "filterpy",
        "jinja2",
        "matplotlib",
        "mcap",
        "pandas",
        "pyarrow",
        "pydantic",
        "rerun",
        "rich",
        "sqlalchemy",
        "starlette",
        "typer",
        "zenoh",
    }
)
SUPERVISOR_LOADS = {"asyncio"}
"""By sqlalchemy."""

MAX_LOCKED, MAX_BENCH = 160 * MEBIBYTE, 460 * MEBIBYTE
"""Locked memory of the loop and memory of all processes, bytes, both proportional: pages that others map are
divided among them, so a bench that runs alone has the largest values."""


@pytest.mark.slow
@pytest.mark.parametrize("module", ALLOWED)
def test_process_imports_only_allowed_heavy_packages(module: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code],
        cwd=TOP,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, PLAIN: str(int(module in PLAIN_PROCESSES))},
    ).stdout.split()
    found = {name.partition(".")[0] for name in loaded} & HEAVY
    assert found <= ALLOWED[module] | (SUPERVISOR_LOADS if module == "bench.supervisor.daemon" else set())
    assert not {"scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.signal"} & set(loaded)


def _rollup(pid: int) -> dict[str, int]:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    fields = (line.split() for line in lines if line.endswith(" kB"))
    return {name.rstrip(":"): int(value) << 10 for name, value, _ in fields}


def _libraries(pid: int) -> set[str]:
    """Return the packages of site-packages whose libraries a process has mapped."""
    mapped = {line.split()[-1] for line in Path(f"/proc/{pid}/maps").read_text().splitlines()}
    return {path.split("site-packages/")[1].partition("/")[0] for path in mapped if "site-packages/" in path}


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BenchProcess]:
    """Yield a bench that was started when all code was compiled: who compiles holds more."""
    file = write_configuration(tmp_path_factory.mktemp("memory"), "memory")
    with running_bench(file):
        pass
    with running_bench(file) as bench:
        yield bench


@pytest.mark.live
@pytest.mark.paced
def test_running_process_maps_only_allowed_libraries(bench: BenchProcess) -> None:
    assert not _libraries(bench.pid("recorder")) & {"llvmlite", "numba", "pandas", "scipy", "zenoh"}
    assert not _libraries(bench.pid("publisher")) & {"llvmlite", "numba", "pandas", "scipy"}
    assert not _libraries(bench.pid("loop")) & {"pandas", "pyarrow", "zenoh"}
    maps = Path(f"/proc/{bench.pid('loop')}/maps").read_text()
    assert "site-packages/numba/" in maps
    assert not re.search(r"site-packages/scipy/(optimize|signal|sparse|stats)/", maps)  # by filterpy


@pytest.mark.live
@pytest.mark.paced
def test_ready_bench_stays_within_memory_limits(bench: BenchProcess) -> None:
    names = ("supervisor", *bench.client.status()["processes"])
    held = {name: _rollup(bench.pid(name)) for name in names}
    assert held["loop"]["Locked"] < MAX_LOCKED
    assert sum(one["Pss"] for one in held.values()) < MAX_BENCH
