"""Counters of the kernel for the calling thread: they say why a tick was late."""

from __future__ import annotations

import os
import resource
from typing import NamedTuple, Self

from bench.processes.tick_timing import Stall


class ThreadUsage(NamedTuple):
    """Counters of one thread since its start."""

    page_faults: int = 0
    preemptions: int = 0
    """Times at which another thread took its core while it could run."""
    waited: int = 0
    """Time for which it could run and others did, ns; 0 where the kernel does not say."""


class UsageReader:
    """Reader of the counters of the thread that made it; a context manager."""

    def __init__(self) -> None:
        try:
            self._waits = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
        except OSError:  # a kernel without scheduler statistics
            self._waits = -1

    def read(self) -> ThreadUsage:
        """Return the counters now; takes some microseconds."""
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        waited = int(os.pread(self._waits, 64, 0).split()[1]) if self._waits >= 0 else 0
        return ThreadUsage(usage.ru_minflt + usage.ru_majflt, usage.ru_nivcsw, waited)

    def close(self) -> None:
        """Close the kernel's file. May be called twice."""
        if self._waits >= 0:
            os.close(self._waits)
            self._waits = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def stall_between(before: ThreadUsage, after: ThreadUsage, delay: int, work: int, period: int) -> Stall:
    """Return why a tick was late by `delay`, ns, from the counters shortly before and after it.

    `work` is the time (ns) that the tick before took, `period` that of the loop. Where the kernel does not
    say how long the thread waited for others, a preemption in between explains the delay.
    """
    waited = after.waited - before.waited
    if 2 * waited >= delay or (not after.waited and after.preemptions > before.preemptions):
        return Stall.PREEMPTION
    if after.page_faults > before.page_faults:
        return Stall.PAGE_FAULT
    return Stall.LONG_TICK if work > period else Stall.MACHINE
