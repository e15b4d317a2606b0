"""The recorder killed at random instants while a loop writes swing after swing: what is on the disk after.

Half of the kills are in the middle of a swing, the other half after it, while it is stored. After a few kills
one recorder may make up for all, as the ring holds some ten swings.
"""

from __future__ import annotations

import argparse
import random
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.progress import track

from bench.lifecycle import State
from bench.telemetry.cycle_record import CYCLE
from bench.telemetry.recorder import read_swing
from tests.bench.recorded_bench import Cycles, RecordedBench
from tests.benchmarks.row import Row

PLAN = (
    (State.READY, 300),
    (State.ARMED, 400),
    (State.SWINGING, 300),
    (State.RECOVERING, 200),
    (State.READY, 400),
)
LENGTH = sum(ticks for _, ticks in PLAN)
BEGIN, END = 301, 1200 + 256
"""First tick of the swing and last of its tail."""
LEAD = 128
"""Cycles that a record has before."""
_STORING = 0.9
"""s after a recorder's start within which it has stored a swing that waits for it."""
_IN_A_ROW = 5
"""Kills without a recorder that may finish."""
_CHUNK = 40
"""Cycles written at a time, about as fast as a loop does."""


def one_swing() -> Cycles:
    """Return the cycles of a swing, values being noise."""
    states = np.repeat([state for state, _ in PLAN], [ticks for _, ticks in PLAN])
    cycles = np.zeros(len(states), CYCLE)
    cycles["angle"] = np.random.default_rng(1).standard_normal((len(states), 3))
    cycles["tick"] = 1 + np.arange(len(states))
    cycles["time"] = float(round(time.monotonic())) + np.arange(len(states)) / 1024
    cycles["measured_step"] = 1 / 1024
    cycles["state"] = states
    return cycles


def damage(path: Path) -> str:
    """Return what is wrong with the record at `path`, "" if it is whole."""
    try:
        cycles, metadata = read_swing(path)
    except Exception as error:  # whatever it is, it is what a user would meet
        return f"{path.name}: {error}"
    ticks = cycles["tick"].astype(int)
    first = int(ticks[0]) - 1
    first, last = first % LENGTH + 1, first % LENGTH + len(ticks)
    if not (first == BEGIN - LEAD and last == END and metadata["complete"]) or np.any(np.diff(ticks) != 1):
        return f"{path.name}: ticks {first} to {last} of its swing, {len(ticks)} cycles"
    return ""


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Kill the recorder `--kills` times; return how many records were damaged, lost, or there twice."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks recorder_kills")
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args(arguments)
    choice = random.Random(options.seed)
    damaged: dict[str, None] = {}
    outcome = Counter[str]()
    endings: set[int] = set()
    with TemporaryDirectory() as folder:
        bench = RecordedBench(Path(folder))
        once = one_swing()
        try:
            for kill in track(range(options.kills), "kills", transient=True):
                cycles = once.copy()
                cycles["tick"] += kill * LENGTH
                cycles["time"] += 10.0 * kill
                before = {path for path in bench.files() if path.name[0] != "."}
                bench.start()
                at = choice.randrange(0, len(cycles), _CHUNK) if kill % 2 else len(cycles)
                for begin in range(0, at, _CHUNK):
                    bench.write(cycles[begin : begin + _CHUNK])
                    time.sleep(0.001)
                time.sleep(choice.uniform(0.0, _STORING))
                bench.kill()
                bench.write(cycles[at:])
                files = bench.files()
                new = [path for path in files if path.name[0] != "." and path not in before]
                outcome["half written"] += any(path.name[0] == "." for path in files)
                outcome["whole"] += bool(new)
                outcome["none yet"] += not new
                damaged |= {text: None for path in new if (text := damage(path))}
                if kill % _IN_A_ROW == _IN_A_ROW - 1 or kill == options.kills - 1:
                    last = int(cycles["tick"][-1])
                    bench.start()
                    bench.wait_for(lambda last=last: bench.heartbeat()["tick"] == last)  # type: ignore[misc]
                    endings.add(bench.end())
            left = bench.files()
            damaged |= {text: None for path in left if path.name[0] != "." and (text := damage(path))}
            rest = [path for path in left if path.name[0] == "."]
            swings = Counter(
                (int(read_swing(path)[0]["tick"][0]) - 1) // LENGTH for path in left if path not in rest
            )
        finally:
            bench.close()
    for text in damaged:
        print(text)
    title = f"{options.kills} kills of the recorder"
    missing = sum(swings[kill] == 0 for kill in range(options.kills))
    told = ", ".join(f"{count} {name}" for name, count in outcome.items())
    return [
        Row(title, "records that are not whole", len(damaged), "", f"at the kills: {told}", at_most=0),
        Row(title, "swings without a record after the next start", missing, "", at_most=0),
        Row(title, "swings recorded twice", sum(count > 1 for count in swings.values()), "", at_most=0),
        Row(title, "half-written files left after the next start", len(rest), "", at_most=0),
        Row(title, "exit codes of those that were not killed", max(endings), "", at_most=0),
    ]
