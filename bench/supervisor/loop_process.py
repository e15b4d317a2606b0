"""The loop process: one thread with driver, control numerics and a ring write.

`python -m bench.supervisor.loop_process` reads a pickled LoopPlan on stdin and writes JSON lines on stdout:

`ready`      `real_time` (requested and granted settings), `tick_ns` (median of the warm-up)
`failed`     `location`, `found`, `expected`, `action`, `exit_code`: it cannot work
`exception`  `text`: a tick failed, the passive command was sent in it
`device`     `fault`, `counters`: why the device is not operational, its counters; once a second on change
`ended`      `reason`

It ends on SIGTERM, by order of its supervisor, or when the supervisor is gone; but never before the robot is
at rest.
"""

from __future__ import annotations

import os
import resource
import sys
import time as wall
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from bench.base.clock import GridClock, PacedClock
from bench.base.errors import BenchError, Refused
from bench.base.lifecycle import Answer, Phase, Request, State
from bench.config import Configuration
from bench.control.settings import build_controller, with_correction
from bench.loop.compile_ahead import compile_ahead
from bench.loop.loop import Cycle
from bench.loop.snapshot import SNAPSHOT, pack_snapshot
from bench.records.telemetry.encoder_preset import Shifts, moved_zero, write_shifts
from bench.records.telemetry.ring import RingWriter, ring_capacity
from bench.supervisor._supervision import SUPERVISION_FILE, CorrectionReader, Orders
from bench.supervisor._tick_timing import TickTiming, check_budget, create_timing, new_timing
from bench.supervisor._timing_record import Stall
from bench.supervisor.child_process import (
    RING_FILE,
    SNAPSHOT_FILE,
    TIMING_FILE,
    LoopPlan,
    Parent,
    read_plan,
    send_event,
    send_failure,
)
from bench.supervisor.ownership import adopt
from bench.supervisor.real_time import real_time
from drivers.base import Driver, DriverError
from drivers.base.compile_report import progress
from drivers.base.compiled import new_record, numbers
from drivers.base.machine_code import cache_folder
from drivers.base.shared_memory import SharedMemoryError, SharedRecord
from drivers.registry import choose_driver, find_drivers
from sim.driver import PacedPlantDriver


class ThreadUsage(NamedTuple):
    """Counters of one thread since its start."""

    page_faults: int = 0
    preemptions: int = 0
    """Times at which another thread took its core while it could run."""
    waited: int = 0
    """Time for which it could run and others did, ns; 0 where the kernel does not say."""


@contextmanager
def usage_reader() -> Iterator[Callable[[], ThreadUsage]]:
    """Yield what returns the counters of this thread now; a call takes some microseconds."""
    try:
        waits = os.open("/proc/thread-self/schedstat", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:  # a kernel without scheduler statistics
        waits = -1

    def read() -> ThreadUsage:
        usage = resource.getrusage(resource.RUSAGE_THREAD)
        waited = int(os.pread(waits, 64, 0).split()[1]) if waits >= 0 else 0
        return ThreadUsage(usage.ru_minflt + usage.ru_majflt, usage.ru_nivcsw, waited)

    try:
        yield read
    finally:
        if waits >= 0:
            os.close(waits)


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


WARM_UP = 200
"""Warm-up ticks before READY, in which all code is compiled, paged in and measured."""
_MEASURED = 8
"""Max times that they are measured: the bench's other processes start meanwhile, and take the processors."""

_MOTIONS = frozenset({Request.HOME, Request.ARM, Request.SWING})
_RESTING = frozenset({Phase.STANDING, Phase.HOLD})
_MAX_FAILED_TICKS = 20
"""Max consecutive failed ticks for reasons other than the device."""
_BETWEEN_REPORTS = 1000
"""Consecutive failed ticks between two reports."""
_STOP_TIMEOUT = 15.0
"""Time-out for bringing the robot to rest after the order to end, s."""
_POLL_TICKS = 50
"""Ticks between two checks of the parent."""


def configured_driver(c: Configuration, folder: Path) -> Driver:
    """Return the driver of configuration `c`, closed; a simulated one has its files in `folder`.

    Raises:
        DriverError: it is not installed, or broken.
    """
    settings = c.driver
    if settings.name == "sim":
        return PacedPlantDriver(folder, c.plant, faults=tuple(c.faults.values()), watchdog=settings.watchdog)
    return choose_driver(settings.name, find_drivers())(**c.driver_arguments())


class LoopProcess:
    """The loop of a running bench."""

    def __init__(self, plan: LoopPlan, parent: Parent) -> None:
        """Build driver and controller without opening anything.

        Raises:
            DriverError: the driver is not installed, or broken.
        """
        c = plan.configuration
        self.plan, self.parent = plan, parent
        self.period = 1.0 / c.loop.rate
        self._period_ns = round(1e9 / c.loop.rate)
        self.driver = configured_driver(c, plan.folder)
        self.paced = c.driver.paced
        self._faulty = self.driver if c.faults and isinstance(self.driver, PacedPlantDriver) else None
        self.parameters = build_controller(
            c.plant,
            plan.profile,
            c.control,
            c.envelope,
            c.estimator,
            c.lifecycle,
            c.homing,
            read_only=plan.read_only,
        )
        self._snapshot = new_record(SNAPSHOT)
        self._failures = 0
        self._fault = ""
        self._reported_device: tuple[str, dict[str, int]] = "", {}

    def compile(self) -> None:
        """Compile all code, with the device open and passive.

        Raises:
            DriverError: the device is unsuitable.
        """
        self._open_driver()
        with ExitStack() as stack:
            stack.callback(self.driver.close)
            stack.callback(self._make_passive)
            self._compile()

    def run(self) -> str:
        """Warm up the compiled code, report ready, run until stopped; return the reason of the end.

        Raises:
            BenchError: real time is required and not granted, the ticks are too long, or a shared file is
                missing.
            DriverError: the device is unsuitable, or every tick fails.
        """
        c, folder = self.plan.configuration, self.plan.folder
        with ExitStack() as stack:
            stack.enter_context(adopt(self.plan.lock))
            ring = RingWriter(folder / RING_FILE, ring_capacity(c.loop.rate))
            stack.callback(ring.close)
            self.orders = Orders(folder / SUPERVISION_FILE, c.lifecycle.supervisor_timeout)
            stack.callback(self.orders.close)
            self.snapshots = SharedRecord.create(folder / SNAPSHOT_FILE, SNAPSHOT)
            stack.callback(self.snapshots.close)
            self.corrections = CorrectionReader(folder, self.plan.profile, self.plan.basis)
            stack.callback(self.corrections.close)
            self.timing = create_timing(folder / TIMING_FILE, self._period_ns)
            stack.callback(self.timing.close)
            name, note_truth = c.driver.name, getattr(self.driver, "note_truth", None)
            self.cycle = Cycle(
                self.driver, self.parameters, ring, name=name, note_truth=note_truth, state=State.STARTING
            )
            self.cycle.state.control["first_cause"] = self.plan.first_cause
            self._bind()
            stack.callback(self.driver.close)
            stack.callback(self._make_passive)
            granted = stack.enter_context(
                real_time(c.loop.realtime, priority=c.loop.priority, cpu=c.loop.cpu)
            )
            self._open_driver()
            self._read_usage = stack.enter_context(usage_reader())
            clock = PacedClock(self.period) if self.paced else GridClock(self._period_ns)
            self._warm_up(clock)
            self._used_before = self._used = self._read_usage()
            send_event("ready", real_time=granted, tick_ns=self.tick_ns)
            return self._live(clock)

    def _bind(self) -> None:
        """Look up the fields that every tick needs: by name each costs a microsecond."""
        control, record = self.cycle.state.control, self.cycle.record
        self._phase, self._request, self._warm = (
            numbers(control[k]) for k in ("phase", "request", "is_warmed_up")
        )
        self._wake_latency, self._work_time = numbers(record["wake_latency"]), numbers(record["work_time"])
        self._answer, self._answered = numbers(record["answer"]), numbers(record["request"])
        self._marks = numbers(self.cycle.marks)

    def _compile(self) -> None:
        """Run one unrecorded tick to compile all code."""
        with compile_ahead():
            spare = Cycle(self.driver, self.parameters, lambda _: None, name="warm-up", state=State.STARTING)
        first = 0.0 if self.paced else wall.monotonic()
        spare.run_tick(first)
        spare.latch_exception(first)  # a tick that fails must not wait for a compiler either
        with closing(Orders(self.plan.folder / SUPERVISION_FILE, 0.0)) as orders:
            orders.put(spare.state.control, first)
        begin = int(spare.marks[0])
        TickTiming(new_timing(self._period_ns)).note(spare.marks, begin, begin)

    def _warm_up(self, clock: GridClock | PacedClock) -> None:
        """Run the ticks of STARTING, in which nothing can move, until they keep to their share of the period.

        Raises:
            Refused: they exceed it each time.
        """
        durations = np.zeros((WARM_UP, len(self.cycle.marks)), np.int64)
        for tries_left in reversed(range(_MEASURED)):
            for k in range(WARM_UP):
                self._tick(clock)
                durations[k] = self.cycle.marks
            if self.paced:
                break
            try:
                check_budget(durations, self._period_ns)
                break
            except Refused:
                if not tries_left:
                    raise
        self.tick_ns = median((durations[:, -1] - durations[:, 0]).tolist())
        self.cycle.state.control["is_warmed_up"] = True

    def _live(self, clock: GridClock | PacedClock) -> str:
        """Run ticks until a stop is requested and the robot is at rest; return the reason of the end."""
        control, reason, last = self.cycle.state.control, "", np.inf
        tick, ticks_a_second = 0, round(1.0 / self.period)
        while True:
            time = self._tick(clock)
            tick += 1
            if tick % ticks_a_second == 0:
                self._report_device()
            if tick % _POLL_TICKS and not reason:
                continue
            self._note_usage()
            if not reason and (reason := self._reason_to_end()):
                last = time + _STOP_TIMEOUT
                if self.parent.gone:
                    self.orders.declare_supervisor_dead()
                else:
                    self.orders.stop()
            if reason and (control["phase"][0] == Phase.STANDING or time > last):
                return reason

    def _reason_to_end(self) -> str:
        if self.orders.shutdown:
            return "ordered by its supervisor"
        if self.parent.stop_requested:
            return "SIGTERM"
        return "its supervisor is gone" if self.parent.gone else ""

    def _tick(self, clock: GridClock | PacedClock) -> float:
        """Run one tick; a failed tick has made the driver passive and is reported."""
        time = clock.wait()
        cycle = self.cycle
        marks = cycle.marks
        self._wake_latency[0] = 1e-9 * (clock.woke - clock.due)
        self._work_time[0] = 1e-9 * (self._marks[-1] - self._marks[0])
        if self._faulty is not None:  # faults with an onset by phase
            self._faulty.phase = self._phase[0]
        self.orders.put(cycle.state.control, time)
        if self._request[0] == Request.RESET and self._phase[0] == Phase.STANDING:
            try:
                self._revive()  # reactivate a passive device before the reset is evaluated
            except DriverError as error:
                self._fault = str(error)
                send_event("exception", text=f"reset: {error}")
        try:
            cycle.run_tick(time)
        except Exception as error:  # numerics or driver may fail in any way
            if self._failures % _BETWEEN_REPORTS == 0:
                send_event("exception", text=f"{type(error).__name__}: {error}")
            self._failures += 1
            # A lost device leaves the bench in FAULT, where it answers commands; a reset retries the device.
            is_away = isinstance(error, DriverError) and bool(self._warm[0])
            if self._failures >= _MAX_FAILED_TICKS and not is_away:
                raise
            return time
        self._failures = 0
        self._watch_device()
        if self.corrections.is_ordered:
            self._correct()
        if delay := self.timing.note(marks, clock.due, clock.woke):
            self._explain(delay)
        if self._answer[0] == Answer.ACCEPTED and self._answered[0]:
            self._note_request(Request(self._answered[0]))
        return time

    def _note_usage(self) -> None:
        """Read the counters of this thread and publish them."""
        self._used = used = self._read_usage()
        first = self._used_before
        self.timing.note_usage(used.page_faults - first.page_faults, used.preemptions - first.preemptions)

    def _explain(self, delay: int) -> None:
        """Count why the tick was late by `delay`, ns; not in the warm-up, in which nothing can move."""
        if self._warm[0]:
            before = self._used
            self._note_usage()
            work = round(1e9 * self._work_time[0])
            self.timing.note_stall(stall_between(before, self._used, delay, work, self._period_ns))

    def _correct(self) -> None:
        """Apply an ordered correction between swings.

        A correction does not change the address, so nothing jumps.
        """
        control = self.cycle.state.control
        taken = self.corrections.take(
            int(control["tick"][0]), resting=control["phase"][0] in _RESTING and not control["swinging"][0]
        )
        if taken is not None:
            c = self.plan.configuration
            self.cycle.parameters = with_correction(
                self.cycle.parameters, taken, c.control, c.envelope, c.plant
            )

    def _watch_device(self) -> None:
        """Report why the device went passive, if its driver knows."""
        fault = getattr(self.driver, "fault", "")
        if fault and fault != self._fault:
            send_event("exception", text=f"device went passive: {fault}")
        if fault != self._fault:
            self._fault = fault
            self._report_device()

    def _report_device(self) -> None:
        counters = getattr(self.driver, "counters", None)
        status = self._fault, {} if counters is None else counters.counts()
        if status != self._reported_device:
            self._reported_device = status
            send_event("device", fault=status[0], counters=status[1])

    def _note_request(self, request: Request) -> None:
        """Store the controller's state at the start of a motion."""
        if request in _MOTIONS:
            pack_snapshot(self.cycle.state, self._snapshot)
            self.snapshots.write(self._snapshot)

    def _revive(self) -> None:
        """Reopen a device that went passive; the robot is at rest, missed ticks are counted.

        A device may take seconds to store its settings, in which no tick shows that the loop lives.

        Raises:
            DriverError: the device is unsuitable.
        """
        if not self.driver.operational:
            send_event("reopening")
            try:
                self._reopen()
            finally:
                send_event("reopened")

    def _reopen(self) -> None:
        self.driver.close()
        self._open_driver()

    def _open_driver(self) -> None:
        """Open the device; it stays closed if a calibrated zero has moved, unless nothing can move anyway.

        Raises:
            DriverError: the device is unsuitable.
        """
        self.driver.open()
        found: Shifts | None = getattr(self.driver, "zero_shifts", None)
        if found is None:
            return
        write_shifts(self.plan.folder, found)
        if self.plan.calibrated is None or self.plan.read_only:
            return
        for joint, shift in enumerate(found):
            if reason := moved_zero(joint, shift, self.plan.calibrated):
                self.driver.close()
                raise DriverError(reason)

    def _make_passive(self) -> None:
        """Send the passive command several times, as a frame on a bus may be lost."""
        for _ in range(3):
            self.driver.make_passive()


COMPILED = "--compiled"
"""Argument of the process after it has compiled, before the process ID of the supervisor."""


def _start_again(parent: Parent) -> None:
    """Replace this program by a new one with the same plan; return where the machine code was not kept."""
    if not os.access(cache_folder(), os.W_OK):
        return
    command = [sys.executable, "-P", "-m", "bench.supervisor.loop_process", COMPILED, str(parent.pid)]
    with suppress(OSError):
        os.lseek(0, 0, os.SEEK_SET)
        os.execv(sys.executable, command)  # noqa: S606 - this very program


def main() -> int:
    """Run the loop of the plan on stdin; return the exit code.

    A process that had to compile starts again, once: else the compiler's memory, four times that of the loop,
    would be locked.
    """
    again = sys.argv[1:2] == [COMPILED]
    parent = Parent(int(sys.argv[2]) if again else 0)
    plan: Any = read_plan()
    parent.listen()
    try:
        process = LoopProcess(plan, parent)
        process.compile()
        if progress.compiled and not again and not parent.wants_end:
            _start_again(parent)
        reason = process.run()
    except (BenchError, SharedMemoryError, DriverError) as error:
        return send_failure(error)
    send_event("ended", reason=reason)
    return 0


if __name__ == "__main__":
    sys.exit(main())
