"""Random requests, interlocks and faults against the lock-step bench for as long as there is time.

    python -m tests.benchmarks adversary [--hours 1] [--first 0] [--steps 60] [--output data/adversary]

Each seed is one episode: a bench of its own setup, steps drawn at random, then a person who brings it back
to READY (`tests.adversary`). What does not hold is made short and stored as a story in `--output`; a story
moved to `tests/adversary/stories/` is played by `make test`. `--hours` are of this machine.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from bench.lifecycle import State
from tests.adversary.drawing import improvise
from tests.adversary.shrinking import kind_of, shrink
from tests.benchmarks.row import Row

_SHRUNK = 3
"""Stories of the same kind that are made short and kept."""


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return how long the adversary played, and how many episodes broke what must hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks adversary")
    parser.add_argument("--hours", type=float, default=1.0, help="Of this machine.")
    parser.add_argument("--first", type=int, default=0, help="Seed of the first episode.")
    parser.add_argument("--steps", type=int, default=60, help="Of an episode.")
    parser.add_argument("--output", type=Path, default=Path("data/adversary"), help="Folder for stories.")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)
    end, seed = time.monotonic() + 3600 * options.hours, options.first
    ticks = accepted = asked = 0
    found: Counter[str] = Counter()
    visited: set[State] = set()
    while time.monotonic() < end:
        story, player = improvise(seed, options.steps)
        ticks, accepted, asked = ticks + player.bench.tick, accepted + player.accepted, asked + player.asked
        visited |= player.judge.visited
        if story.found:
            kind = kind_of(story.found)
            found[kind] += 1
            console.print(f"seed {seed}: {story.found}", highlight=False)
            if found[kind] <= _SHRUNK:
                (options.output / f"seed-{seed}.json").write_text(shrink(story).to_text())
        seed += 1
    note = f"seeds {options.first} to {seed - 1}, {options.steps} steps each"
    rows = [
        Row("adversary", "simulated", ticks / 3.6e6, "h", note),
        Row("adversary", "episodes", seed - options.first, "", ""),
        Row("adversary", "requests", asked, "", f"{accepted} accepted"),
        Row("adversary", "states visited", len(visited), "", at_least=len(State)),
    ]
    rows += [Row("adversary", kind, count, "episodes", at_most=0) for kind, count in found.most_common()]
    return [*rows, Row("adversary", "episodes that broke a property", found.total(), "", at_most=0)]
