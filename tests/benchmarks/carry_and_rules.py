"""Carry and rules: coverage of the errors of fitted aerodynamics, risks of decisions by rules.

Synthetic flights of a ball with known drag and lift, measured with scatter and calibration errors; synthetic
series of balls at the limit of the distance standard. Seeds are fixed. Options: `--fits N`, `--series N`, and
those of the engine.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from math import pi, radians, sqrt
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.calibration.aerodynamics_fit import FlightUncertainty, MeasuredFlight, fit_aerodynamics
from bench.campaign.carry import ShotCarry
from bench.campaign.plan import CampaignPlan
from bench.campaign.plan_file import load_plan
from bench.campaign.ruling import Decision, judge_rules
from bench.config import load_configuration
from bench.shot.recorded_shot import FlightConditions
from bench.shot.shot import Shot, ShotStatus
from sim.ball import Ball
from sim.flight import Launch, Wind, fly
from sim.turf import Turf
from tests.benchmarks.row import Row
from tests.benchmarks.swept import Sweeper, add_engine_options, sweeper

Array = NDArray[np.float64]

SEED = 20261122
MASS, RADIUS, DRAG, LIFT = 0.04593, 0.021335, 1.04, 0.95
SCATTER = FlightUncertainty(0.3, radians(0.2), 100 * pi / 30, 1.0, 0.5, 0.05, 0.01)
NONE = FlightUncertainty(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CALIBRATION = FlightUncertainty(0.2, 0.002, 3.0, 0.5, 0.2, 0.02, 0.0)
BALL = Ball("x", MASS, RADIUS, drag_factor=DRAG, lift_factor=LIFT)
JUDGED = Launch(64.0, 0.2, 0.0, 280.0, 0.0)
LIMIT_M = 320 * 0.9144
NAME = "carry and rules"


def _flights(
    count: int, random: np.random.Generator, common: FlightUncertainty, points: int
) -> list[MeasuredFlight]:
    s = SCATTER
    bias = random.standard_normal(6) * [*common.of_launch(), common.carry, common.apex, common.time]
    found = []
    for _ in range(count):
        true = Launch(random.uniform(58, 72), random.uniform(0.15, 0.25), 0.0, random.uniform(230, 340), 0.0)
        flight = fly(true, ball=BALL)
        off = bias + random.standard_normal(6) * [*s.of_launch(), s.carry, s.apex, s.time]
        launch = Launch(true.speed + off[0], true.launch_angle + off[1], 0.0, true.spin + off[2], 0.0)
        if points:
            rows = flight.path[10 : 10 + 10 * points : 10]
            noise = s.point * random.standard_normal((len(rows), 2))
            found.append(MeasuredFlight(launch, points=np.column_stack([rows[:, 0], rows[:, 1:3] + noise])))
        else:
            found.append(
                MeasuredFlight(launch, flight.carry + off[3], flight.apex + off[4], flight.time + off[5])
            )
    return found


@dataclass(frozen=True)
class FittedFlights:
    """Aerodynamics fitted to drawn flights, by number: what is off, and its stated standard error."""

    count: int
    common: FlightUncertainty
    points: int

    def prepared(self) -> Callable[[int], tuple[Array, Array]]:
        """Return the function of a number; both results: drag factor, lift factor, carry (m)."""
        return self._fit

    def _fit(self, number: int) -> tuple[Array, Array]:
        random = np.random.default_rng((SEED, self.count, self.points, number))
        flights = _flights(self.count, random, self.common, self.points)
        values = fit_aerodynamics("x", flights, SCATTER, self.common, mass=MASS, radius=RADIUS)
        true, flown = fly(JUDGED, ball=BALL), fly(JUDGED, ball=values.as_flown)
        usual = FlightConditions()
        stated = np.array(
            [values.drag_error, values.lift_error, values.carry_error(JUDGED, usual.air, Wind(), Turf())]
        )
        off = np.array([values.drag_factor - DRAG, values.lift_factor - LIFT, flown.carry - true.carry])
        return off, stated


def _fit_rows(title: str, fits: int, study: FittedFlights, swept: Sweeper) -> list[Row]:
    covered, errors = np.zeros(3), np.zeros(3)
    for off, stated in swept(study, range(fits), title):
        covered += np.abs(off) <= 1.96 * stated
        errors += stated
    half = 3 * sqrt(0.95 * 0.05 / fits)
    rows = []
    for name, share, error, unit in zip(
        ("drag", "lift", "carry"), covered / fits, errors / fits, ("", "", " m"), strict=True
    ):
        note = f"of {fits} fits, nominal 0.95; mean standard error {error:.4f}{unit}"
        # Chi square per degree of freedom widens errors and never narrows them: coverage may be higher.
        rows.append(Row(NAME, f"{title}: {name} covered", float(share), "", note, 0.95 - half, 0.97 + half))
    return rows


def _series(
    random: np.random.Generator, mean: float, balls: int, hits: int, ball_deviation: float
) -> list[Shot]:
    """Return the shots at the set-up of the distance standard, in yards of total distance."""
    own = random.normal(0.0, ball_deviation, balls)
    shots = []
    for n in range(balls * hits):
        for role, name in (("control", "tour"), ("test", "candidate")):
            total = mean + own[n % balls] + random.normal(0.0, 2.0)
            shots.append(
                Shot(
                    2 * n + (role == "test") + 1,
                    n + 1,
                    1,
                    "driver",
                    name,
                    ShotStatus.VALID,
                    ball_speed_mps=78.7,
                    launch_angle_deg=10.0,
                    spin_rpm=2520.0,
                    total_m=0.9144 * total,
                    carry_m=0.9144 * (total - 25.0),
                    carry_source="monitor",
                    flight_source="simulated",
                    role=role,
                    sample=1 + n % balls,
                    time_utc=datetime(2026, 11, 22, tzinfo=UTC),
                )
            )
    return shots


@dataclass(frozen=True)
class RuledSeries:
    """Decisions by rules on series of shots around a mean total (yd), by number."""

    plan: CampaignPlan
    mean: float
    balls: int
    hits: int
    deviation: float

    def prepared(self) -> Callable[[int], Decision]:
        """Return the function of a number."""
        return self._decide

    def _decide(self, number: int) -> Decision:
        random = np.random.default_rng((SEED, self.balls, self.hits, number))
        (found,) = judge_rules(self.plan, _series(random, self.mean, self.balls, self.hits, self.deviation))
        return found.decision


def _rule_rows(series: int, swept: Sweeper) -> list[Row]:
    plan = load_plan(Path("distance"), load_configuration(Path("shipped")))
    plan = replace(plan, rules=replace(plan.rules, apply=("ods",), uncertainty={"total_m": 0.0}))
    rows = []
    for balls, hits, deviation in ((12, 1, 2.0), (12, 3, 2.0), (6, 6, 1.0)):
        study = RuledSeries(plan, 320.0, balls, hits, deviation)
        decisions = swept(study, range(series), f"{balls} balls x {hits}")
        for wrong in (Decision.CONFORMS, Decision.FAILS):
            count = decisions.count(wrong)
            half = 3 * sqrt(0.0228 * 0.9772 / series)
            title = f"{balls} balls x {hits} at the limit: {wrong}"
            rows.append(
                Row(
                    NAME,
                    title,
                    count / series,
                    "",
                    f"of {series}, nominal 0.0228",
                    0.0228 - half,
                    0.0228 + half,
                )
            )
    return rows


def _launch_rows() -> list[Row]:
    plan = load_plan(Path("ten-balls"), load_configuration(Path("shipped")))
    plan = replace(plan, analysis=replace(plan.analysis, carry="reference"))
    carry, around = ShotCarry(plan, {}), FlightConditions()
    hardware = [carry.columns(b, JUDGED, around, None, None)[0]["carry_m"] for b in plan.design.balls]
    own = [fly(JUDGED, ball=plan.balls[b]).carry for b in plan.design.balls]
    return [
        Row(
            NAME,
            "one launch, ten balls: range of carry on hardware",
            float(np.ptp(hardware)),
            "m",
            "",
            None,
            0.0,
        ),
        Row(NAME, "flown with the plan's own factors", float(np.ptp(own)), "m", "as before"),
    ]


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Run all cases; takes some minutes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fits", type=int, default=1000, help="fits a case")
    parser.add_argument("--series", type=int, default=10_000, help="series a case")
    add_engine_options(parser)
    given = parser.parse_args(arguments)
    swept = sweeper(given)
    return [
        *_launch_rows(),
        *_fit_rows("8 flights, carry, apex, time", given.fits, FittedFlights(8, NONE, 0), swept),
        *_fit_rows("20 flights, device off", given.fits, FittedFlights(20, CALIBRATION, 0), swept),
        *_fit_rows("20 flights of an indoor range, 6 points", given.fits, FittedFlights(20, NONE, 6), swept),
        *_rule_rows(given.series, swept),
    ]
