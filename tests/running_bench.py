"""A bench as a user starts it, with the simulated robot: for tests and benchmarks of the whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from bench.base.address import free_port
from bench.base.errors import Refused
from bench.base.lifecycle import Phase, State
from bench.config import Configuration, load_configuration
from bench.network.bench_service import BenchStatus
from bench.network.client import BenchClient, CommandRefused
from bench.network.zenoh_session import NoAnswer
from bench.records.telemetry.ring import RingReader
from bench.supervisor.child_process import RING_FILE
from bench.supervisor.ownership import bench_folder

LONGEST_START = 300.0
"""s; the first start compiles."""


_RESTING = (State.READY, State.SAFE, State.ESTOP, State.FAULT)


class BenchProcess:
    """One run of `golfbench run`, with its queries and actions."""

    def __init__(self, configuration: Configuration, process: subprocess.Popen[bytes], log: Path) -> None:
        self.configuration, self.process, self._log = configuration, process, log
        self._stack = ExitStack()
        self.client = self._connect()
        self.cycles = RingReader(self.folder / RING_FILE)
        self._stack.callback(self.cycles.close)

    def _connect(self) -> BenchClient:
        deadline = time.monotonic() + LONGEST_START
        while self.process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.1)
            with suppress(NoAnswer), ExitStack() as stack:
                client = stack.enter_context(BenchClient.connect(self.configuration))
                status = client.status()
                if status["support_ready"] and status["state"] != "STARTING":
                    self._stack.push(stack.pop_all())
                    return client
        raise RuntimeError(f"the bench did not start: {self.log[-2000:]}")

    @property
    def folder(self) -> Path:
        """Its shared memory."""
        return bench_folder(self.configuration.bench.id)

    @property
    def log(self) -> str:
        """Printed output."""
        return self._log.read_text()

    @property
    def records(self) -> list[Path]:
        """The stored swings."""
        return sorted(self.configuration.bench.data_dir.glob("swings/*/*.parquet"))

    def now(self) -> np.void:
        """Return the newest cycle record."""
        newest = self.cycles.newest()
        assert newest is not None
        record: np.void = newest[0]
        return record

    def pid(self, name: str) -> int:
        """Return the process id of `name`; "supervisor" is the bench's first process."""
        if name == "supervisor":
            return self.process.pid
        return int(self.client.status()["processes"][name]["pid"])

    @property
    def cause(self) -> str:
        """Name of the cause of its state, "" when there is none."""
        cause = self.client.status()["cause"]
        return "" if cause is None else cause["name"]

    def wait_until(self, holds: Callable[[np.void], bool], longest: float = 30.0) -> np.void:
        """Return the first newest record of which `holds` is true, looked at 2,000 times a second."""
        deadline = time.monotonic() + longest
        while not holds(record := self.now()):
            if time.monotonic() > deadline or self.process.poll() is not None:
                state, phase = State(int(record["state"])).name, Phase(int(record["phase"])).name
                raise TimeoutError(f"still {state}, {phase}; log: {self.log[-1500:]}")
            time.sleep(0.0005)
        return record

    def wait_phase(self, phase: Phase, longest: float = 30.0) -> np.void:
        """Return the first newest record in `phase`."""
        return self.wait_until(lambda record: record["phase"] == phase, longest)

    def make_ready(self) -> BenchStatus:
        """Reset where required, and home; the lease must be held."""
        if self.now()["state"] in (State.ESTOP, State.FAULT):
            self.client.reset()
        if not self.client.status()["homed"]:
            self.client.home()
        return self.client.wait_for("READY")

    def recover(self, longest: float = 60.0) -> None:
        """Come back to READY, whatever happened: reset and home as often as required."""
        deadline = time.monotonic() + longest
        while True:
            try:
                state = self.wait_until(lambda record: record["state"] in _RESTING)["state"]
                if state == State.READY:
                    return
                self.make_ready()
            except Refused:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.5)

    def take_address(self) -> BenchStatus:
        """Arm, and wait until the robot holds at its address."""
        self.client.arm()
        return self.client.wait_until_armed()

    def swing(self, longest: float = 10.0) -> None:
        """Swing as soon as the robot rests at its address."""
        deadline = time.monotonic() + longest
        while True:
            try:
                self.client.swing()
                return
            except CommandRefused:
                if time.monotonic() > deadline or self.now()["state"] != State.ARMED:
                    raise
                time.sleep(0.05)

    def end(self, number: signal.Signals = signal.SIGINT, longest: float = 60.0) -> int:
        """End it in order, or by `number`; return its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(longest)

    def close(self) -> None:
        """Leave nothing running. Allowed twice."""
        self._stack.close()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            try:
                self.process.wait(60.0)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


def write_configuration(folder: Path, name: str, text: str = "", base: str = "shipped") -> Path:
    """Write the configuration of a separate bench in `folder`, on `base`; `text` is appended."""
    file = folder / f"{name}.toml"
    file.write_text(
        f'base = "{base}"\n[bench]\nid = "{name}-{os.getpid()}"\ndata_dir = "{folder / "data"}"\n'
        f'[network]\nendpoint = "tcp/127.0.0.1:{free_port()}"\n{text}'
    )
    return file


@contextmanager
def running_bench(file: Path, *arguments: str, **environment: Any) -> Iterator[BenchProcess]:
    """Run the bench of the configuration `file`; it is up, in ESTOP, when this yields."""
    log = file.with_suffix(".log")
    with log.open("ab") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "bench", "--config", str(file), "run", *arguments],
            stdout=output,
            stderr=output,
            env={**os.environ, **environment},
        )
    try:
        bench = BenchProcess(load_configuration(file), process, log)
    except BaseException:
        process.kill()
        process.wait()
        raise
    try:
        yield bench
    finally:
        bench.close()


@contextmanager
def command_beside(file: Path, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run `golfbench` with the configuration `file` during the test; its stderr can be read."""
    with subprocess.Popen(
        [sys.executable, "-m", "bench", "--config", str(file), *arguments], stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


@contextmanager
def played_nodes(file: Path, *arguments: str) -> Iterator[None]:
    """Play the devices of the configuration `file` as `golfbench nodes` does."""
    with command_beside(file, "nodes", *arguments) as process:
        try:
            assert process.stderr is not None
            assert any("live on local_socket" in line for line in iter(process.stderr.readline, ""))
            yield
        finally:
            process.terminate()
            process.wait()


@contextmanager
def simulated_monitor(file: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run `golfbench launch-monitor` during the test."""
    with command_beside(file, "launch-monitor", *options) as process:
        yield process
