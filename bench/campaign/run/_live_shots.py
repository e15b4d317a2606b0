"""Shots of a running bench, over the network and in real time.

A shot is: make the bench ready, raise a ball, swing once it rests at its address, wait for its record and for
the launch. Club data come from the record, ball data from the bench's launch monitor. A
simulated bench may do without one: then the ball is computed here from the delivery.

After a stop a campaign continues only after a person's reset and arming. A simulated bench resets, homes and
arms itself, and each
time is an event of the campaign.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, Self

import numpy as np

from bench.base.errors import BenchError, Refused
from bench.base.from_toml import format_value
from bench.base.lifecycle import Refusal, State
from bench.campaign.plan.bench_setup import Preparation
from bench.campaign.plan.carry import Measured
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Step
from bench.campaign.run._corrections import CampaignCorrections, Drift
from bench.campaign.run._simulated_shots import ball_as_hit, monitored, random_of, reported_carry
from bench.campaign.run.plan_requirements import (
    START_SERIES,
    Profiles,
    machine_refusals,
    needs_series,
    series_words,
)
from bench.campaign.run.shot_source import (
    BlockingCondition,
    MonitorResult,
    ShotPostponed,
    ShotSource,
    Suspended,
    Taken,
    shot_row,
    with_launch,
)
from bench.learning.learn import LearningProblem
from bench.learning.live import LiveSwinger
from bench.network.bench_operator import READY, BenchOperator, NoShot, in_words, require_kind
from bench.network.bench_service import BenchStatus
from bench.network.client import LATCHED, BenchClient, CommandRefused
from bench.network.lease import CAMPAIGN_HOLDER, MAX_HOLDER_LENGTH
from bench.network.status_words import absent_monitor_text
from bench.records.shot.recorded_shot import FlightConditions, delivery_of_cycles, flown, plant_of
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_message import ShotPublication, launch_from_json
from bench.records.shot.strike import ball_struck
from bench.records.telemetry.record_file import SwingRecord
from bench.store.rows import CampaignEntry, PromptKind
from bench.supervisor.ownership import bench_folder
from bench.supervisor.readiness import mechanically_equal, with_face_of
from bench.swing.correction import digest_of
from bench.swing.profile import Profile
from drivers.base.shared_memory import SharedMemoryError
from drivers.launch_monitor.record import LaunchRecord
from sim.ball import Air, Ball
from sim.exchange import SurroundingsWriter
from sim.impact import Delivery, strike
from sim.plant import PlantParameters
from sim.robot import Club

_AT_THE_ROBOT = {
    Refusal.GUARD: "Leave the robot and close the guard.",
    Refusal.LOCAL_RESET: "Press the local reset at the guard.",
    Refusal.GAUGE: (
        "Lock the supply, turn the regulator to 0. Open both hand valves of a joint whose chamber vented "
        "slowly or whose sensor failed. Once both gauges show 0, press the local reset."
    ),
}
"""Refusals that a person at the robot can clear, and the actions."""
_PERSON = 600.0
"""Max time of a person at the gauges (s)."""
NO_WORD = "the launch monitor's process did not report the swing"


def require_live(
    plan: CampaignPlan,
    profiles: Profiles,
    clubs: Mapping[str, Club],
    status: BenchStatus,
    measured: Measured | None = None,
    *,
    simulated: bool | None = None,
) -> None:
    """Refuse a plan whose shots the running bench cannot take, even with an operator's help.

    `simulated` is whether the campaign began on a simulated robot; None before its start.

    Raises:
        Refused: the bench is of another kind than at the beginning, fits none of the plan's arms, is held, or
            does not measure the plan's quantity; it is simulated and vents between swings, which the gate
            excludes without planned air; or the plan does not name the carry it compares, or a ball's
            aerodynamics were not `measured`.
    """
    if simulated is not None:
        require_kind(status, simulated=simulated)
    location, lease = f"plan {plan.campaign.name}", status["lease"]
    if lease is not None and not lease["holder"].startswith(CAMPAIGN_HOLDER):
        location = f"bench {status['bench']}"
        found = f"held by {lease['holder']}, for another {lease['seconds_left']:.0f} s"
        raise Refused(location, found, "a free bench", "Ask for it, or wait: golfbench status.")
    if not any(_fits(plan, club, profile, clubs, status) for (_, club), profile in profiles.items()):
        wanted = dict.fromkeys(f"{profiles[arm].name} with club {arm[1]}" for arm in profiles)
        loaded = f"profile {status['profile']} with club {status['club']}"
        expected = f"{loaded}, as loaded on bench {status['bench']}"
        action = "Start the bench with that profile (golfbench run --profile) and club ([swing] club)."
        raise Refused(f"{location}: design.swings and design.clubs", ", ".join(wanted), expected, action)
    if status["driver"] == "sim":
        if needs_series(plan, profiles.values()) and not status["series"]:
            expected = "a bench that holds the address between swings"
            raise Refused(f"bench {status['bench']}", series_words(plan), expected, START_SERIES)
        return
    monitored = status["launch_monitor"] is not None
    if refusal := next(machine_refusals(plan, measured or {}, monitored=monitored), None):
        raise refusal


def _fits(
    plan: CampaignPlan, club: str, profile: Profile, clubs: Mapping[str, Club], status: BenchStatus
) -> bool:
    """Return whether the bench, as started, swings `club` with `profile`."""
    alike = status["club"] == club or mechanically_equal(plan.clubs[club], clubs.get(status["club"]))
    return alike and profile.name == status["profile"]


class LiveShots(ShotSource):
    """The running bench as a campaign sees it; a context, which releases the lease at its end."""

    def __init__(
        self,
        entry: CampaignEntry,
        plan: CampaignPlan,
        swings: CampaignCorrections,
        clubs: Mapping[str, Club],
        client: BenchClient,
        *,
        interrupted: Callable[[], bool],
        aborted: Callable[[], bool],
        measured: Measured | None = None,
        air: Callable[[], Air | None] = lambda: None,
    ) -> None:
        """`clubs` are those of the bench's configuration; `measured` are aerodynamics by ball.

        `aborted` stops a swing, `interrupted` does not; `air` returns the reading at a real bench. The lease
        is taken at the first shot.
        """
        self._plan, self._swings, self._clubs = plan, swings, clubs
        self._client, self.simulated, self._air = client, entry.simulated, air
        self._aborted, self._interrupted = aborted, interrupted
        self._operator = BenchOperator(
            client,
            f"{CAMPAIGN_HOLDER}{entry.id}"[:MAX_HOLDER_LENGTH],
            simulated=entry.simulated,
            ask_person=_left_to_person,
            on_reset=self._note_reset,
            aborted=aborted,
            interrupted=interrupted,
        )
        self._ordered: tuple[tuple[float, ...], int] = (), 0
        """Weights requested from the bench, and its number of the correction."""
        self._monitored = bool(entry.real_time.get("launch_monitor"))
        self._measured = measured or {}
        self._ball_chosen = False
        self._supply_shut = not entry.simulated
        """Whether a person may have shut the supply for the access; unknown if an earlier run granted it."""
        self._before_arming = ""
        self._first: Step | None = None
        """First step of this run, once it was checked for hindrances."""
        self._short = ""
        """Shortage of the supply since the last swing or `rest`; empty without one."""
        self._resume = f"golfbench campaign resume {entry.id}"
        self._events: list[tuple[str, str]] = []
        """(kind, text) of what happened on the way to the shot under way."""
        self._drift: list[str] = []
        """Warnings of the bench's status about the swings so far."""

    def __enter__(self) -> Self:
        self._operator.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._operator.__exit__(*error)
        if self._ball_chosen:
            self._choose_ball(None)

    def time_of(self, number: int) -> datetime:
        """Return the clock's time."""
        return datetime.now(UTC)

    def hindrance(self, step: Step) -> BlockingCondition | None:
        """Return the hindrance of a missing launch monitor or of too low a supply pressure, if any."""
        with _suspending():
            status = self._client.status()
        return self._unseen(step, status) or self._short_of_air(step, status)

    def _unseen(self, step: Step, status: BenchStatus) -> BlockingCondition | None:
        if not self._monitored:
            return None
        if (link := status["launch_monitor"]) is None:
            raise Suspended("the bench restarted without its launch monitor, [launch_monitor] enabled")
        self._first = self._first or step
        # One that connects per shot is seen again only by a shot: it has the first one of each run.
        if link["present"] or (link["presence"] == "per_shot" and step is self._first and not link["note"]):
            return None
        note = f": {link['note']}" if link["note"] else ""
        return BlockingCondition(f"{absent_monitor_text(link)}{note}")

    def _short_of_air(self, step: Step, status: BenchStatus) -> BlockingCondition | None:
        """Check the supply pressure, at the address only: otherwise its manifold is empty.

        Raises:
            Suspended: the bench was disarmed, as by `lifecycle.armed_timeout`, while the supply was short.
        """
        pressure = status["supply_pressure_pa"]
        if self._short and status["state"] != "ARMED":
            now = f"now the bench is {in_words(status)}"
            raise Suspended(f"{self._short}; {now}: check compressor and regulator, then resume")
        if pressure is None or (status["state"], status["phase"]) != ("ARMED", "HOLD"):
            return None
        profile = self._swings.designed((step.trial.arm.swing, step.trial.arm.club))
        least = self._plan.supply.min_pressure_ratio * profile.limits.get("supply_pressure_pa", 0.0)
        if pressure >= least:
            return None
        text = f"supply {pressure / 1e5:.2f} bar absolute, at least {least / 1e5:.2f} for {profile.name}"
        self._short = text
        return BlockingCondition(text, armed=True)

    def rest(self) -> None:
        """Disarm: vent the robot. Release the lease until the next shot or access."""
        self._short = ""
        with suppress(BenchError):  # not armed, or the next shot fails with the reason
            self._client.disarm()
        self._operator.release()

    def take(self, step: Step, number: int, sample: int) -> Taken:
        """Take shot `number` with ball `sample`; raises as `ShotSource.take`."""
        self._events.clear()
        ball, operator = self._ball_as_hit(step, number, sample), self._operator
        with _suspending():
            operator.take_lease()
            self._ball_chosen = self._monitored and self.simulated and self._choose_ball(ball)
            try:
                record = operator.swing(lambda status: self._prepare(step, status), ball=True)
            except NoShot as none:
                shot = shot_row(step, number, sample, datetime.now(UTC), ShotStatus.FAILED, none.found)
                return Taken(shot, None, {}, none.swung, tuple(self._events))
            message = operator.message_about(record) if self._monitored else None
        return self._taken(step, number, sample, record, message)

    def required_restart(self, step: Step) -> Preparation | None:
        """Return the restart of the bench that `step` requires; None if none."""
        with _suspending():
            status = self._client.status()
        arm = step.trial.arm
        profile = self._swings.designed((arm.swing, arm.club))
        if _fits(self._plan, arm.club, profile, self._clubs, status):
            return None
        wanted = profile.name
        text = (
            f"Restart the bench with profile {wanted} and [swing] club = {format_value(arm.club)}: "
            f"it runs with profile {status['profile']} and club {status['club']}."
        )
        return Preparation(PromptKind.BENCH, text, {"profile": wanted, "club": arm.club})

    def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        """Vent the robot and unlock the guard; for `PromptKind.BENCH` leave the bench to the person."""
        with _suspending():
            self.rest()
            if kind is PromptKind.BENCH:
                return
            self._operator.take_lease()
            if self._client.status()["state"] != "ACCESS":
                self._supply_shut = False
            self._until(self._is_open, self._client.access, ask)

    def _is_open(self, status: BenchStatus) -> bool:
        """Return whether the guard is released; a stopped machine gives a person no work inside."""
        if status["state"] in LATCHED and not self.simulated:
            raise Suspended(f"{in_words(status)}: golfbench access --end, reset, home, then resume")
        return status["state"] == "ACCESS"

    def resume_after_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        """Lock the guard once it is closed and the local reset, if there is one, was pressed."""
        if kind is PromptKind.BENCH:
            return
        with _suspending():
            self._operator.take_lease()
            self._until(lambda status: status["state"] != "ACCESS", self._client.secure, ask)
        if self._supply_shut:
            work = "Unlock and open the supply, turn the regulator to its pressure in service"
            self._before_arming = f"{work}, then {self._resume}"

    def work_before_arming(self) -> str:
        """Return the work of a person between locking and arming, once; empty if none."""
        work, self._before_arming = self._before_arming, ""
        return work

    def _until(
        self,
        holds: Callable[[BenchStatus], bool],
        request: Callable[[], object],
        ask: Callable[[str], None],
    ) -> None:
        """Repeat the request until the bench accepts it: chambers must be empty, or the guard closed.

        `ask` gets the action for which the bench waits at each look; a person has time for each.
        """
        deadline, shown = time.monotonic() + READY, ""
        while not holds(self._client.status()):
            ask(shown)
            try:
                request()
            except CommandRefused as refused:
                if time.monotonic() > deadline:
                    raise
                action = _AT_THE_ROBOT.get(refused.refusal, shown)
                if action != shown:
                    gauged = refused.refusal is Refusal.GAUGE
                    shown, deadline = action, time.monotonic() + (_PERSON if gauged else READY)
                    self._supply_shut |= gauged
            self._operator.pause()

    def _prepare(self, step: Step, status: BenchStatus) -> bool:
        """Prepare the swing at the address; return whether the robot still rests there.

        Raises:
            ShotPostponed: the supply pressure is too low.
        """
        if self._short_of_air(step, status):
            raise ShotPostponed(*self._events)
        self._short = ""
        if self._must_practise(step, status) and not status["ball_present"]:
            self._practise()
            return False
        self._correct(step, status)
        self._note_drift(status["drift"])
        return True

    def _note_drift(self, warnings: list[str]) -> None:
        """Note the drift of the robot whenever more of it is reported than at the swing before."""
        if len(warnings) > len(self._drift):
            self._events += [("drift", f"{text}; parts: golfbench wear") for text in warnings]
        self._drift = warnings

    def _note_reset(self, cause: str) -> None:
        self._events.append(("reset", f"{cause}; a simulated bench resets, homes and arms itself"))

    def _correct(self, step: Step, status: BenchStatus) -> None:
        """Set the correction learned for `step`, also after a restart of the bench."""
        arm = step.trial.arm.swing, step.trial.arm.club
        weights, number = self._swings.weights(arm), status["correction"]
        if (weights, number) != self._ordered and (weights or number):
            self._client.correct(digest_of(self._swings.designed(arm)), weights)
            self._ordered = weights, self._client.status()["correction"]

    def relearn(self, drift: Drift, number: int) -> str:
        """Relearn a swing on the bench without a ball; the learner holds the lease meanwhile."""
        self._operator.release()

        def learner(problem: LearningProblem) -> LiveSwinger:
            return LiveSwinger(
                *(self._client, problem, "encoders+model", lambda text: None),
                with_ball=False,
                ask_person=_left_to_person,
                aborted=self._aborted,
                interrupted=self._interrupted,
            )

        with _suspending():
            return self._swings.refresh(drift, number, learner)

    def _must_practise(self, step: Step, status: BenchStatus) -> bool:
        """Return whether arming left other air for `step` than a swing: in a series, without planned air.

        A bench without series is vented and armed for each swing, also after one without a ball.
        """
        if not (self._plan.warm_up.practice and self._operator.armed_anew and status["series"]):
            return False
        return not self._swings.designed((step.trial.arm.swing, step.trial.arm.club)).air

    def _practise(self) -> None:
        """Swing without a ball."""
        self._operator.request_swing()
        self._operator.armed_anew = False
        self._operator.wait_until_over()
        self._events.append(("practice", "a swing without a ball, as the bench was re-armed"))

    def _ball_as_hit(self, step: Step, number: int, sample: int) -> Ball:
        draw = float(random_of(self._plan, number).standard_normal(6)[0])
        return ball_as_hit(self._plan, step.trial.arm.ball, sample, number, draw)

    def _choose_ball(self, ball: Ball | None) -> bool:
        """Make the simulated tee raise balls like `ball`; return whether it is on this machine and does."""
        try:
            with SurroundingsWriter(bench_folder(self._client.bench)) as hands:
                hands.choose_ball(ball)
        except SharedMemoryError:
            return False
        return True

    def _taken(
        self, step: Step, number: int, sample: int, record: SwingRecord, message: ShotPublication | None
    ) -> Taken:
        metadata, cycles = record.metadata, record.cycles
        plant, around = plant_of(metadata, str(record.path))
        plant = self._with_planned_club(plant, step.trial.arm.club)
        delivery, struck = delivery_of_cycles(cycles, plant), ball_struck(cycles)
        status, reason = _judged(metadata, delivery, struck)
        ball, more = self._plan.balls[step.trial.arm.ball], dict[str, Any]()
        if self.simulated:
            ball = self._ball_as_hit(step, number, sample)
            more["varied"] = {
                "restitution_factor": ball.restitution_factor,
                "struck_in_the_plant": ball.name if self._ball_chosen else plant.ball.name,
            }
        air = around.air if self.simulated else self._air()
        around = around if air is None else replace(around, air=air)
        if self._monitored:
            heard = MonitorResult(None, NO_WORD)
            if message is not None:
                heard = MonitorResult(None, message["reason"])
                if (told := message["launch"]) is not None:
                    more["launch"] = told
                    heard = heard._replace(launch=launch_from_json(told))
        else:
            hit = delivery if self.simulated and struck else None
            heard = self._modelled(number, hit, plant.robot.club, ball, around)
        begun = float(cycles["time"][np.argmax(cycles["state"] == State.SWINGING)] - cycles["time"][0])
        time_utc = record.time_utc + timedelta(seconds=begun)
        row = shot_row(step, number, sample, time_utc, status, reason, delivery=delivery, air=air)
        simulated = ball if self.simulated else None
        shot = with_launch(row, heard, self._plan, self._measured, around, simulated)
        metadata |= {"record": record.path.name, **more}
        return Taken(shot, cycles, metadata, struck, tuple(self._events), original=record.path)

    def _with_planned_club(self, plant: PlantParameters, name: str) -> PlantParameters:
        """Return `plant` with club `name` of the plan; the mounted one may differ in its face only.

        Raises:
            Suspended: the bench swings another club.
        """
        mounted, planned = plant.robot.club, self._plan.clubs[name]
        if mounted.name == name:
            return plant
        if not mechanically_equal(planned, self._clubs.get(mounted.name)):
            raise Suspended(f"the bench swings club {mounted.name}, the plan {name}")
        return replace(plant, robot=replace(plant.robot, club=with_face_of(mounted, planned)))

    def _modelled(
        self, number: int, delivery: Delivery | None, club: Club, ball: Ball, around: FlightConditions
    ) -> MonitorResult:
        """Return the launch of `ball` as a simulated launch monitor sees it; none without a `delivery`."""
        if delivery is None:
            return MonitorResult()
        draws = random_of(self._plan, number).standard_normal(6)
        try:
            true = strike(delivery, club, ball)
        except ValueError as error:
            return MonitorResult(None, f"no launch: {error}")
        carry = reported_carry(self._plan, number, flown(true, ball, around))
        seen = monitored(self._plan.simulation, true, draws[2:])
        record = LaunchRecord(0.0, "", number, *seen, carry=carry, source="simulated")
        return MonitorResult(record)


def _left_to_person(todo: str) -> None:
    raise Suspended(f"{todo}, then resume")


@contextmanager
def _suspending() -> Iterator[None]:
    """Turn refusals and missing answers of the bench into `Suspended`."""
    try:
        yield
    except BenchError as error:
        raise Suspended(f"{error.location}: {error.found}") from error


def _judged(metadata: dict[str, Any], delivery: Delivery | None, struck: bool) -> tuple[ShotStatus, str]:
    """Return the status of a swing's shot by its record, and the reason unless it is valid."""
    if metadata["outcome"]["cause"] != "NONE":
        return ShotStatus.FAILED, str(metadata["outcome"]["text"])
    if delivery is None:
        return ShotStatus.FAILED, "no swing through the ball's place"
    if not struck:
        return ShotStatus.FAILED, "no ball struck"
    if not metadata["complete"]:
        return ShotStatus.EXCLUDED, f"{metadata['lost_records']} cycles of its record are missing"
    return ShotStatus.VALID, ""
