"""A cluster as a user starts it, and a hand that kills its workers."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Event, Thread

import psutil

_ENDING = 60.0
"""s in which a cluster ends, even on a busy machine."""


@contextmanager
def running_cluster(workers: int, config: Path | None = None) -> Iterator[tuple[str, psutil.Process]]:
    """Yield the address of a cluster and its process."""
    command = [sys.executable, "-m", "bench", *(["--config", str(config)] if config else [])]
    command += ["cluster", "--port", "0", "--workers", str(workers)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("scheduler at "), line + process.stdout.read()
            address = line.split()[-1]
            assert "workers; Ctrl-C ends" in process.stdout.readline()
            yield address, psutil.Process(process.pid)
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(_ENDING)


def kill_worker(cluster: psutil.Process) -> list[int]:
    """Kill the worker of `cluster` that has done most; return its process id, or nothing if there is none."""
    with suppress(psutil.NoSuchProcess):
        below = cluster.children(recursive=True)
        workers = [child for child in below if "spawn_main" in " ".join(child.cmdline())]
        if workers:
            worker = max(workers, key=lambda process: process.cpu_times().user)
            worker.kill()
            return [worker.pid]
    return []


@contextmanager
def killed_workers(cluster: psutil.Process, every: float, at_most: int) -> Iterator[list[int]]:
    """Kill a worker of `cluster` in every `every` s of the block; yield the list of those killed."""
    killed, stop = list[int](), Event()

    def kill() -> None:
        while len(killed) < at_most and not stop.wait(every):
            killed.extend(kill_worker(cluster))

    killer = Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        stop.set()
        killer.join()
