"""Valves that stick on a dense grid of instants: with the cushions of before, a valve in series, absorbers.

    python -m tests.benchmarks stuck_valves [--grid 12] [--profile default] [--configuration FILE]

Every valve sticks in each way at every instant of the grid, the model-based check on, until everything rests.
"before" has the cushions of 40 and 30 J that wrist and arm had once. "in series" has them, too, and a second
valve that shuts both lines of the actuator in the tick in which the bench notices: faster than any real one.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console

from bench.config import Configuration, load_configuration
from bench.faults.case import Workbench
from bench.faults.catalogue import Breakage
from bench.faults.instants import Instant
from bench.faults.verdict import CaseOutcome
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from drivers.base import JOINTS
from sim.faults import Fault
from sim.plant import PlantParameters
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

BEFORE = {"wrist": (40.0, 0.12), "right_arm": (30.0, 0.012)}
"""J, and rad or m of travel."""
WAYS = {"open": 1.0, "open in reverse": -1.0, "shut": 0.0, "where it stands": float("nan")}


def with_cushions(plant: PlantParameters, cushions: dict[str, tuple[float, float]]) -> PlantParameters:
    """Return `plant` with `cushions` of these energies (J) and travels (rad, m)."""
    changed = {name: getattr(plant, name) for name in cushions}
    return replace(
        plant,
        **{
            name: replace(actuator, stop=replace(actuator.stop, energy=energy, travel=travel))
            for (name, actuator), (energy, travel) in zip(changed.items(), cushions.values(), strict=True)
        },
    )


def stuck(joint: str, way: str, time: float = 0.0) -> Fault:
    """Return the fault of the valve of `joint`, from `time` (s) on."""
    return Fault(f"{joint} valve stuck {way}", f"{joint} valve", "stuck", WAYS[way], time=time)


def in_series(bench: Workbench, joint: str, way: str, instant: Instant, noticed: int) -> CaseOutcome:
    """Return the end of a case whose actuator is shut off in the tick `noticed`."""
    shut = replace(stuck(joint, "shut", noticed * bench.period), name=f"{joint} shut off")
    return bench.run(Breakage(shut, hidden_by=stuck(joint, way)), instant)


def row(title: str, outcomes: Sequence[CaseOutcome], *, promised: bool) -> Row:
    """Return the worst cushion of `outcomes` and what ended unsafe."""
    worst = max(outcomes, key=lambda outcome: outcome.stop_share)
    over = sum(outcome.stop_share > 1.0 for outcome in outcomes)
    unsafe = [outcome for outcome in outcomes if outcome.verdict == "unsafe"]
    other = Counter(kind_of(outcome) for outcome in unsafe if outcome.stop_share <= 1.0)
    note = (
        f"{worst.stop}, {worst.breakage} at {worst.instant}; of {len(outcomes)} cases {over} above a rating, "
        f"{len(unsafe)} unsafe" + "".join(f", {count} by {kind}" for kind, count in other.items())
    )
    return Row(
        "stuck valves",
        title,
        100 * worst.stop_share,
        "% of a cushion's rating",
        note,
        at_most=100.0 if promised else None,
    )


def kind_of(outcome: CaseOutcome) -> str:
    """Return the sort of the first reason of an unsafe case, without its figures."""
    words = [word for word in outcome.reasons[0].split() if not any(c.isdigit() for c in word)]
    return " ".join(words)


def instants(profile: Profile, grid: int) -> list[Instant]:
    """Return every `grid`-th tick of the swing."""
    names = ("hold", "backswing", "top", "downswing", "committed", "impact", "follow-through")
    found = []
    for tick in range(1, len(profile.angle), grid):
        phase = names[max(k for k, begin in enumerate(profile.begins) if begin <= tick)]
        found.append(Instant("backswing" if phase == "hold" else phase, tick, f"{tick} ms"))
    return found


@dataclass(frozen=True)
class StuckValves:
    """Every valve that sticks in each way at an instant, on three machines."""

    before: Configuration
    after: Configuration
    profile: Profile

    def prepared(self) -> Callable[[Instant], dict[str, list[CaseOutcome]]]:
        """Return the function of an instant."""
        old = Workbench(self.before, self.profile, model_check=True)
        new = Workbench(self.after, self.profile, model_check=True)

        def broken(instant: Instant) -> dict[str, list[CaseOutcome]]:
            found: dict[str, list[CaseOutcome]] = {"before": [], "before, in series": [], "after": []}
            for joint in JOINTS:
                for way in WAYS:
                    case = Breakage(stuck(joint, way))
                    ended = old.run(case, instant)
                    cut = ended
                    if way != "shut" and ended.detection_ticks >= 0:
                        cut = in_series(old, joint, way, instant, ended.detection_ticks)
                    found["before"].append(ended)
                    found["before, in series"].append(cut)
                    found["after"].append(new.run(case, instant))
            return found

        return broken


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Return the worst cushions before, with a valve in series, and after."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks stuck_valves")
    parser.add_argument("--grid", type=int, default=12, help="ticks between two instants")
    parser.add_argument("--profile", default="")
    parser.add_argument("--configuration", type=Path)
    parser.add_argument("--show", action="store_true", help="print every unsafe case")
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    after: Configuration = load_configuration(options.configuration)
    profile = load_profile(find_profile(options.profile or after.swing.profile))
    before = replace(after, plant=with_cushions(after.plant, BEFORE))
    study = StuckValves(before, after, profile)
    runs = swept(options, study, instants(profile, options.grid), "instants", after)
    found = {title: [outcome for at_instant in runs for outcome in at_instant[title]] for title in runs[0]}
    console = Console(stderr=True)
    if options.show:
        for title, outcomes in found.items():
            for outcome in outcomes:
                if outcome.verdict == "unsafe":
                    console.print(
                        f"{title}: {outcome.breakage}, {outcome.instant}: {', '.join(outcome.reasons)}"
                    )
    return [row(title, outcomes, promised=title == "after") for title, outcomes in found.items()]
