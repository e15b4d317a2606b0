"""A loop of nothing but the CANopen driver's tick, and the times that it takes."""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Sequence

import numpy as np

from drivers.base import Command
from drivers.canopen.driver import CanopenDriver
from tests.benchmarks.row import Row
from tests.vm.native_caller import NativeCaller

MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, beacon=True)


class DriverLoop:
    """Ticks of the driver on an absolute grid."""

    def __init__(self, driver: CanopenDriver) -> None:
        self.driver, self.period = driver, driver.period
        self._caller = NativeCaller(driver)
        self.forget()

    def forget(self) -> None:
        """Begin to count anew."""
        self.lateness: list[float] = []
        self.reading: list[float] = []
        self.writing: list[float] = []
        self.sampled: list[float] = []
        self.old = 0
        """Ticks without a new sample of each encoder."""

    def run(self, ticks: int, each: Callable[[int], None] = lambda tick: None) -> None:
        """Run ticks; `each` is called between them."""
        clock, driver, start = time.monotonic, self._caller, time.monotonic() + self.period
        for tick in range(ticks):
            due = start + tick * self.period
            if (early := due - clock()) > 0.0:
                time.sleep(early)
            begun = clock()
            readings = driver.read(begun)
            read = clock()
            driver.write(MOVING)
            self.lateness.append(begun - due)
            self.reading.append(read - begun)
            self.writing.append(clock() - read)
            self.sampled.append(readings.encoder_time[0])
            self.old += max(readings.encoder_age) > 0.5 * self.period
            each(tick)


def in_real_time(priority: int = 80) -> None:
    """Run before everything else, as the loop does, and collect no garbage meanwhile.

    Child processes do not inherit this: they would preempt the nodes.
    """
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    gc.collect()
    gc.disable()


def times(title: str, name: str, durations: Sequence[float]) -> Row:
    """Return median, 99 % and longest of `durations` (s) as a figure in us."""
    p50, p99, longest = 1e6 * np.quantile(durations, [0.5, 0.99, 1.0])
    return Row(title, name, p50, "us", f"median; p99 {p99:.1f}, longest {longest:.1f} us")
