"""Two balls that differ by 1.0 % in restitution, swung: found as often as the plan's own power says?

Each campaign is swung on the plant, with seeds fixed beforehand. What the plan states is taken from shots of
other seeds: the true difference from two swings without scatter, the deviation from a pilot. Two equal balls
are judged beside them, whether TOST calls them the same as often as foretold. Option: `--campaigns N`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from math import sqrt
from pathlib import Path

import numpy as np

from bench.campaign.analysis import analyse, values_of
from bench.campaign.corrections import AsDesigned
from bench.campaign.course import Step
from bench.campaign.gate import Centre
from bench.campaign.plan import CampaignPlan, Simulation
from bench.campaign.plan_file import load_plan
from bench.campaign.sequence import all_trials
from bench.campaign.series import foreseen
from bench.campaign.simulated import SimulatedShots
from bench.campaign.swings import require_swings
from bench.config import Configuration, load_configuration
from bench.shot.shot import Shot
from bench.simulation.swing_operator import never
from tests.benchmarks.row import Row
from tests.benchmarks.swept import add_engine_options, swept

SEED, PILOT = 5000, 4000
BLOCKS = 16
TITLE = "campaign detection"


def plan_of(configuration: Configuration, restitution: float) -> CampaignPlan:
    """Return two balls, the second with a share `restitution` of the first one's."""
    plan = load_plan(Path("two-balls"), configuration)
    tour = configuration.balls["tour"]
    other = replace(tour, name="range", restitution_factor=restitution * tour.restitution_factor)
    return replace(
        plan,
        design=replace(plan.design, blocks=BLOCKS),
        ball_handling=replace(plan.ball_handling, samples=100),
        balls={"tour": tour, "range": other},
    )


class Swings:
    """Swings campaigns without storing them; armed once for all."""

    def __init__(self, configuration: Configuration) -> None:
        self._configuration = configuration

    def shots(self, plan: CampaignPlan, seed: int) -> list[Shot]:
        """Return the shots of a campaign."""
        plan = replace(plan, design=replace(plan.design, seed=seed))
        source = SimulatedShots(
            plan, self._configuration, AsDesigned(require_swings(plan, self._configuration)), never
        )
        return [
            source.take(Step(trial, 1, Centre()), number, number).shot
            for number, trial in enumerate(all_trials(plan), 1)
        ]


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Swing all campaigns; about two seconds each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=100)
    add_engine_options(parser)
    options = parser.parse_args(arguments)
    count = options.campaigns
    configuration = load_configuration(Path("shipped"))
    swings = Swings(configuration)
    unlike, equal = plan_of(configuration, 0.99), plan_of(configuration, 1.0)

    quiet = {
        f.name: () if isinstance(getattr(unlike.simulation, f.name), tuple) else 0.0
        for f in fields(Simulation)
    }
    still = replace(unlike, simulation=Simulation(**quiet), design=replace(unlike.design, blocks=1))  # type: ignore[arg-type]
    first, second = sorted(swings.shots(still, 1), key=lambda shot: shot.ball == "range")
    difference = float((first.carry_m or 0.0) - (second.carry_m or 0.0))
    _, pilot = values_of(equal, [s for n in range(4) for s in swings.shots(equal, PILOT + n)])
    deviation = float(np.std(pilot, ddof=1))

    ahead = foreseen(unlike, deviation, 0.0)
    if ahead is None:
        raise RuntimeError("nothing is foreseen")
    power = ahead.power(difference)
    margin = 1.3 * difference
    same_power = ahead.same(margin, 1 - unlike.analysis.confidence)
    equal = replace(equal, analysis=replace(equal.analysis, margin=margin, difference=difference))
    study = SwungCampaigns(configuration)
    planned = [(unlike, SEED + n) for n in range(count)] + [(equal, SEED + count + n) for n in range(count)]
    verdicts = swept(options, study, planned, "campaigns", configuration)
    found = verdicts[:count].count("different")
    same = sum(verdict in {"same", "both"} for verdict in verdicts[count:])
    return [
        Row(TITLE, "true difference", difference, "m", "1.0 % in restitution, without scatter"),
        Row(TITLE, "deviation of one shot", deviation, "m", f"pilot of {len(pilot)} shots"),
        _rate("found", found, count, power),
        _rate("equal balls called the same", same, count, same_power),
    ]


@dataclass(frozen=True)
class SwungCampaigns:
    """Verdicts of campaigns that are swung, by plan and seed."""

    configuration: Configuration

    def prepared(self) -> Callable[[tuple[CampaignPlan, int]], str]:
        """Return the function of a plan and a seed."""
        swings = Swings(self.configuration)
        return lambda planned: _verdict(planned[0], swings.shots(*planned))


def _verdict(plan: CampaignPlan, shots: Sequence[Shot]) -> str:
    result = analyse(plan, shots, 1, "").confirmatory
    return result.pairs[0].verdict if result else ""


def _rate(name: str, count: int, of: int, nominal: float) -> Row:
    half = max(0.05, 3 * sqrt(nominal * (1 - nominal) / of))
    return Row(
        TITLE, name, count / of, "", f"of {of}, foretold {nominal:.3f}", nominal - half, nominal + half
    )
