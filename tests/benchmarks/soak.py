"""A bench as a user runs it, for hours: growth, losses, lateness, and survival.

`golfbench run --series` in the mode that ships, a swing every quarter of a minute, every ten minutes a
campaign in between; page with a reader, viewer that writes a file, and a status watcher. Once a
minute all processes are sampled. Growth is evaluated over the second half of the time.

With `--set-clock` the date changes during the first campaign and the clock is set back an hour during the
second one (libfaketime, in these processes only); the bench is then started again on the same data.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from bench.base.address import free_port
from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, State
from bench.network.client import BenchClient
from bench.network.lease import MAX_SECONDS
from bench.records.telemetry.record_file import read_swing
from bench.records.telemetry.ring import RingReader
from bench.supervisor.child_process import HEARTBEAT, RING_FILE
from drivers.base.shared_memory import SharedRecord
from tests.benchmarks.process_samples import (
    Growth,
    ProcessFigures,
    figures_of,
    folder_size,
    growths,
    stolen_time,
)
from tests.benchmarks.row import Row
from tests.benchmarks.wall_clock import WallClock
from tests.running_bench import LONGEST_START, BenchProcess, running_bench, write_configuration

LIMITS = {"unique": 1.0, "descriptors": 1.0, "threads": 1.0}
"""Growth an hour that counts as a leak where it is certain: MiB, numbers."""
_UNITS = {"unique": "MiB", "descriptors": "", "threads": ""}
_SETTLES = 30.0
"""s from the start of a campaign to the change of the clock in it."""
_HOUR, _DAY = 3600.0, 86400.0
_AFTER = 4
"""Swings of the bench that is started again."""
_PAGE_VISIT = 300
"""States after which the reader of the page opens it again."""
_ATTEMPTS = 20
"""Attempts to take the lease, five seconds apart."""
_TIMEOUT = 900.0
"""s that a campaign of sixteen shots may take."""


class Sample(NamedTuple):
    """One look at everything."""

    since: float
    """s."""
    processes: dict[str, ProcessFigures]
    figures: dict[str, float]


class Beside:
    """Page with a reader, viewer and status watcher of a bench."""

    def __init__(self, file: Path, folder: Path, environment: dict[str, str]) -> None:
        self._file, self._folder, self._environment = file, folder, environment
        self.port = free_port()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.messages = 0
        """States that the page has sent to its reader."""
        self._over = threading.Event()

    def start(self, stack: ExitStack) -> None:
        """Start all; they end with `stack`."""
        reader = threading.Thread(target=self._read)

        def join() -> None:
            if reader.ident is not None:
                reader.join()

        stack.callback(join)  # the page is gone by then
        commands = {
            "page": ("page", "--port", str(self.port)),
            "viewer": ("view", "--save", str(self._folder / "live.rrd")),
            "watcher": ("status", "--watch", "--json"),
        }
        for name, command in commands.items():
            log = stack.enter_context((self._folder / f"{name}.log").open("ab"))
            out = log if name != "watcher" else stack.enter_context(Path("/dev/null").open("ab"))
            self.processes[name] = process = subprocess.Popen(
                [sys.executable, "-m", "bench", "--config", str(self._file), *command],
                stdout=out,
                stderr=log,
                env=self._environment,
            )
            stack.callback(_end, process)
        _wait(lambda: _answers(self.port), LONGEST_START)
        reader.start()
        stack.callback(self._over.set)

    def _read(self) -> None:
        while not self._over.is_set():
            with suppress(OSError, ValueError):
                for count, _ in enumerate(_states(self.port)):
                    self.messages += 1
                    if self._over.is_set() or count == _PAGE_VISIT:
                        break

    @property
    def ended(self) -> list[str]:
        """Processes that have ended unexpectedly."""
        return [name for name, process in self.processes.items() if process.poll() is not None]


def _answers(port: int) -> bool:
    """Return whether the page answers."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        connection.request("GET", "/")
        return connection.getresponse().status == http.HTTPStatus.OK
    except OSError:
        return False
    finally:
        connection.close()


def _states(port: int) -> Iterator[bytes]:
    """Yield each state that the page streams (JSON)."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)
    try:
        connection.request("GET", "/api/stream")
        response = connection.getresponse()
        while line := response.readline():
            if line == b"event: state\n":
                yield response.readline().removeprefix(b"data: ")
    finally:
        connection.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(60.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class Sampler:
    """Samples bench and companions every `period` (s), in a separate thread."""

    def __init__(self, bench: BenchProcess, beside: Beside, folder: Path, period: float) -> None:
        self._bench, self._beside, self._folder, self._period = bench, beside, folder, period
        self.samples: list[Sample] = []
        self.fault: list[str] = []
        self._over = threading.Event()
        self._began, self._stolen = time.monotonic(), stolen_time()
        self._realtime = time.time() - time.monotonic()
        self._ring = RingReader(bench.folder / RING_FILE)
        self._loop_ahead = self._ahead()

    def _ahead(self) -> float:
        """Return the loop's time less CLOCK_MONOTONIC, s."""
        newest = self._ring.newest()
        assert newest is not None
        return float(newest["time"][0]) - time.monotonic()

    @contextmanager
    def running(self) -> Iterator[None]:
        """Look while the block runs, and once more at its end."""
        thread = threading.Thread(target=self._run)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()
            self._ring.close()

    def _run(self) -> None:
        while True:
            try:
                self.samples.append(self._look())
                print(json.dumps(_plain(self.samples[-1])), file=sys.stderr, flush=True)
            except (BenchError, OSError, ValueError) as error:
                self.fault.append(f"{time.monotonic() - self._began:.0f} s: {error}")
            if self._over.wait(self._period):
                with suppress(BenchError, OSError, ValueError):
                    self.samples.append(self._look())
                return

    def _look(self) -> Sample:
        with BenchClient.connect(
            self._bench.configuration
        ) as client:  # one more session, as scripts open them
            status = client.status()
        pids = {name: child["pid"] for name, child in status["processes"].items()}
        pids |= {"supervisor": self._bench.process.pid}
        pids |= {name: process.pid for name, process in self._beside.processes.items()}
        held = {name: found for name, pid in pids.items() if (found := figures_of(pid))}
        loop = status["loop"]
        figures = {
            "swings": status["swings"],
            "skipped": loop["skipped"],
            "late": loop["late"],
            "page faults": loop["page_faults"],
            "preemptions": loop["preemptions"],
            **{f"stall {name}": count for name, count in loop["stalls"].items()},
            "stolen s": stolen_time() - self._stolen,
            "data MB": folder_size(self._bench.configuration.bench.data_dir),
            "log kB": 1e3 * sum(path.stat().st_size for path in self._folder.glob("*.log")) / 1e6,
            "shared MB": folder_size(self._bench.folder),
            "loop lost s": self._loop_ahead - self._ahead(),
            "clock drift ms": 1e3 * (time.time() - time.monotonic() - self._realtime),
        }
        for name in ("recorder", "publisher"):
            heart = SharedRecord.open(self._bench.folder / f"{name}-heart", HEARTBEAT)
            record = np.zeros(1, HEARTBEAT)
            heart.read(record)
            heart.close()
            figures[f"{name} lost"] = int(record["lost"][0])
        return Sample(time.monotonic() - self._began, held, figures)


def _plain(sample: Sample) -> dict[str, Any]:
    rounded = {name: [round(value, 1) for value in figures] for name, figures in sample.processes.items()}
    return {
        "since": round(sample.since),
        **rounded,
        **{name: round(value, 2) for name, value in sample.figures.items()},
    }


class Course:
    """Actions on the bench, and their results."""

    def __init__(self, bench: BenchProcess, file: Path, environment: dict[str, str]) -> None:
        self._bench, self._file, self._environment = bench, file, environment
        self.stops: list[str] = []
        self.campaigns: list[str] = []
        """Outcome of each campaign; empty: finished."""

    def swing(self, every: float, until: Callable[[], bool]) -> None:
        """Swing once `every` s until `until` says so."""
        bench, due = self._bench, time.monotonic()
        with self._lease():
            while not until():
                try:
                    if bench.client.status()["state"] != "ARMED":
                        bench.recover()
                        bench.client.arm()
                    bench.client.wait_until_armed()
                    before = _swings(bench)
                    bench.swing()
                    # By their number: a busy machine may show the answer when the swing is over.
                    _wait(lambda before=before: _swings(bench) > before)  # type: ignore[misc]
                    bench.wait_until(lambda record: record["state"] != State.SWINGING)
                except (BenchError, TimeoutError) as error:  # also an answer that a busy machine delays
                    self.stops.append(f"{datetime.now():%H:%M:%S} {error}")
                    print(self.stops[-1], file=sys.stderr, flush=True)
                    with suppress(BenchError, TimeoutError):
                        lies = bench.cause == Cause.GROUND.name
                        bench.recover()
                        if lies:  # a head that rests on the ground is lifted by homing only
                            bench.client.home()
                            bench.client.wait_for("READY")
                due = max(due + every, time.monotonic())
                while time.monotonic() < due and not until():
                    time.sleep(0.1)

    @contextmanager
    def _lease(self) -> Iterator[None]:
        """Hold the lease; the previous holder may still have to release it."""
        with ExitStack() as stack:
            for attempt in range(_ATTEMPTS):
                try:
                    stack.enter_context(self._bench.client.lease("soak", MAX_SECONDS))
                    break
                except BenchError:
                    if attempt == _ATTEMPTS - 1:
                        raise
                    time.sleep(5.0)
            yield

    def campaign(self) -> None:
        """Run the campaign of sixteen shots that ships."""
        command = [sys.executable, "-m", "bench", "--config", str(self._file), "campaign", "run", "two-balls"]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, env=self._environment, timeout=_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            self.campaigns.append(f"no end within {_TIMEOUT:g} s")
            return
        self.campaigns.append("" if done.returncode == 0 else f"{done.returncode}: {done.stderr[-300:]}")


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Soak for `--minutes`; print each sample, return the verdict."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks soak",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--minutes", type=float, default=240.0)
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="rate of the loop")
    parser.add_argument("--every", type=float, default=15.0, metavar="S", help="between two swings")
    parser.add_argument("--campaigns", type=float, default=10.0, metavar="MIN", help="between two of them")
    parser.add_argument("--sample", type=float, default=60.0, metavar="S", help="between two looks")
    parser.add_argument("--set-clock", action="store_true", help="change the date, set the clock back")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep all files there")
    options = parser.parse_args(arguments)
    with ExitStack() as stack:
        folder = options.keep or Path(stack.enter_context(TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        return _soak(options, folder)


def _soak(options: argparse.Namespace, folder: Path) -> list[Row]:
    text = f"[loop]\nrate_hz = {options.rate:g}\n" if options.rate != 1000.0 else ""
    file = write_configuration(folder, "soak", text)
    clock = WallClock(folder) if options.set_clock else None
    environment = {} if clock is None else clock.environment
    title = f"soak of {options.minutes:g} min at {options.rate:g} Hz"
    with ExitStack() as stack:
        bench = stack.enter_context(running_bench(file, "--series", **environment))
        beside = Beside(file, folder, {**os.environ, **environment})
        beside.start(stack)
        course = Course(bench, file, {**os.environ, **environment})
        sampler = Sampler(bench, beside, folder, options.sample)
        with sampler.running():
            _go_through(options, course, clock)
        ended = beside.ended
        lost_by_viewer = _end_viewer(beside, folder)
        swings, log = _swings(bench), bench.log
        code = bench.end()
        records = _records(bench)
    for text in (*course.stops, *sampler.fault, *filter(None, course.campaigns)):
        print(text)
    found = [read_swing(path)[1] for path in records]
    whole = [one for one in found if one["kind"] == "swing"]
    first, last = sampler.samples[0].figures, sampler.samples[-1].figures
    seconds = sampler.samples[-1].since - sampler.samples[0].since
    spent = sampler.samples[-1].processes["loop"].processor - sampler.samples[0].processes["loop"].processor

    def row(name: str, value: float, unit: str = "", note: str = "", at_most: float | None = None) -> Row:
        return Row(title, name, value, unit, note, at_most=at_most)

    failed = [text for text in course.campaigns if text]
    rows = [
        row("swings", swings, note=f"{len(course.stops)} stops by the bench itself"),
        row("swings without a record", swings - len(whole), at_most=0),
        row("records that are not complete", sum(not one["complete"] for one in whole), at_most=0),
        row("shots of one id", len(whole) - len({one["shot_id"] for one in whole}), at_most=0),
        row("records lost on the way", sum(one["lost_records"] for one in found), at_most=0),
        row("records lost by the publisher", last["publisher lost"] - first["publisher lost"], at_most=0),
        row("batches lost by the viewer", lost_by_viewer, at_most=0),
        row("campaigns that did not finish", len(failed), "", f"of {len(course.campaigns)}", 0),
        row("processes that ended unexpectedly", len(ended), "", ", ".join(ended), 0),
        row("errors in the log of the bench", len(re.findall(r"ERROR|Traceback|restarting", log)), at_most=0),
        row("exit code", code, at_most=0),
        row("the loop's process, of a processor", 100.0 * spent / seconds, "%"),
        row("ticks skipped", last["skipped"], "", _why(last)),
        row("late ticks", last["late"], "", f"{last['page faults']:.0f} page faults of the loop"),
        row("loop behind CLOCK_MONOTONIC", last["loop lost s"], "s", "waits of the simulated robot"),
        row("CLOCK_REALTIME against CLOCK_MONOTONIC", last["clock drift ms"], "ms"),
        row("states that the page sent to its reader", beside.messages),
        row("data on the disk a swing", last["data MB"] / max(1, swings), "MB"),
        *leaks(title, sampler.samples),
    ]
    if clock is not None:
        rows += _after_the_change(options, file, clock, title, records)
    return rows


def _wait(holds: Callable[[], bool], longest: float = 30.0) -> None:
    deadline = time.monotonic() + longest
    while not holds():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{longest} s were not enough")
        time.sleep(0.05)


def _swings(bench: BenchProcess) -> int:
    """Return the number of swings; a busy machine may need several questions."""
    for _ in range(_ATTEMPTS):
        with suppress(BenchError):
            return bench.client.status()["swings"]
    return bench.client.status()["swings"]


def _records(bench: BenchProcess) -> list[Path]:
    """Return the records of all swings and stops; a campaign keeps those of its shots in its own folder."""
    return sorted(bench.configuration.bench.data_dir.rglob("*.parquet"))


def _why(last: dict[str, float]) -> str:
    stalls = {name.removeprefix("stall "): int(n) for name, n in last.items() if name.startswith("stall ")}
    words = ", ".join(f"{count} {name}" for name, count in stalls.items())
    return f"{words}; {last['preemptions']:.0f} preemptions; {last['stolen s']:.1f} s stolen"


def _go_through(options: argparse.Namespace, course: Course, clock: WallClock | None) -> None:
    """Swing, with campaigns in between; with a `clock` change it in the first two."""
    end = time.monotonic() + 60.0 * options.minutes
    changes = [] if clock is None else [_to_midnight(clock), lambda: clock.set(clock.ahead - _HOUR)]
    while time.monotonic() < end:
        pause = min(end, time.monotonic() + 60.0 * options.campaigns)
        course.swing(options.every, lambda pause=pause: time.monotonic() >= pause)  # type: ignore[misc]
        if time.monotonic() >= end:
            return
        timer = threading.Timer(_SETTLES, changes.pop(0)) if changes else None
        if timer is not None:
            timer.start()
        course.campaign()
        if timer is not None:
            timer.join()


def _to_midnight(clock: WallClock) -> Callable[[], None]:
    """Return what sets `clock` to ten seconds before the next day (UTC)."""
    return lambda: clock.set(clock.ahead + _DAY - clock.now() % _DAY - 10.0)


def _end_viewer(beside: Beside, folder: Path) -> float:
    """End the viewer; return the batches and cycles that it lost, NaN if it does not say."""
    viewer = beside.processes["viewer"]
    _end(viewer)
    found = re.search(r"(\d+) lost, (\d+) cycles lost", (folder / "viewer.log").read_text())
    return float("nan") if found is None else float(found[1]) + float(found[2])


def leaks(title: str, samples: Sequence[Sample]) -> list[Row]:
    """Return for each kind of resource how many processes certainly take more by the hour."""
    rows, times = [], [sample.since for sample in samples]
    for field, limit in LIMITS.items():
        found = growths(times, [sample.processes for sample in samples], field)
        certain = {name: one for name, one in found.items() if one.low > limit}
        worst = max(found, key=lambda name: np.nan_to_num(found[name].slope, nan=-np.inf))
        unit = _UNITS[field]
        note = f"most: {worst} {_words(found[worst], unit)}; " + ", ".join(certain)
        name = f"processes whose {field} certainly grow by over {limit:g} {unit}/h"
        rows.append(Row(title, name, len(certain), "", note.rstrip("; "), at_most=0))
    return rows


def _words(one: Growth, unit: str) -> str:
    return f"{one.slope:+.2f} ({one.low:+.2f} to {one.high:+.2f}) {unit}/h"


def _after_the_change(
    options: argparse.Namespace, file: Path, clock: WallClock, title: str, before: Sequence[Path]
) -> list[Row]:
    """Start the bench again by the clock that was set back; return whether all data are right."""
    content = {path: path.stat().st_mtime_ns for path in before}
    with running_bench(file, "--series", **clock.environment) as bench:
        course = Course(bench, file, {**os.environ, **clock.environment})
        course.swing(1.0, lambda: _swings(bench) >= _AFTER)
        bench.end()
        after = _records(bench)
    gone = [
        path for path, time_ns in content.items() if not path.exists() or path.stat().st_mtime_ns != time_ns
    ]
    found = [read_swing(path)[1] for path in after]
    ids = [one["shot_id"] for one in found if one["shot_id"]]
    return [
        Row(title, "records gone or changed after the next start", len(gone), "", at_most=0),
        Row(title, "new records after it", len(after) - len(before), "", at_least=_AFTER),
        Row(title, "shot ids given twice", len(ids) - len(set(ids)), "", at_most=0),
        Row(
            title,
            "times of records off by more than the changes of the clock",
            _wrong_times(found),
            "",
            at_most=0,
        ),
    ]


def _wrong_times(found: Sequence[dict[str, Any]]) -> int:
    """Return how many records begin at a time that neither follows from the loop's nor from a set clock."""
    wrong, steps = 0, Counter[int]()
    for run in {one["run"] for one in found}:
        mine = sorted((one for one in found if one["run"] == run), key=lambda one: one["number"])
        ahead = [datetime.fromisoformat(one["time_utc"]).timestamp() - one["begin"] for one in mine]
        for step in np.diff(ahead):
            if abs(step) > 5.0:
                steps[round(step)] += 1
            elif not -0.5 < step < 5.0:
                wrong += 1
    print("changes of the clock seen between two records, s:", dict(steps))
    return wrong + max(0, sum(steps.values()) - 2)
