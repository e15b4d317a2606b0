"""A complete bench as a child process, for the duration of a command.

`python -m bench.commands.campaign.demo_bench`.

Plan: a pickled BenchPlan on stdin. Events on stdout: `ready`, commands are answered; `failed`, as from other
children. It ends with the robot at rest, by SIGTERM or after its parent; the parent handles Ctrl-C.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from bench.base.errors import BenchError, ExitCode
from bench.config import Configuration
from bench.supervisor.child_process import Parent, read_plan, send_event, send_failure
from bench.supervisor.daemon import Daemon
from drivers.base import DriverError

_LOOK = 0.5
"""Period of checking the parent (s)."""


@dataclass(frozen=True)
class BenchPlan:
    """Which bench, and where its log goes."""

    configuration: Configuration
    log: Path


def _end_with(parent: Parent) -> None:
    while not parent.gone:
        time.sleep(_LOOK)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> int:
    """Run the bench of the plan on stdin; return the exit code."""
    parent = Parent()
    os.setpgid(0, 0)  # out of reach of the terminal's Ctrl-C, with all processes of the bench
    plan: BenchPlan = read_plan()
    log = os.open(plan.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, sys.stderr.fileno())
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    threading.Thread(target=_end_with, args=(parent,), name="parent", daemon=True).start()
    try:
        Daemon(plan.configuration).run(lambda: send_event("ready"))
    except (BenchError, DriverError) as error:
        return send_failure(error)
    return ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
