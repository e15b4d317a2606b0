"""Shots of the simulated bench in lock-step: each depends on plan and number only, never on earlier shots.

The simulated launch monitor has no sockets and no clock here: the bytes that it would send go straight to
where the server would have them from, at the times they would come.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from itertools import islice
from math import pi
from queue import SimpleQueue
from typing import Any, Self
from zlib import crc32

import numpy as np

from bench.campaign.plan.carry import Measured
from bench.campaign.plan.plan import CampaignPlan, Simulation
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Step
from bench.campaign.run._corrections import CampaignCorrections, Drift
from bench.campaign.run.shot_source import MonitorResult, ShotSource, Taken, shot_row, with_launch
from bench.config import Configuration
from bench.learning.learn import LearningProblem, Swinger, on_series
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_matcher import UNREPORTED
from bench.simulation.plant_variation import Variation
from bench.simulation.simulated_bench import ArmedBench, Bench, Series, SwingResult
from bench.swing.library import find_profile
from drivers.base import Launch
from drivers.launch_monitor.conversation import Conversation, add_doubts
from drivers.launch_monitor.record import LaunchRecord, Match, MatchOutcome, MatchWindow, SwingImpact, match
from sim.ball import Ball
from sim.flight import Flight
from sim.plant import PlantParameters
from sim.simulated_monitor import MonitorParameters, monitor_messages


def hear(
    launch: Launch,
    number: int,
    club_speed: float | None,
    parameters: MonitorParameters,
    window: MatchWindow,
    carry: float | None = None,
) -> MonitorResult:
    """Return the launch monitor's result for ball `number`, which left with `launch`.

    `club_speed` (m/s) replaces the monitor's; `carry` (m) is the monitor's.
    """
    talk, records = Conversation(0.0), list[LaunchRecord]()
    for delay, message in monitor_messages(launch, number, parameters, carry=carry):
        records += talk.receive(message, delay).records
    late = window.latest + window.timeout
    swing = SwingImpact(str(number), 0.0)
    found: Match = next(
        one for one in match([swing], records, late + 1.0, window).decided if one.shot == swing.shot
    )
    if found.outcome is MatchOutcome.NO_LAUNCH or found.launch is None:
        return MonitorResult(None, UNREPORTED)
    record = add_doubts(found.launch, club_speed)
    return MonitorResult(record, "; ".join(filter(None, (found.reason, record.reason))))


BEGIN = datetime(2026, 1, 1, 8, 0, tzinfo=UTC)
"""Virtual time of a simulated campaign's first shot, fixed so that it is repeatable."""

_BENCHES = 2
"""Benches that swing at the same time, each in its thread; compiled code holds no lock."""
_Swing = tuple[SwingResult, PlantParameters, np.ndarray]
"""A swing, the plant that made it, and the normal numbers of its shot."""
_SHOTS, _SAMPLES, _CARRIES = 1, 2, 3
"""Streams of random numbers."""


def random_of(plan: CampaignPlan, number: int) -> np.random.Generator:
    """Return the random numbers of shot `number`; the first six are normal: ball, supply, launch monitor."""
    return np.random.default_rng((plan.design.seed, _SHOTS, number))


def ball_as_hit(plan: CampaignPlan, name: str, sample: int, number: int, draw: float) -> Ball:
    """Return ball `sample` of a model as it is at shot `number`."""
    s, ball = plan.simulation, plan.balls[name]
    own = np.random.default_rng((plan.design.seed, _SAMPLES, crc32(name.encode()), sample))
    factor = 1 + s.sample * float(own.standard_normal()) + s.restitution * draw + s.drift * number / 1000
    return replace(ball, restitution_factor=ball.restitution_factor * factor)


def monitored(s: Simulation, launch: Launch, noise: np.ndarray) -> Launch:
    """Return `launch` as the simulated launch monitor measures it; `noise` are four normal numbers."""
    return Launch(
        speed=launch.speed + s.ball_speed * float(noise[0]),
        launch_angle=launch.launch_angle + s.launch_angle * float(noise[1]),
        direction=launch.direction + s.direction * float(noise[2]),
        spin=launch.spin + s.spin_rpm * pi / 30 * float(noise[3]),
        spin_axis=launch.spin_axis,
    )


def reported_carry(plan: CampaignPlan, number: int, true: Flight | None) -> float | None:
    """Return the carry (m) that the simulated launch monitor reports of shot `number`: the true one, noisy.

    None without a flight.
    """
    if true is None:
        return None
    noise = float(np.random.default_rng((plan.design.seed, _CARRIES, number)).standard_normal())
    return max(0.0, true.carry + plan.simulation.carry * noise)


class SimulatedShots(ShotSource):
    """The simulated bench in lock-step; hindrances are part of its shots, and it swings every profile."""

    simulated = True

    def __init__(
        self,
        plan: CampaignPlan,
        configuration: Configuration,
        swings: CampaignCorrections,
        stop: Callable[[], bool],
        measured: Measured | None = None,
    ) -> None:
        """`measured` are the aerodynamics that were measured, by ball."""
        self._plan, self._configuration, self._stop = plan, configuration, stop
        self._measured = measured or {}
        self._swings = swings
        self._monitor = MonitorParameters(
            speed_noise=0.0,
            angle_noise=0.0,
            spin_noise=0.0,
            axis_noise=0.0,
            carry_noise=0.0,
            dropped=plan.simulation.missing_launch,
            seed=plan.design.seed,
        )
        self._armed: dict[tuple[str, str], tuple[SimpleQueue[ArmedBench], dict[str, Any]]] = {}
        """Free armed benches by swing and club, and the metadata of all their records."""
        self._pool = ThreadPoolExecutor(_BENCHES, "swing-ahead")
        self._ahead: dict[tuple[Arm, int, int], Future[_Swing]] = {}
        """Swings started ahead of their turn, by arm, number and ball."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def time_of(self, number: int) -> datetime:
        """Return the time of shot `number`."""
        return BEGIN + timedelta(seconds=(number - 1) * self._plan.design.seconds_per_shot)

    def relearn(self, drift: Drift, number: int) -> str:
        """Relearn a swing on the robot as it is at shot `number`."""
        truth = self._worn(drift.arm[1], number)

        def robot(problem: LearningProblem) -> AbstractContextManager[Swinger]:
            return nullcontext(on_series(problem, Series(problem.bench, truth)))

        text = self._swings.refresh(drift, number, robot, truth)
        self._armed.pop(drift.arm, None)
        self._ahead.clear()
        return text

    def foresee(self, number: int, coming: Iterator[tuple[PlannedShot, int]]) -> None:
        """Start the swings from shot `number` on with benches that are armed; two run at a time.

        A swing depends on plan, arm, number and ball only: one that comes to nothing changes nothing.
        """
        before, self._ahead = self._ahead, {}
        for shot, (trial, ball) in enumerate(islice(coming, 1 + _BENCHES), number):
            if (trial.arm.swing, trial.arm.club) in self._armed:
                key = trial.arm, shot, ball
                swing = before.pop(key) if key in before else self._pool.submit(self._swing, *key)
                self._ahead[key] = swing
        for swing in before.values():
            swing.cancel()

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with ball `sample`; a KeyboardInterrupt while arming passes."""
        s, arm = self._plan.simulation, step.trial.arm
        events = []
        if number in s.guard_opened:
            events.append(("guard", "guard opened; a simulated bench resets and arms itself"))
        if number in s.feeder_jam:
            time, air, fault = self.time_of(number), self._configuration.air, "feeder jam: no ball came"
            shot = shot_row(step, number, sample, time, ShotStatus.FAILED, fault, air=air)
            return Taken(shot, None, {}, False, tuple(events))
        _, base = self._bench(arm.swing, arm.club)
        swing = self._ahead.get((arm, number, sample))
        result, plant, draws = swing.result() if swing else self._swing(arm, number, sample)
        c, ball, supply = self._configuration, plant.ball, plant.supply
        around, time = FlightConditions(c.air, c.wind, c.turf), self.time_of(number)
        status, reason, delivery = result.status, result.reason, result.delivery
        row = shot_row(step, number, sample, time, status, reason, delivery=delivery, air=c.air)
        heard = self._heard(number, result, draws[2:])
        shot = with_launch(row, heard, self._plan, self._measured, around, ball)
        varied = {
            "restitution_factor": ball.restitution_factor,
            "supply_pressure": supply.pressure,
            "seed": plant.seed,
        }
        metadata = {**base, "varied": varied, **result.replay_metadata()}
        return Taken(
            shot, result.cycles, metadata, result.launch is not None, tuple(events), result.interrupted
        )

    def _swing(self, arm: Arm, number: int, sample: int) -> _Swing:
        """Swing for shot `number` with ball `sample`, on an armed bench that is free."""
        s, random = self._plan.simulation, random_of(self._plan, number)
        draws = random.standard_normal(6)
        ball = ball_as_hit(self._plan, arm.ball, sample, number, float(draws[0]))
        supply = self._configuration.plant.supply
        supply = replace(supply, pressure=supply.pressure * (1 + s.supply * float(draws[1])))
        plant = replace(
            self._worn(arm.club, number), ball=ball, supply=supply, seed=int(random.integers(2**31))
        )
        free, _ = self._armed[arm.swing, arm.club]
        bench = free.get()
        try:
            return bench.swing_on(plant, None if number in s.missed_ball else ball), plant, draws
        finally:
            free.put(bench)

    def _heard(self, number: int, result: SwingResult, noise: np.ndarray) -> MonitorResult:
        """Return the report of the simulated launch monitor; empty without a launch."""
        if result.launch is None:
            return MonitorResult()
        speed = None if result.delivery is None else result.delivery.speed
        seen = monitored(self._plan.simulation, result.launch, noise)
        carry = reported_carry(self._plan, number, result.flight)
        window = self._configuration.launch_monitor.window
        heard = hear(seen, number, speed, self._monitor, window, carry)
        launch = heard.launch and replace(heard.launch, source="simulated")
        return heard._replace(launch=launch)

    def _bench(self, swing: str, club: str) -> tuple[SimpleQueue[ArmedBench], dict[str, Any]]:
        """Return benches armed with a swing and a club, and the metadata of all their records."""
        if (swing, club) not in self._armed:
            profile = self._swings.profile((swing, club))
            # The limits are for the robot without the plan's scatter.
            plant = replace(self._nominal(club), encoders=self._configuration.plant.encoders)
            file = find_profile(self._plan.profile(swing, club))
            c = replace(self._configuration, plant=plant).for_profile(
                self._swings.designed((swing, club)), file
            )
            bench = replace(Bench.of(c, profile), plant=self._nominal(club))
            series = {
                "campaign": self._plan.campaign.name,
                "digest": self._plan.digest,
                "scatter": asdict(self._plan.simulation),
            }
            armed, free = ArmedBench(bench, self._stop), SimpleQueue[ArmedBench]()
            for each in (armed, *(armed.copy() for _ in range(_BENCHES - 1))):
                free.put(each)
            self._armed[swing, club] = free, bench.metadata({"series": series})
        return self._armed[swing, club]

    def _worn(self, club: str, number: int) -> PlantParameters:
        """Return the plant with `club` as it is at shot `number`, without shot-to-shot scatter."""
        friction = 1.0 + self._plan.simulation.wear * number / 1000
        if friction == 1.0:
            return self._nominal(club)
        return Variation(friction=(friction,) * 3).applied_to(self._nominal(club))

    def _nominal(self, club: str) -> PlantParameters:
        """Return the plant with `club` and the encoders' noise, without shot-to-shot scatter."""
        plant = self._configuration.plant_of(club, self._plan.clubs[club])
        noise = float(np.hypot(plant.encoders.noise, self._plan.simulation.encoders))
        return replace(plant, encoders=replace(plant.encoders, noise=noise))
