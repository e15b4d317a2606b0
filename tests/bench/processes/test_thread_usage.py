"""The kernel's counters of a thread, and what they say of a late tick."""

from __future__ import annotations

import mmap
import time

import pytest

from bench.processes.loop_process import ThreadUsage, UsageReader, stall_between
from bench.processes.tick_timing import Stall

MS = 1_000_000
BEFORE = ThreadUsage(page_faults=7, preemptions=3, waited=5 * MS)


@pytest.mark.parametrize(
    ("after", "work", "stall"),
    [
        (BEFORE._replace(waited=8 * MS), MS // 10, Stall.PREEMPTION),
        (BEFORE._replace(waited=8 * MS, page_faults=9), MS // 10, Stall.PREEMPTION),
        (BEFORE._replace(page_faults=8), MS // 10, Stall.PAGE_FAULT),
        (BEFORE, 3 * MS, Stall.LONG_TICK),
        (BEFORE, MS // 10, Stall.MACHINE),
        (BEFORE._replace(preemptions=4), MS // 10, Stall.MACHINE),  # a short one does not explain 4 ms
    ],
)
def test_a_late_tick_says_why(after: ThreadUsage, work: int, stall: Stall) -> None:
    assert stall_between(BEFORE, after, 4 * MS, work, MS) is stall


def test_without_times_of_the_kernel_a_preemption_explains() -> None:
    before = ThreadUsage(page_faults=7, preemptions=3)
    assert stall_between(before, before._replace(preemptions=4), 4 * MS, 0, MS) is Stall.PREEMPTION


def test_page_faults_of_this_thread_are_counted() -> None:
    with UsageReader() as reader, mmap.mmap(-1, 64 * mmap.PAGESIZE) as fresh:
        before = reader.read()
        for page in range(64):
            fresh[page * mmap.PAGESIZE] = 1
        time.sleep(0.001)
        after = reader.read()
    assert after.page_faults > before.page_faults
    assert after.waited >= before.waited
    reader.close()
