"""Random requests, interlocks and faults against the lock-step bench for as long as there is time.

    python -m tests.benchmarks adversary [--hours 1] [--first 0] [--steps 60] [--output data/adversary]

Each seed is one episode: a bench with its own setup, random steps, then a person who brings it back
to READY (`tests.adversary`). A violation is shortened and stored as a story in `--output`; a story
moved to `tests/adversary/stories/` is played by `make test`. `--hours` are of this machine. Episodes are kept
in `--output`: the same command continues after the last seed. `--processes`, `--cluster` choose the engine.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from bench.base.lifecycle import State
from bench.simulation.sweep import SweepStore, code_digest
from tests.adversary.drawing import improvise
from tests.adversary.shrinking import kind_of, shrink
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

_SHRUNK = 3
"""Stories of the same kind that are made short and kept."""
_SEEDS = 1_000_000
"""More than there is time for."""


class Episode(NamedTuple):
    """Result of an episode."""

    ticks: int
    accepted: int
    asked: int
    """Requests."""
    visited: list[int]
    """States."""
    found: str
    """First violation; empty: none."""


@dataclass(frozen=True)
class Episodes:
    """Episodes of so many steps, by seed."""

    steps: int

    def prepared(self) -> Callable[[int], Episode]:
        """Return the function of a seed."""
        return self._played

    def _played(self, seed: int) -> Episode:
        story, player = improvise(seed, self.steps)
        visited = sorted(int(state) for state in player.judge.visited)
        return Episode(player.bench.tick, player.accepted, player.asked, visited, story.found)


def _read(record: dict[str, Any]) -> Episode:
    return Episode(**record)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the adversary's playing time, and the number of episodes with a violation."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks adversary")
    parser.add_argument("--hours", type=float, default=1.0, help="Hours of this machine.")
    parser.add_argument("--first", type=int, default=0, help="Seed of the first episode.")
    parser.add_argument("--steps", type=int, default=60, help="Steps per episode.")
    add_engine_options(parser)
    parser.add_argument("--output", type=Path, default=Path("data/adversary"), help="Folder for stories.")
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    end, seeds = time.monotonic() + 3600 * options.hours, range(options.first, options.first + _SEEDS)
    digest = f"{code_digest(__name__)} {options.steps}"
    store = SweepStore(options.output / "episodes.jsonl", digest, Episode._asdict, _read)
    study = Episodes(options.steps)
    swept(options, study, seeds, "episodes", store=store, stop=lambda: time.monotonic() > end)
    played = {seed: store.results[str(seed)] for seed in seeds if str(seed) in store.results}
    found = _stories(played, options.steps, options.output)
    episodes = played.values()
    ticks = sum(episode.ticks for episode in episodes)
    accepted, asked = sum(e.accepted for e in episodes), sum(e.asked for e in episodes)
    visited = {state for episode in episodes for state in episode.visited}
    note = f"seeds from {options.first}, {options.steps} steps each"
    rows = [
        Row("adversary", "simulated", ticks / 3.6e6, "h", note),
        Row("adversary", "episodes", len(played), "", ""),
        Row("adversary", "requests", asked, "", f"{accepted} accepted"),
        Row("adversary", "states visited", len(visited), "", at_least=len(State)),
    ]
    rows += [Row("adversary", kind, count, "episodes", at_most=0) for kind, count in found.most_common()]
    return [*rows, Row("adversary", "episodes that broke a property", found.total(), "", at_most=0)]


def _stories(played: dict[int, Episode], steps: int, output: Path) -> Counter[str]:
    """Store short stories of what broke; return how often each kind did."""
    console, found = Console(stderr=True), Counter[str]()
    for seed, episode in played.items():
        if not episode.found:
            continue
        kind, file = kind_of(episode.found), output / f"seed-{seed}.json"
        found[kind] += 1
        console.print(f"seed {seed}: {episode.found}", highlight=False)
        if found[kind] <= _SHRUNK and not file.exists():
            file.write_text(shrink(improvise(seed, steps)[0]).to_text())
    return found
