"""The loop's timing against `cyclictest`, in alternating pairs with the other core loaded.

    python -m tests.benchmarks loop_timing --pairs 20 --seconds 15 --rate 1000

Long, so only by name. A pair is one run of the loop process against simulated CANopen nodes, swinging all
the time, and one of `cyclictest` at the same priority, interval and core; which comes first changes from pair
to pair. A busy process holds another core throughout. Percentiles of both are rounded up to their resolution:
1 us for `cyclictest`, a sixteenth for the loop. Late: a wake-up later than 1 ms, at any rate. Steal is the
time the hypervisor took from the loop's core, in ticks of the kernel's accounting (10 ms).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from bench.base.lifecycle import Request, State
from bench.commands.bench.simulators import nodes_plan
from bench.commands.common import progress_bar
from bench.config import Configuration, load_configuration
from bench.supervisor._loop_link import LoopLink
from bench.supervisor._timing_record import SEGMENTS, TIMING, TimingReader, percentile, summary
from bench.supervisor.child_process import TIMING_FILE, Child, LoopPlan
from bench.supervisor.ownership import take_bench
from bench.supervisor.real_time import PRIORITY
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.benchmarks.row import Row
from tests.ready_child import ready_child

HISTOGRAM_US = 20_000
"""Latencies from here on are counted together."""


class Latencies(NamedTuple):
    """Wake-up latencies of one run, us; percentiles round up to the resolution."""

    wake_ups: int
    p50: float
    p99: float
    p999: float
    longest: float
    late: int
    """From 1 ms on."""


def run_cyclictest(seconds: int, interval_us: int, priority: int, cpu: int) -> Latencies:
    """Run it for `seconds` with one thread on core `cpu`.

    Raises:
        RuntimeError: it is not installed, not permitted, or says something unknown.
    """
    program = shutil.which("cyclictest")
    if program is None:
        raise RuntimeError("no cyclictest on the PATH; Debian: apt-get install rt-tests")
    options = f"-q -m -a {cpu} -t1 -p {priority} -i {interval_us} -D {seconds} -h {HISTOGRAM_US}"
    answer = subprocess.run(
        [program, *options.split()], capture_output=True, text=True, check=False, cwd=Path("/")
    )
    if answer.returncode:
        raise RuntimeError(f"cyclictest ended with {answer.returncode}: {answer.stderr.strip()}")
    return read_histogram(answer.stdout)


def read_histogram(output: str) -> Latencies:
    """Return the latencies in `output` of cyclictest -h.

    Raises:
        RuntimeError: it contains none.
    """
    count: NDArray[np.int64] = np.zeros(HISTOGRAM_US + 1, np.int64)
    longest = 0
    for line in output.splitlines():
        if line.startswith("# Max Latencies:"):
            longest = int(line.split(":")[1])
        elif line.startswith("# Histogram Overflows:"):
            count[HISTOGRAM_US] += int(line.split(":")[1])
        elif line and not line.startswith("#"):
            microseconds, number = map(int, line.split())
            count[microseconds] += number
    total = int(count.sum())
    if not total:
        raise RuntimeError(f"cyclictest counted nothing: {output[:200]!r}")
    # Its buckets are whole microseconds rounded down: a latency lies below the next one.
    ranks = [np.ceil(share * total - 1e-9) for share in (0.5, 0.99, 0.999)]
    p50, p99, p999 = (float(min(edge + 1, longest + 1)) for edge in np.searchsorted(np.cumsum(count), ranks))
    return Latencies(total, p50, p99, p999, float(longest + 1), int(count[1000:].sum()))


START = 180.0
"""s that compiling may take."""
TIMEOUT = 120.0
"""s in which the robot should be at its address."""
PLANT_RATE = 4000.0
"""Hz of the plant's internal steps at the shipped 1 kHz; kept at higher rates."""
_TURN = 0.02

_NEXT = {
    State.ESTOP: Request.RESET,
    State.FAULT: Request.RESET,
    State.SAFE: Request.HOME,
    State.READY: Request.ARM,
    State.ARMED: Request.SWING,
}
"""The supervisor's request in each state; elsewhere it waits."""


class RunningLoop:
    """A loop at work. `turn` keeps it swinging and must be called many times a second."""

    def __init__(self, link: LoopLink, loop: Child, timing: TimingReader) -> None:
        self.link, self.loop, self.timing = link, loop, timing
        self.swings = 0
        self.stops = 0
        """Recovered faults and emergency stops after the first."""
        self._state = State.STARTING

    def turn(self) -> State:
        """Beat, and ask for whatever comes next; return the state of the bench.

        Raises:
            RuntimeError: the loop ended.
        """
        if not self.loop.alive:
            raise RuntimeError(f"the loop {self.loop.ending}")
        self.link.beat(lease=1, support_ready=True)
        state = State[self.link.state]
        if state is State.SWINGING and self._state is not State.SWINGING:
            self.swings += 1
        if state in (State.FAULT, State.ESTOP) and self._state not in (state, State.STARTING):
            self.stops += 1
        self._state = state
        if request := _NEXT.get(state):
            self.link.request(request)
        return state

    def live(self, seconds: float) -> None:
        """Take turns for `seconds`."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.turn()
            time.sleep(_TURN)

    def wait_for_swing(self) -> None:
        """Take turns until the first swing.

        Raises:
            RuntimeError: there is none within TIMEOUT.
        """
        end = time.monotonic() + TIMEOUT
        while self.turn() is not State.SWINGING:
            if time.monotonic() > end:
                raise RuntimeError(f"no swing within {TIMEOUT:g} s; the bench is in {self._state.name}")
            time.sleep(_TURN)


def configured(rate: float, priority: int, cpu: int) -> Configuration:
    """Return the shipped configuration at `rate` (Hz), real time required, swing following on swing.

    The plant, behind nodes, has its own clock: one in step with the loop would tolerate lateness.
    """
    c = load_configuration(Path("local_can"))
    return replace(
        c,
        canopen=replace(c.canopen, channel=f"benchmark-{os.getpid()}"),
        loop=replace(c.loop, rate=rate, realtime="require", priority=priority, cpu=cpu),
        plant=replace(c.plant, tick=1.0 / rate, substeps=max(1, round(PLANT_RATE / rate))),
        lifecycle=replace(c.lifecycle, hold_between_swings=True, warning_time=0.1),
    ).running()


@contextmanager
def running_loop(configuration: Configuration) -> Iterator[RunningLoop]:
    """Yield a loop that is ready, with its plant; both are ended at the block's end."""
    c = configuration
    with ExitStack() as stack:
        owner = stack.enter_context(take_bench(f"benchmark-{os.getpid()}"))
        link = LoopLink(owner.folder)
        stack.callback(link.close)
        files = Path(stack.enter_context(TemporaryDirectory()))
        stack.callback(ready_child("sim.nodes.process", nodes_plan(c, files), START).end, 2.0)
        profile = load_profile(find_profile(c.swing.profile))
        loop = Child.start(
            "loop",
            "bench.supervisor.loop_process",
            LoopPlan(c, profile, basis_of(profile), owner.folder, owner.descriptor),
            pass_fds=(owner.descriptor,),
        )
        stack.callback(loop.end, 15.0)
        loop.wait_until_ready(START)
        link.connect()
        timing = TimingReader(owner.folder / TIMING_FILE)
        yield RunningLoop(link, loop, timing)


P99_RATIO, P999_RATIO = 1.5, 2.0
"""Largest median ratio of the loop's wake-up latency to cyclictest's."""
LATE_FACTOR, LATE_EXTRA = 2, 5
TICK_US = 150.0
"""99 % of all ticks take at most this, at 1 kHz."""
SHARES = {"p50": "p50", "p99": "p99", "p999": "p99.9", "longest": "max"}
"""Fields of Latencies, and what they are called in print."""

_SUMMED = ("ticks", "skipped", "late", "count")

Timing = np.ndarray[Any, Any]
"""One-element array of TIMING."""


class LoopRun(NamedTuple):
    """One run of the loop."""

    wake_up: Latencies
    skipped: int
    tick_p99: float
    """us."""
    swings: int
    stops: int
    """Recovered faults."""
    steal: int


class Pair(NamedTuple):
    """One run of each."""

    first: str
    loop: LoopRun
    cyclictest: Latencies
    cyclictest_steal: int

    @property
    def steal(self) -> int:
        """Ticks taken from the core in both runs."""
        return self.loop.steal + self.cyclictest_steal

    def ratio(self, share: str) -> float:
        """Return the loop's latency over cyclictest's, at `share` of SHARES."""
        return float(getattr(self.loop.wake_up, share) / getattr(self.cyclictest, share))


# Measuring -------------------------------------------------------------------------------------------


def steal_ticks(cpu: int, stat: str) -> int:
    """Return what `stat`, the text of /proc/stat, says was taken from core `cpu`."""
    line = next(line for line in stat.splitlines() if line.startswith(f"cpu{cpu} "))
    return int(line.split()[8])


def _steal(cpu: int) -> int:
    return steal_ticks(cpu, Path("/proc/stat").read_text())


@contextmanager
def busy_core(cpu: int) -> Iterator[None]:
    """Keep core `cpu` busy with a process of normal priority."""
    program = f"import os; os.sched_setaffinity(0, {{{cpu}}})\nwhile True: pass"
    with subprocess.Popen([sys.executable, "-c", program]) as process:
        try:
            yield
        finally:
            process.kill()


def loop_run(options: argparse.Namespace) -> tuple[LoopRun, Timing]:
    """Return one run of the loop, and what its counters counted in it."""
    with running_loop(configured(options.rate, options.priority, options.cpu)) as loop:
        loop.wait_for_swing()
        swings, stops, steal, before = loop.swings, loop.stops, _steal(options.cpu), loop.timing.snapshot()
        loop.live(options.seconds)
        after, steal = loop.timing.snapshot(), _steal(options.cpu) - steal
        told = summary(after, before)
        swings, stops = loop.swings - swings, loop.stops - stops
    wake_up = told["segments"]["wake_up"]
    latencies = Latencies(
        wake_ups=wake_up["count"],
        p50=wake_up["p50_us"],
        p99=wake_up["p99_us"],
        p999=wake_up["p999_us"],
        longest=wake_up["max_us"],
        late=told["late"],
    )
    run = LoopRun(latencies, told["skipped"], told["segments"]["tick"]["p99_us"], swings, stops, steal)
    counted = after.copy()
    for name in _SUMMED:
        counted[name] -= before[name]
    return run, counted


def measure(options: argparse.Namespace) -> tuple[list[Pair], Timing]:
    """Return the pairs, and the loop's counters summed over all."""
    pairs: list[Pair] = []
    total = np.zeros(1, TIMING)

    def cyclic() -> tuple[Latencies, int]:
        steal, interval = _steal(options.cpu), round(1e6 / options.rate)
        latencies = run_cyclictest(options.seconds, interval, options.priority, options.cpu)
        return latencies, _steal(options.cpu) - steal

    with busy_core(options.busy_cpu), progress_bar() as progress:
        for k in progress.track(range(options.pairs), description="pairs of loop and cyclictest"):
            first = ("loop", "cyclictest")[k % 2]
            before = cyclic() if first == "cyclictest" else None
            run, counted = loop_run(options)
            latencies, steal = before or cyclic()
            for name in _SUMMED:
                total[name] += counted[name]
            total["longest"] = np.maximum(total["longest"], counted["longest"])
            pairs.append(Pair(first, run, latencies, steal))
    return pairs, total


# Judging ---------------------------------------------------------------------------------------------


def median_interval(values: Sequence[float], seed: int = 0) -> tuple[float, float, float]:
    """Return the median of `values` and its 95 % bootstrap interval; NaN when there are none."""
    if not values:
        return (np.nan,) * 3
    drawn = np.random.default_rng(seed).choice(np.array(values), (10_000, len(values)))
    low, high = np.quantile(np.median(drawn, axis=1), (0.025, 0.975))
    return float(np.median(values)), float(low), float(high)


def rows(pairs: list[Pair], total: Timing, rate: float) -> list[Row]:
    """Return the figures of all pairs, with their limits."""
    title = f"loop timing at {rate:g} Hz, {len(pairs)} pairs"
    quiet = [pair for pair in pairs if not pair.steal]
    answer: list[Row] = []

    def add(name: str, value: float, unit: str, note: str = "", at_most: float | None = None) -> None:
        answer.append(Row(title, name, value, unit, note, at_most=at_most))

    def ratio(share: str, chosen: list[Pair], which: str, at_most: float | None = None) -> None:
        median, low, high = median_interval([pair.ratio(share) for pair in chosen])
        note = f"median of {len(chosen)} pairs; 95 % interval {low:.2f} to {high:.2f}"
        if not chosen:
            note, at_most = "there are none: not judged", None
        add(f"{which}, {SHARES[share]} over cyclictest's", median, "", note, at_most)

    ratio("p50", pairs, "all pairs")
    ratio("p99", pairs, "all pairs", P99_RATIO)
    ratio("p999", pairs, "all pairs")
    ratio("p99", quiet, "pairs without steal")
    ratio("p999", quiet, "pairs without steal", P999_RATIO)
    late, theirs = sum(p.loop.wake_up.late for p in pairs), sum(p.cyclictest.late for p in pairs)
    bound = LATE_FACTOR * theirs + LATE_EXTRA
    add("late wake-ups, all pairs together", late, "", f"cyclictest {theirs}", bound)
    add("ticks skipped", sum(p.loop.skipped for p in pairs), "", f"of {int(total['ticks'][0])}")
    for segment, name in enumerate(SEGMENTS):
        count = total["count"][0, segment]
        p50, p99 = (percentile(count, share) / 1000 for share in (0.5, 0.99))
        limit = TICK_US if name == "tick" and rate <= 1000 else None
        longest = total["longest"][0, segment] / 1000
        add(f"{name}, p99", p99, "µs", f"median {p50:.3g}, longest {longest:.4g}", limit)
    return answer


def table(pairs: list[Pair], rate: float) -> Table:
    """Return all pairs, one a line, wake-up latencies in us, loop | cyclictest."""
    shown = Table(title=f"Wake-up latency at {rate:g} Hz, µs: loop | cyclictest", title_justify="left")
    ratios = [f"{name} ratio" for name in ("p99", "p99.9")]
    columns = ("pair", "first", *SHARES.values(), "late", "steal", *ratios)
    for column in (*columns, "skipped", "tick p99", "swings", "stops"):
        shown.add_column(column, justify="right")
    for number, pair in enumerate(pairs, start=1):
        loop, other = pair.loop.wake_up, pair.cyclictest
        both = [f"{getattr(loop, share):.0f} | {getattr(other, share):.0f}" for share in (*SHARES, "late")]
        shown.add_row(
            str(number),
            pair.first,
            *both,
            f"{pair.loop.steal} | {pair.cyclictest_steal}",
            f"{pair.ratio('p99'):.2f}",
            f"{pair.ratio('p999'):.2f}",
            str(pair.loop.skipped),
            f"{pair.loop.tick_p99:.0f}",
            str(pair.loop.swings),
            str(pair.loop.stops),
        )
    return shown


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Measure all pairs and print them; 40 s a pair by default."""
    cores = sorted(os.sched_getaffinity(0))
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks loop_timing",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="rate of the loop")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--seconds", type=int, default=15, help="duration of each run")
    parser.add_argument("--priority", type=int, default=PRIORITY, help="priority of SCHED_FIFO")
    parser.add_argument("--cpu", type=int, default=cores[0], help="the loop's and cyclictest's core")
    parser.add_argument("--busy-cpu", type=int, default=cores[-1], help="the core kept busy")
    options = parser.parse_args(arguments)
    pairs, total = measure(options)
    Console(width=max(132, Console().width)).print(table(pairs, options.rate))
    return rows(pairs, total, options.rate)
