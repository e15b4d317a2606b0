"""Shots of the simulated bench in lock-step: each depends on plan and number only, never on earlier shots.

The simulated launch monitor has no sockets and no clock here: the bytes that it would send go straight to
where the server would have them from, at the times they would come.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from math import pi
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from bench.campaign.plan.carry import Measured, carry_columns
from bench.campaign.plan.plan import CampaignPlan, Simulation
from bench.campaign.plan.shot_sequence import Step
from bench.campaign.run.corrections import CampaignCorrections, Drift
from bench.campaign.run.shot_source import ShotSource, Taken
from bench.config import Configuration
from bench.learning.learn import LearningProblem, Swinger, on_series
from bench.records.shot.recorded_shot import FlightConditions
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.shot.shot_matcher import UNREPORTED, reported_columns
from bench.simulation.plant_variation import Variation
from bench.simulation.series import Series
from bench.simulation.simulated_bench import ArmedBench, SimulatedBench, SwingResult
from bench.swing.library import find_profile
from drivers.base import Launch
from drivers.launch_monitor.conversation import Conversation, add_doubts
from drivers.launch_monitor.record import LaunchRecord, Match, MatchOutcome, MatchWindow, SwingImpact, match
from sim.ball import Air, Ball
from sim.flight import fly
from sim.impact import Delivery
from sim.launch_monitor import MonitorParameters, monitor_messages
from sim.plant import PlantParameters


class MonitorResult(NamedTuple):
    """Result of a shot at the launch monitor."""

    launch: LaunchRecord | None
    reason: str
    """Why its figures are missing or invalid; empty if they are valid."""


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


def reported_carry(
    plan: CampaignPlan, number: int, launch: Launch, ball: Ball, around: FlightConditions
) -> float | None:
    """Return the carry (m) that the simulated launch monitor reports of shot `number`: the true one, noisy.

    `launch` is the true one of `ball`; None if it does not fly.
    """
    noise = float(np.random.default_rng((plan.design.seed, _CARRIES, number)).standard_normal())
    try:
        carry = fly(launch, around.air, ball, around.wind, around.turf).carry
    except ValueError:
        return None
    return max(0.0, carry + plan.simulation.carry * noise)


def shot_row(
    step: Step,
    number: int,
    sample: int,
    time_utc: datetime,
    status: ShotStatus,
    reason: str,
    *,
    delivery: Delivery | None = None,
    launch: Launch | None = None,
    air: Air | None = None,
) -> Shot:
    """Return the row of shot `number`, taken as `step` with ball `sample` in the measured `air`."""
    trial, arm = step.trial, step.trial.arm
    weather: dict[str, Any] = {}
    if air is not None:
        weather = {
            "air_temperature_k": air.temperature,
            "air_pressure_pa": air.pressure,
            "relative_humidity": air.relative_humidity,
        }
    return Shot.from_measurements(
        shot=number,
        block=trial.block,
        position=trial.position,
        club=arm.club,
        ball=arm.ball,
        swing=arm.swing,
        role=str(trial.role),
        section=trial.section,
        attempt=step.attempt,
        sample=sample,
        time_utc=time_utc,
        status=status,
        reason=reason,
        delivery=delivery,
        launch=launch,
        flight=None,
        **weather,
    )


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
        s = plan.simulation
        self._monitor = MonitorParameters(
            speed_noise=0.0,
            angle_noise=0.0,
            spin_noise=0.0,
            axis_noise=0.0,
            carry_noise=0.0,
            missing=s.launch_missing,
            misread=s.launch_misread,
            double=s.launch_double,
            dropped=s.missing_launch,
            seed=plan.design.seed,
        )
        self._armed: dict[tuple[str, str], tuple[ArmedBench, dict[str, Any]]] = {}

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
        return text

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with ball `sample`; a KeyboardInterrupt while arming passes."""
        s, arm = self._plan.simulation, step.trial.arm
        events = []
        if number in s.guard_opened:
            events.append(("guard", "guard opened; a simulated bench resets and arms itself"))
        if fault := self._feeder_fault(arm.ball, number, sample):
            time, air = self.time_of(number), self._configuration.air
            shot = shot_row(step, number, sample, time, ShotStatus.FAILED, fault, air=air)
            return Taken(shot, None, {}, False, tuple(events))
        armed, base = self._bench(arm.swing, arm.club)
        random = random_of(self._plan, number)
        draws = random.standard_normal(6)
        came = sample + (number in s.wrong_ball)
        ball = ball_as_hit(self._plan, arm.ball, came, number, float(draws[0]))
        c = self._configuration
        supply = replace(c.plant.supply, pressure=c.plant.supply.pressure * (1 + s.supply * float(draws[1])))
        plant = replace(
            self._worn(arm.club, number), ball=ball, supply=supply, seed=int(random.integers(2**31))
        )
        result = armed.swing_on(plant, None if number in s.missed_ball else ball)
        shot = self._judged(step, number, sample, result, ball, draws[2:])
        varied = {
            "restitution_factor": ball.restitution_factor,
            "supply_pressure": supply.pressure,
            "seed": plant.seed,
        }
        metadata = {**base, "varied": varied, **result.replay_metadata()}
        return Taken(
            shot, result.cycles, metadata, result.launch is not None, tuple(events), result.interrupted
        )

    def _feeder_fault(self, ball: str, number: int, sample: int) -> str:
        """Return why there is no ball to strike; a wrong ball is noticed only if its number is read."""
        s = self._plan.simulation
        if number in s.feeder_jam:
            return "feeder jam: no ball came"
        if number in s.wrong_ball and self._plan.ball_handling.identify:
            return f"feeder: ball {ball} {sample + 1} came, {ball} {sample} was to come"
        return ""

    def _judged(
        self, step: Step, number: int, sample: int, result: SwingResult, ball: Ball, noise: np.ndarray
    ) -> Shot:
        """Return the shot with the figures of launch monitor and flight model."""
        status, reason = result.status, result.reason
        heard, carries = MonitorResult(None, ""), dict[str, Any]()
        if result.launch is not None:
            c, s = self._configuration, self._plan.simulation
            speed = None if result.delivery is None else result.delivery.speed
            around = FlightConditions(c.air, c.wind, c.turf)
            seen = monitored(s, result.launch, noise)
            carry = reported_carry(self._plan, number, result.launch, ball, around)
            heard = hear(seen, number, speed, self._monitor, c.launch_monitor.window, carry)
            if heard.reason:
                status, reason = ShotStatus.EXCLUDED, reason or heard.reason
            elif heard.launch is not None and heard.launch.launch is not None:
                told, launch = heard.launch.carry, heard.launch.launch
                name = step.trial.arm.ball
                carries, doubt = carry_columns(self._plan, self._measured, name, launch, around, told, ball)
                if doubt:
                    status, reason = ShotStatus.EXCLUDED, reason or doubt
        time, delivery, air = self.time_of(number), result.delivery, self._configuration.air
        shot = shot_row(step, number, sample, time, status, reason, delivery=delivery, air=air)
        if heard.launch is not None:
            shot = replace(
                shot, **{**reported_columns(heard.launch), "launch_source": "simulated", **carries}
            )
        return shot

    def _bench(self, swing: str, club: str) -> tuple[ArmedBench, dict[str, Any]]:
        """Return the bench armed with a swing and a club, and the metadata of all its records."""
        if (swing, club) not in self._armed:
            profile = self._swings.profile((swing, club))
            # The limits are for the robot without the plan's scatter.
            plant = replace(self._nominal(club), encoders=self._configuration.plant.encoders)
            file = find_profile(self._plan.profile(swing, club))
            c = replace(self._configuration, plant=plant).for_profile(
                self._swings.designed((swing, club)), file
            )
            around = FlightConditions(c.air, c.wind, c.turf)
            bench = SimulatedBench(profile, self._nominal(club), c.control, c.envelope, c.estimator, around)
            series = {
                "campaign": self._plan.campaign.name,
                "digest": self._plan.digest,
                "scatter": asdict(self._plan.simulation),
            }
            self._armed[swing, club] = ArmedBench(bench, self._stop), bench.metadata({"series": series})
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
