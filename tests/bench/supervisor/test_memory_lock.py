"""The lock of a process' memory: what ticks use is resident, what they do not is given back."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import pytest

from bench.supervisor.real_time import MemoryMapping, memory_mappings
from tests.bench.supervisor.own_process import printed_json

MEBIBYTE = 1 << 20

SMAPS = """\
55d0c0a00000-55d0c0b00000 r-xp 00001000 fe:00 42                         /usr/lib/libllvmlite.so
Rss:                1024 kB
Anonymous:             0 kB
VmFlags: rd ex mr mw me
7f6173c00000-7f6177c00000 rw-p 00000000 00:00 0
Rss:                   8 kB
Anonymous:             8 kB
VmFlags: rd wr mr mw me ac
7f6178000000-7f6178200000 rw-p 00000000 00:00 0                          [heap]
Rss:                2048 kB
Anonymous:          2048 kB
VmFlags: rd wr mr mw me lo ac
7f6179000000-7f6179001000 ---p 00000000 00:00 0
Rss:                   0 kB
Anonymous:             0 kB
VmFlags: mr mw me
7ffd2a5fe000-7ffd2a600000 r--p 00000000 00:00 0                          [vvar]
Rss:                   0 kB
Anonymous:             0 kB
VmFlags: rd mr
"""


def _in_a_process(code: str) -> Any:
    program = """
        import json, mmap, resource
        import numpy as np
        from bench.supervisor.real_time import (
            drop_preparations, lock_memory, locked_memory, memory_mappings, unlock_memory
        )

        def resident(part):
            return sum(m.resident for m in memory_mappings() if part in m.name)
    """
    return printed_json(textwrap.dedent(program) + textwrap.dedent(code))


def test_memory_mappings_reads_and_classifies_smaps(tmp_path: Path) -> None:
    file = tmp_path / "smaps"
    file.write_text(SMAPS)
    compiler, reserve, heap, guard, kernel = memory_mappings(file)
    assert compiler == MemoryMapping(
        0x55D0C0A00000, MEBIBYTE, "r-xp", "/usr/lib/libllvmlite.so", MEBIBYTE, private=0
    )
    assert (reserve.size, reserve.resident, reserve.private) == (64 * MEBIBYTE, 8192, 8192)
    assert compiler.is_of_preparations
    assert reserve.is_reserve
    assert heap.is_locked
    assert [m.is_for_ticks for m in (compiler, reserve, heap, guard, kernel)] == [
        False,
        False,
        True,
        False,
        False,
    ]


def test_drop_preparations_library_still_computes() -> None:
    found = _in_a_process("""
        a = np.random.default_rng(1).normal(size=(90, 90))
        before = np.linalg.inv(a), resident("openblas")
        drop_preparations()
        dropped = resident("openblas")
        same = bool((np.linalg.inv(a) == before[0]).all())
        print(json.dumps(dict(before=before[1], dropped=dropped, same=same)))
    """)
    assert found["same"]
    assert found["dropped"] < 0.5 * found["before"]


@pytest.mark.live
def test_lock_memory_locks_used_pages_and_skips_reserve() -> None:
    found = _in_a_process("""
        reserve = mmap.mmap(-1, 64 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        used = mmap.mmap(-1, 8 << 20)
        before = locked_memory()
        try:
            lock_memory()
        except OSError:
            print("null")
            raise SystemExit from None
        inside = locked_memory()
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for place in range(0, len(used), mmap.PAGESIZE):
            used[place] = 1
        faulted = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - faults
        unlock_memory()
        print(json.dumps(dict(before=before, inside=inside, after=locked_memory(), faulted=faulted)))
    """)
    if found is None:
        pytest.skip("this user may not lock memory")
    assert (found["before"][0], found["before"][2]) == (0, False)
    locked, resident, held = found["inside"]
    assert held
    assert 8 * MEBIBYTE < locked <= resident < 64 * MEBIBYTE
    assert found["faulted"] < 10
    assert (found["after"][0], found["after"][2]) == (0, False)
