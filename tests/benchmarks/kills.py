"""Each process of a bench killed and frozen in each phase of a swing: what became of the robot, and after.

The loop and the supervisor are struck with the plant behind simulated CANopen nodes, where a dead loop is an
event for the valve node; recorder and publisher with the plant in step, where the machine's own stalls do not
matter.
"""

from __future__ import annotations

import argparse
import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from bench.base.errors import Refused
from bench.base.lifecycle import Cause, Phase, State
from bench.network.client import CommandRefused
from bench.simulation.safety import stop_shares
from drivers.base.shared_memory import SharedRecord
from sim.exchange import PLANT_REPORT, REPORT_FILE
from tests.benchmarks.row import Row
from tests.running_bench import BenchProcess, played_nodes, running_bench, write_configuration

PHASES = (
    Phase.STANDING,
    Phase.HOLD,
    Phase.BACKSWING,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.FOLLOW_THROUGH,
    Phase.RETURN,
)
SUPPORT = ("recorder", "publisher")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
_ATTEMPTS = 6
"""Tries to reach a phase undisturbed: a stall of milliseconds of this machine alone stops the bench."""
_NOT_REACHED = (Refused, TimeoutError, RuntimeError)


class Case(NamedTuple):
    """What became of one bench."""

    process: str
    signal: str
    phase: str
    end: str
    """Reaction of the bench."""
    silence: float
    """s from the last command obeyed to the release of the valves; NaN without release."""
    travel: float
    """m that the club head moved in that time."""
    stop_share: float
    """Greatest energy in a stop, of its rating; NaN where the plant died with the loop."""
    after: str
    """State and cause after the strike, or of the bench started anew."""
    armed: bool
    """Whether anything was armed, or moved, that may not have been."""


class PlantWatch:
    """Samples the plant's report until it rests."""

    def __init__(self, folder: Path) -> None:
        self._shared = SharedRecord.open(folder / REPORT_FILE, PLANT_REPORT)
        self._now = np.zeros(1, PLANT_REPORT)
        self.samples: list[np.void] = []

    def look(self) -> np.void:
        """Take a sample."""
        self._shared.read(self._now)
        self.samples.append(self._now.copy()[0])
        return self.samples[-1]

    def watch(self, seconds: float) -> None:
        """Take samples for `seconds`."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self.look()
            time.sleep(0.0005)

    def close(self) -> None:
        """Unmap."""
        self._shared.close()

    def letting_go(self, tick: float) -> tuple[float, float]:
        """Return the silence before the valves' release (s), and the head's travel in it (m)."""
        node = self.samples[-1]["node"]
        if node["watchdog_trips"] == self.samples[0]["node"]["watchdog_trips"]:
            return np.nan, np.nan
        begin, end = int(node["command_tick"]), int(node["passive_tick"])
        way, before = 0.0, None
        for sample in self.samples:
            here = sample["truth"]["plant_head_position"]
            if begin <= sample["ticks"] <= end and before is not None:
                way += float(np.hypot(*(here - before)))
            before = here.copy()
        return (end - begin) * tick, way


@contextmanager
def bench_in(file: Path, phase: Phase) -> Iterator[BenchProcess]:
    """Yield a bench of the configuration `file` in `phase`, with the lease held."""
    with running_bench(file) as bench, ExitStack() as stack:
        for attempt in range(1, _ATTEMPTS + 1):
            try:
                stack.enter_context(bench.client.lease("kills", 300.0))
                _bring_to(bench, phase)
                break
            except _NOT_REACHED:
                if attempt == _ATTEMPTS or bench.process.poll() is not None:
                    raise
                stack.close()
                time.sleep(1.0)
        yield bench


def _bring_to(bench: BenchProcess, phase: Phase) -> None:
    bench.make_ready()
    if phase is not Phase.STANDING:
        bench.take_address()
        if phase is not Phase.HOLD:
            bench.swing()
            bench.wait_phase(phase, 6.0)


def strike_support(folder: Path, name: str, number: signal.Signals, phase: Phase) -> Case:
    """Strike recorder or publisher; the swing completes, and nothing is armed before it is back."""
    with bench_in(write_configuration(folder, "kills"), phase) as bench:
        struck = psutil.Process(bench.pid(name))
        struck.send_signal(number)
        begun = time.monotonic()
        end, armed, noticed = "", False, 0.0
        if number is signal.SIGKILL:  # seen at once, and mended within seconds
            bench.wait_until(lambda r: not r["support_ready"], 20.0)
            noticed = time.monotonic() - begun
        if phase not in (Phase.STANDING, Phase.HOLD):
            bench.wait_until(
                lambda r: r["state"] in (State.READY, State.FAULT, State.ESTOP, State.RECOVERING)
            )
            completed = bench.now()["cause"] == Cause.NONE
            end = "swing completed" if completed else f"stopped: {Cause(int(bench.now()['cause'])).name}"
        if number is signal.SIGSTOP:
            bench.wait_until(lambda r: not r["support_ready"], 20.0)
            noticed = time.monotonic() - begun
        bench.wait_until(lambda r: r["state"] == State.READY, 20.0)
        try:
            if not bench.now()["support_ready"]:
                bench.client.arm()
                armed = not bench.now()["support_ready"]
        except CommandRefused:
            pass
        end = (end + ", " if end else "") + f"noticed after {noticed:.2f} s"
        if number is signal.SIGSTOP:
            struck.send_signal(signal.SIGCONT)
        bench.wait_until(lambda r: bool(r["support_ready"]), 30.0)
        after = State(int(bench.now()["state"])).name
        return Case(
            name, number.name, phase.name, end, np.nan, np.nan, np.nan, f"{after}, support back", armed
        )


def strike_loop(folder: Path, name: str, number: signal.Signals, phase: Phase) -> Case:
    """Strike the loop or its supervisor, with the plant behind nodes; then start the bench anew."""
    bus = f'[canopen]\nchannel = "{folder / "bus"}"\n'
    file = write_configuration(folder, "kills", bus, base="local_can")
    with played_nodes(file, "--folder", str(folder)), bench_in(file, phase) as bench:
        tick = bench.configuration.plant.tick
        parameters = bench.configuration.plant
        plant = PlantWatch(folder)
        pid = bench.pid(name)
        plant.look()
        os.kill(pid, number)
        plant.watch(2.5)
        if name == "supervisor" and number is signal.SIGSTOP:
            now = bench.now()
            end = f"{State(int(now['state'])).name}, {Cause(int(now['cause'])).name}"
            os.kill(pid, signal.SIGCONT)
            bench.end()
        else:
            now = bench.now()
            bench.process.wait(40.0)
            end = f"exit code {bench.process.returncode}"
            if name == "supervisor":
                end += f", the loop: {State(int(now['state'])).name}, {Cause(int(now['cause'])).name}"
        plant.close()
        silence, travel = plant.letting_go(tick)
        share = float(stop_shares(plant.samples[-1]["stop_energy"], parameters).max())
    with played_nodes(file), running_bench(file) as again:
        after = f"{again.client.status()['state']}, {again.cause}"
        bad = again.client.status()["state"] != "ESTOP"
        again.end()
    return Case(name, number.name, phase.name, end, silence, travel, share, after, bad)


def show(cases: Sequence[Case], console: Console) -> None:
    """Print a line for each case."""
    table = Table("process", "signal", "phase", "end", "after", box=None, header_style="bold")
    for name in ("silence", "head's way", "stop energy"):
        table.add_column(name, justify="right")
    for c in cases:
        figures = (
            "" if np.isnan(c.silence) else f"{1e3 * c.silence:.0f} ms",
            "" if np.isnan(c.travel) else f"{1e3 * c.travel:.0f} mm",
            "" if np.isnan(c.stop_share) else f"{100 * c.stop_share:.0f} %",
        )
        table.add_row(c.process, c.signal, c.phase, c.end, c.after, *figures, style="red" if c.armed else "")
    console.print(table)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Strike every process in every phase; return the results with their bounds."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks kills")
    parser.add_argument("--processes", nargs="*", default=["loop", "supervisor", *SUPPORT])
    parser.add_argument("--phases", nargs="*", default=[phase.name for phase in PHASES])
    options = parser.parse_args(arguments)
    cases, missed = [], 0
    for name in options.processes:
        for number in SIGNALS:
            for phase in (Phase[text] for text in options.phases):
                strike = strike_support if name in SUPPORT else strike_loop
                with TemporaryDirectory() as folder:
                    try:
                        cases.append(strike(Path(folder), name, number, phase))
                        show(cases[-1:], Console(width=150))
                    except _NOT_REACHED as error:
                        missed += 1
                        print(f"{name} {number.name} {phase.name}: not reached: {error}")
    show(cases, Console(width=150))
    silences = [c.silence for c in cases if not np.isnan(c.silence)]
    shares = [c.stop_share for c in cases if not np.isnan(c.stop_share)]
    title = "kills"
    return [
        Row(title, "cases", len(cases), "", f"{missed} not reached"),
        Row(title, "armed, or anew not in ESTOP", sum(c.armed for c in cases), "", at_most=0),
        Row(title, "longest silence before the valves let go", 1e3 * max(silences, default=0.0), "ms"),
        Row(title, "greatest stop energy", 100 * max(shares, default=0.0), "% of the rating"),
    ]
