"""Campaigns on a running bench: the real daemon with its robot in step, and the operator's tasks."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.base.errors import ExitCode, Refused
from bench.base.lifecycle import REFUSAL_WORDS, Block, Phase, Refusal, State
from bench.calibration.archive import add_calibration
from bench.calibration.calibration import ClubInMount, EncoderZeros
from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role, Step
from bench.campaign.report._budget import uncertainty_budgets
from bench.campaign.report.campaign_record import load_record
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.run._corrections import Drift
from bench.campaign.run._live_shots import LiveShots, require_live
from bench.campaign.run.campaign_control import ask
from bench.campaign.run.plan_requirements import Profiles, require_swings
from bench.campaign.run.runner_control import bench_facts, new_entry, run_campaign
from bench.campaign.run.shot_source import BlockingCondition, ShotPostponed, Suspended, Watcher
from bench.config import database_url, load_configuration
from bench.learning.store import learned_swings
from bench.network.bench_service import ArmingBlock, CommandAnswer
from bench.network.client import CommandRefused
from bench.network.command import Verb
from bench.network.lease import CAMPAIGN_HOLDER
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.shot.shot_message import ShotPublication, launch_to_json, shot_publication
from bench.records.telemetry.record_file import SwingRecord, read_swing
from bench.simulation.simulated_bench import Bench, simulate_swing
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignState, PromptKind
from bench.supervisor.status import NO_LAUNCH_MONITOR
from drivers.base import Launch
from drivers.launch_monitor.record import LaunchRecord, MatchOutcome
from sim.ball import Air, Ball
from tests.bench.campaign.as_designed import AsDesigned
from tests.bench.campaign.plans import SHIPPED, shipped_plan, with_values
from tests.bench.campaign.test_notifications import webhook
from tests.running_bench import BenchProcess, running_bench, write_configuration

PLAN = """
[campaign]
name = "live"
[design]
balls = ["tour", "range"]
blocks = 1
[warm_up]
at_most = 0
practice = false
[gate]
reference = "planned"
club_speed = 4.0
strike_x = 0.03
strike_y = 0.03
"""
"""The first swing after arming differs from the others; here it counts."""


@contextmanager
def campaign(file: Path, *arguments: str | Path) -> Iterator[subprocess.Popen[str]]:
    """Run `golfbench campaign ...` during the test."""
    command = [sys.executable, "-m", "bench", "--config", str(file), "campaign", *map(str, arguments)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def in_swing(bench: BenchProcess, swings: int) -> None:
    """Wait until the robot is in its `swings`-th swing since the bench's start."""
    while bench.client.status()["swings"] < swings:
        time.sleep(0.02)
        assert bench.process.poll() is None
    bench.wait_phase(Phase.BACKSWING)


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(400)
def test_campaign_resume_after_stop_and_kill_stores_each_shot_once(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "live")
    (tmp_path / "plan.toml").write_text(PLAN)
    data_dir = load_configuration(file).bench.data_dir
    with running_bench(file, "--series") as bench, open_database(database_url("", data_dir)) as engine:
        store = CampaignStore(engine)
        with campaign(file, "run", tmp_path / "plan.toml") as process:
            in_swing(bench, 1)
            bench.client.stop()  # shot 1 fails; the simulated bench goes on by itself
            in_swing(bench, 2)
            in_swing(bench, 3)
            process.kill()
        ((entry, standing, counts),) = store.entries()
        assert (standing.state, counts) == (CampaignState.RUNNING, {"failed": 1, "valid": 1})
        with campaign(file, "resume", entry.id) as process:
            output, _ = process.communicate(timeout=120)
            assert process.returncode == ExitCode.OK, output
        shots = [stored.shot for stored in store.shots(entry.id)]
        assert [(s.shot, s.status, s.attempt) for s in shots] == [
            (1, ShotStatus.FAILED, 1),
            (2, ShotStatus.VALID, 2),
            (3, ShotStatus.VALID, 1),
        ]
        assert shots[0].reason == "stopped by the operator"
        assert {shots[1].ball, shots[2].ball} == {"tour", "range"}
        assert shots[0].time_utc < shots[1].time_utc < shots[2].time_utc
        for shot, stored in zip(shots[1:], store.shots(entry.id)[1:], strict=True):
            assert (shot.delivery_source, shot.carry_source) == ("encoders+model", "simulated")
            assert (shot.club_speed_mps or 0.0) > 40.0
            cycles, metadata = read_swing(data_dir / stored.file)
            assert len(cycles) > 1000
            assert metadata["shot"]["ball"] == shot.ball
            assert metadata["record"] not in {path.name for path in bench.records}, "kept once"
        assert bench.client.status()["swings"] == 4  # the one that was cut off is taken again
        assert [event.kind for event in store.events(entry.id)] == ["reset", "reset", "killed"]
        assert (entry.simulated, entry.real_time["driver"]) == (True, "sim")

        with campaign(file, "run", tmp_path / "plan.toml") as process:  # the bench goes away
            in_swing(bench, 5)
            bench.end()
            output, _ = process.communicate(timeout=120)
            assert process.returncode == ExitCode.REFUSED, output
        assert "no answer" in store.entries()[0][1].reason
        assert store.entries()[0][1].state is CampaignState.SUSPENDED


@pytest.mark.release
@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(400)
def test_campaign_sigterm_vents_bench_and_keeps_calibrations(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "live")
    (tmp_path / "plan.toml").write_text(PLAN.replace("blocks = 1", "blocks = 2"))
    configuration = load_configuration(file)
    encoders, club = configuration.plant.encoders, configuration.clubs["driver"]
    zeros = EncoderZeros(encoders.zero_count, encoders.sign, encoders.counts_per_revolution, 1e-3)
    mount = ClubInMount("driver", club.length_to_face, club.loft, club.lie, 5e-4, 1e-3)
    now = datetime.now(UTC)
    with open_database(database_url("", configuration.bench.data_dir)) as engine:
        for values in (zeros, mount):
            add_calibration(
                engine,
                configuration.bench.id,
                values,
                date=now,
                expires=now + timedelta(days=2),
                by="Ann",
                method="jig",
            )
        with running_bench(file, "--series") as bench:
            with campaign(file, "run", tmp_path / "plan.toml") as process:
                in_swing(bench, 1)
                process.terminate()
                output, _ = process.communicate(timeout=120)
            assert process.returncode == ExitCode.TERMINATED, output
            assert "stopped by SIGTERM" in output
            assert bench.client.wait_for("READY")["lease"] is None
            bench.wait_until(lambda record: record["vented"])
            store = CampaignStore(engine)
            ((entry, standing, counts),) = store.entries()
            assert (standing.state, counts) == (CampaignState.STOPPED, {"valid": 1}), (
                "the swing was completed"
            )
            assert store.events(entry.id)[-1].text == "stopped by SIGTERM"
            with campaign(file, "resume", entry.id) as process:
                output, _ = process.communicate(timeout=120)
                assert process.returncode == ExitCode.OK, output
        record = load_record(store, entry)
    in_force = entry.calibrations["bench"]["in_force"]
    assert [(one["kind"], one["version"], one["by"]) for one in in_force] == [
        ("encoders", 1, "Ann"),
        ("club", 1, "Ann"),
    ]
    assert len(record.shots) == 4
    page = render_campaign_report(record, findings(record.plan, record.shots))
    assert page.count("version 1, jig, by Ann") >= 2
    assert "nominal: never calibrated" in page
    speeds = {
        calibrated: next(
            budget
            for budget in uncertainty_budgets(
                record.plan, record.shots, entry.calibrations if calibrated else {}, simulated=False
            )
            if budget.column == "club_speed_mps"
        )
        for calibrated in (True, False)
    }
    assert [line.name for line in speeds[True].lines] == [
        "scatter of the series",
        "length of the club",
        "zeros of the encoders",
    ]
    assert (speeds[True].missing, speeds[False].expanded) == ("", None)
    assert 0.005 < speeds[True].type_b < 0.2
    assert speeds[False].missing == "length of the club not calibrated, zeros of the encoders not calibrated"


class StandingBench:
    """A bench with constant status; records requests, of which it refuses some with an answer."""

    def __init__(self, refusing: Mapping[str, CommandAnswer] | None = None, **status: Any) -> None:
        self.asked: list[str] = []
        self._refusing = refusing or {}
        self._status = {
            "state": "READY",
            "phase": "STANDING",
            "cause": None,
            "lease": {"holder": f"{CAMPAIGN_HOLDER}me"},
            "tick": 1,
            "supply_pressure_pa": 8.0e5,
            "correction": 0,
            "drift": [],
            "bench": "b",
            "driver": "sim",
            **status,
        }
        self.bench = str(self._status["bench"])

    def status(self) -> dict[str, Any]:
        return self._status

    @contextmanager
    def lease(self, holder: str, seconds: float) -> Iterator[None]:
        yield

    @contextmanager
    def shots(self) -> Iterator[Any]:
        yield lambda: None

    def __getattr__(self, verb: str) -> Any:
        def request(*_: Any) -> None:
            self.asked.append(verb)
            if verb in self._refusing:
                raise CommandRefused("b", Verb(verb), self._refusing[verb])

        return request


def a_step() -> Step:
    """Return a shot with the tour ball."""
    return Step(PlannedShot(Role.TEST, 1, 1, 1, Arm("default", "driver", "tour")), 1, Centre())


@pytest.fixture
def plan() -> CampaignPlan:
    return shipped_plan("two-balls")


@cache
def assessed() -> Profiles:
    """Return the profiles of the plan, assessed once for all tests."""
    return require_swings(shipped_plan("two-balls"), SHIPPED)


def with_free_air(profiles: Profiles) -> Profiles:
    """Return `profiles` without planned air at their addresses."""
    return {arm: replace(profile, air=(), air_supply=0.0) for arm, profile in profiles.items()}


def shots_of(
    plan: CampaignPlan,
    bench: Any,
    *,
    simulated: bool = True,
    interrupted: Any = never,
    aborted: Any = never,
    monitored: bool = False,
    air: Air | None = None,
    planned: bool = True,
) -> LiveShots:
    """Return shots of `bench`; if not `planned`, its profiles leave the air at the address as it comes."""
    profiles = assessed() if planned else with_free_air(assessed())
    facts = {"launch_monitor": monitored}
    entry = new_entry(plan, SHIPPED, datetime.now(UTC), simulated=simulated, real_time=facts)
    return LiveShots(
        *(replace(entry, id="me"), plan, AsDesigned(profiles), SHIPPED.clubs, bench),
        interrupted=interrupted,
        aborted=aborted,
        air=lambda: air,
    )


def take(plan: CampaignPlan, bench: Any, *, simulated: bool, interrupted: Any = never) -> Any:
    with shots_of(plan, bench, simulated=simulated, interrupted=interrupted) as source:
        return source.take(a_step(), 1, 1)


@pytest.mark.parametrize("state", ["ESTOP", "FAULT", "SAFE", "ACCESS"])
def test_live_shots_stopped_real_bench_suspends(plan: CampaignPlan, state: str) -> None:
    bench = StandingBench(state=state, driver="canopen", cause={"name": "GUARD", "text": "guard open"})
    with pytest.raises(Suspended, match=r"resume"):
        take(plan, bench, simulated=False)
    assert bench.asked == []


@pytest.mark.parametrize("simulated", [True, False])
@pytest.mark.parametrize("state", ["FAULT", "SAFE", "READY", "ACCESS"])
def test_live_shots_robot_of_other_kind_suspends(plan: CampaignPlan, state: str, simulated: bool) -> None:
    """The bench restarted with another driver; a simulated one is reset and homed by the campaign."""
    driver = "canopen" if simulated else "sim"
    bench = StandingBench(state=state, driver=driver, cause={"name": "GUARD", "text": "guard open"})
    with shots_of(plan, bench, simulated=simulated) as source:
        with pytest.raises(Suspended, match=f"driver {driver}"):
            source.take(a_step(), 1, 1)
        with pytest.raises(Suspended, match=f"driver {driver}"):
            source.resume_after_access(PromptKind.CLUB, print)
    assert bench.asked == []


def test_live_shots_simulated_bench_suspends_after_three_resets(plan: CampaignPlan) -> None:
    bench = StandingBench(state="FAULT", cause={"name": "GUARD", "text": "guard open"})
    with pytest.raises(Suspended, match=r"guard open.*3 times"):
        take(plan, bench, simulated=True)
    assert bench.asked == ["reset"] * 3


def test_live_shots_lease_of_other_holder_suspends(plan: CampaignPlan) -> None:
    bench = StandingBench(lease={"holder": "Ann"})
    with pytest.raises(Suspended, match=r"lease"):
        take(plan, bench, simulated=True)
    assert bench.asked == []


def test_live_shots_interrupt_before_swing_prevents_swing(plan: CampaignPlan) -> None:
    bench = StandingBench()
    with pytest.raises(KeyboardInterrupt):
        take(plan, bench, simulated=True, interrupted=lambda: True)
    assert bench.asked == ["arm"]


def test_require_live_unsuitable_bench_is_refused(plan: CampaignPlan) -> None:
    profiles = assessed()

    def require(plan: CampaignPlan = plan, simulated: bool | None = None, **status: Any) -> None:
        given: Any = {
            "driver": "sim",
            "profile": "default",
            "club": "driver",
            "bench": "b",
            "series": True,
            "lease": None,
            "launch_monitor": None,
        }
        require_live(plan, profiles, SHIPPED.clubs, given | status, simulated=simulated)

    require()
    require(simulated=True)
    for driver, simulated in (("canopen", True), ("sim", False)):
        with pytest.raises(Refused, match=f"driver {driver}"):
            require(driver=driver, simulated=simulated)
    require(series=False)
    with pytest.raises(Refused, match=r"profile thesis"):
        require(profile="thesis")
    with pytest.raises(Refused, match=r"club thesis"):
        require(club="thesis")
    profiles = with_free_air(profiles)
    with pytest.raises(Refused, match=r"vents after each swing.*golfbench run --series"):
        require(series=False)
    require(with_values(plan, gate={"club_speed": 4.0}), series=False)
    with pytest.raises(Refused, match=r"held by Ann"):
        require(lease={"holder": "Ann", "seconds_left": 12.0})
    require(lease={"holder": "campaign two-balls-2026", "seconds_left": 12.0})  # of a runner that died
    with pytest.raises(Refused, match=r"launch monitor"):
        require(driver="canopen")
    with pytest.raises(Refused, match=r"magazine 0"):  # its launch monitor tells of the balls
        require(driver="canopen", launch_monitor={"present": True})
    with pytest.raises(Refused, match=r"carry_m is compared"):
        require(of_carry(plan, ""), driver="canopen", launch_monitor={"present": True})
    with pytest.raises(Refused, match=r"no aerodynamics of tour, range"):
        require(of_carry(plan, "measured"), driver="canopen", launch_monitor={"present": True})
    by_hand = with_values(plan, analysis={"quantity": "club_speed_mps"})
    with pytest.raises(Refused, match=r"magazine 0"):
        require(by_hand, driver="canopen")
    require(with_values(by_hand, ball_handling={"magazine": 6}), driver="canopen")


def test_live_shots_no_ball_on_tee_fails_shot_without_swing(
    plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.network.bench_operator._FEED", 0.1)
    monkeypatch.setattr("bench.network.bench_operator.REST", 0.0)
    bench = StandingBench(state="ARMED", phase="HOLD", time=5.0, ball_present=False)
    taken = take(plan, bench, simulated=True)
    assert (taken.shot.status, taken.shot.reason) == (
        ShotStatus.FAILED,
        "feeder empty or jammed: no ball came",
    )
    assert (taken.struck, taken.cycles, bench.asked) == (False, None, ["tee"])


def answer_of(refusal: Refusal, state: str = "READY") -> CommandAnswer:
    fact, action = REFUSAL_WORDS[refusal]
    return CommandAnswer(False, state, refusal.name, reason=fact, action=action)


BLOCK = ArmingBlock(
    code=Block.CALIBRATION_MISSING,
    location="club driver of bench b",
    found="never calibrated",
    expected="a calibration in force",
    action="golfbench calibrate club",
)
BLOCKED = CommandAnswer(False, "READY", "BLOCKED", content={"arming_blocks": [BLOCK]})


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (BLOCKED, "club driver of bench b never calibrated"),
        (answer_of(Refusal.READ_ONLY), REFUSAL_WORDS[Refusal.READ_ONLY][0]),
        (answer_of(Refusal.CORRECTION), REFUSAL_WORDS[Refusal.CORRECTION][0]),
    ],
    ids=["blocked", "read only", "correction"],
)
def test_live_shots_arm_refusal_suspends_at_once(
    plan: CampaignPlan, answer: CommandAnswer, text: str
) -> None:
    bench = StandingBench({"arm": answer})
    with pytest.raises(Suspended, match=re.escape(text)):
        take(plan, bench, simulated=True)
    assert bench.asked == ["arm"]


def test_live_shots_not_vented_refusal_is_retried(
    plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.network.bench_operator.READY", 0.2)
    bench = StandingBench({"arm": answer_of(Refusal.NOT_VENTED)})
    with pytest.raises(Suspended, match="not verified empty"):
        take(plan, bench, simulated=True)
    assert len(bench.asked) > 1


def test_required_restart_other_profile_gives_bench_prompt(plan: CampaignPlan) -> None:
    other, same = (StandingBench(profile=name, club="driver") for name in ("thesis", "default"))
    wish = shots_of(plan, other).required_restart(a_step())
    assert wish is not None
    assert wish.kind is PromptKind.BENCH
    assert "profile default" in wish.text
    assert shots_of(plan, same).required_restart(a_step()) is None


class Doors(StandingBench):
    """Grants access and locks the guard after some refusals; each request takes 25 s of its clock."""

    def __init__(self, access: Iterable[Refusal] = (), secure: Iterable[Refusal] = (), **status: Any) -> None:
        super().__init__(**status)
        self._refusals = {Verb.ACCESS: iter(access), Verb.SECURE: iter(secure)}
        self.clock = 0.0

    def access(self) -> None:
        self._request(Verb.ACCESS, "ACCESS")

    def secure(self) -> None:
        self._request(Verb.SECURE, "READY")

    def _request(self, verb: Verb, state: str) -> None:
        self.asked.append(verb)
        self.clock += 25.0
        if refusal := next(self._refusals[verb], None):
            raise CommandRefused("b", verb, answer_of(refusal, self._status["state"]))
        self._status["state"] = state


def use_clock(monkeypatch: pytest.MonkeyPatch, bench: Doors) -> None:
    """Let campaigns read the clock of `bench`."""
    clock = SimpleNamespace(monotonic=lambda: bench.clock, sleep=time.sleep)
    monkeypatch.setattr("bench.campaign.run._live_shots.time", clock)


def test_live_shots_access_disarms_then_secures(plan: CampaignPlan) -> None:
    bench = Doors(access=[Refusal.NOT_VENTED])
    with shots_of(plan, bench) as source:
        source.grant_access(PromptKind.CLUB, print)
        assert bench.asked == ["disarm", "access", "access"]
        source.resume_after_access(PromptKind.CLUB, print)
        assert bench.asked[3:] == ["secure"]
        source.resume_after_access(PromptKind.CLUB, print)
        assert bench.asked[4:] == []


class Leased(Doors):
    """Records when the lease is taken and released."""

    @contextmanager
    def lease(self, holder: str, seconds: float) -> Iterator[None]:
        self.asked.append("lease")
        yield
        self.asked.append("release")


def test_live_shots_rest_releases_lease_until_next_use(plan: CampaignPlan) -> None:
    """A pause frees the bench for a person who takes the lease and opens access."""
    bench = Leased()
    with shots_of(plan, bench) as source:
        source._operator.take_lease()
        source.rest()
        assert bench.asked == ["lease", "disarm", "release"]
        source.grant_access(PromptKind.CLUB, print)
        assert bench.asked[3:] == ["disarm", "lease", "access"]


def test_resume_after_access_prompts_guard_then_reset_button(plan: CampaignPlan) -> None:
    refusals = [Refusal.GUARD, Refusal.GUARD, Refusal.LOCAL_RESET, Refusal.LOCAL_RESET]
    bench = Doors(secure=refusals, state="ACCESS")
    asked: list[str] = []
    with shots_of(plan, bench) as source:
        source.resume_after_access(PromptKind.CLUB, asked.append)
    assert list(dict.fromkeys(asked)) == [
        "",
        "Leave the robot and close the guard.",
        "Press the local reset at the guard.",
    ]


def test_resume_after_access_guard_open_suspends_after_one_minute(
    plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Doors(secure=repeat(Refusal.GUARD), state="ACCESS")
    use_clock(monkeypatch, bench)
    with shots_of(plan, bench) as source, pytest.raises(Suspended):
        source.resume_after_access(PromptKind.CLUB, print)
    assert bench.clock < 150.0


def test_grant_access_without_chamber_sensors_prompts_gauges_and_waits(
    plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusals, asked = [Refusal.NOT_VENTED, *[Refusal.GAUGE] * 8], list[str]()
    bench = Doors(access=refusals, driver="canopen")
    use_clock(monkeypatch, bench)
    with shots_of(plan, bench, simulated=False) as source:
        source.grant_access(PromptKind.CLUB, asked.append)
        assert source.work_before_arming() == ""
        source.resume_after_access(PromptKind.CLUB, print)
        assert source.work_before_arming().startswith("Unlock and open the supply")
        assert source.work_before_arming() == ""
    assert set(asked) == {
        "",
        "Lock the supply, turn the regulator to 0. Open both hand valves of a joint whose chamber vented "
        "slowly or whose sensor failed. Once both gauges show 0, press the local reset.",
    }


@pytest.mark.parametrize("state", ["ESTOP", "FAULT"])
def test_grant_access_stopped_machine_sends_no_person_in(plan: CampaignPlan, state: str) -> None:
    bench = Doors(state=state, driver="canopen")
    with shots_of(plan, bench, simulated=False) as source, pytest.raises(Suspended, match="reset, home"):
        source.grant_access(PromptKind.BALLS, print)
    assert "access" not in bench.asked


@pytest.mark.parametrize("simulated", [False, True])
def test_work_before_arming_access_of_earlier_run_opens_supply(plan: CampaignPlan, simulated: bool) -> None:
    bench = Doors(state="ACCESS", driver="sim" if simulated else "canopen")
    with shots_of(plan, bench, simulated=simulated) as source:
        for earlier in (True, False):
            source.grant_access(PromptKind.CLUB, print)
            source.resume_after_access(PromptKind.CLUB, print)
            assert bool(source.work_before_arming()) is (earlier and not simulated)


def test_hindrance_missing_monitor_blocks_and_disabled_monitor_suspends(
    plan: CampaignPlan,
) -> None:
    step = a_step()
    bench = StandingBench(
        launch_monitor={**NO_LAUNCH_MONITOR, "note": "not listening"}, supply_pressure_pa=None
    )
    assert shots_of(plan, bench).hindrance(step) is None  # begun without one
    assert shots_of(plan, bench, monitored=True).hindrance(step) == BlockingCondition(
        "no launch monitor is connected: not listening"
    )
    bench._status["launch_monitor"] = {"present": True, "note": ""}
    assert shots_of(plan, bench, monitored=True).hindrance(step) is None
    bench._status["launch_monitor"] = None
    with pytest.raises(Suspended, match="without its launch monitor"):
        shots_of(plan, bench, monitored=True).hindrance(step)


def test_hindrance_monitor_that_connects_per_shot_has_first_shot_of_each_run(plan: CampaignPlan) -> None:
    """It stays absent until it answers a struck ball."""
    absent = {**NO_LAUNCH_MONITOR, "presence": "per_shot", "present": False, "note": ""}
    bench = StandingBench(launch_monitor=absent, supply_pressure_pa=None)
    first, second = a_step(), a_step()
    for _ in range(2):
        source = shots_of(plan, bench, monitored=True)
        assert [source.hindrance(first) for _ in range(2)] == [None, None]
        blocked = source.hindrance(second)
        assert blocked is not None
        assert "connects per shot" in blocked.text
    bench._status["launch_monitor"] = {**absent, "note": "not listening"}
    assert shots_of(plan, bench, monitored=True).hindrance(first) is not None


@pytest.mark.parametrize(
    ("state", "phase", "pressure", "least", "hindered"),
    [
        ("ARMED", "HOLD", 7.7e5, 0.97, True),
        ("ARMED", "HOLD", 7.8e5, 0.97, False),
        ("ARMED", "HOLD", 7.7e5, 0.0, False),
        ("ARMED", "HOLD", None, 0.97, False),  # no such sensor
        ("ARMED", "STANDING", 1.0e5, 0.97, False),  # the manifold still fills
        ("READY", "STANDING", 1.0e5, 0.97, False),
    ],
)
def test_hindrance_checks_supply_only_at_address(
    plan: CampaignPlan, state: str, phase: str, pressure: float | None, least: float, hindered: bool
) -> None:
    plan = with_values(plan, supply={"min_pressure_ratio": least})
    bench = StandingBench(state=state, phase=phase, supply_pressure_pa=pressure)
    found = shots_of(plan, bench).hindrance(a_step())
    assert (found is not None) == hindered
    if found:
        assert found == BlockingCondition("supply 7.70 bar absolute, at least 7.76 for default", True)


def test_hindrance_bench_disarmed_while_supply_is_short_suspends(plan: CampaignPlan) -> None:
    """A vented bench does not see its supply: nothing charges its chambers again without a person."""
    for short in (7.7e5, 7.8e5):  # at the last look; once short, only a swing or a person ends the shortage
        bench = StandingBench(state="ARMED", phase="HOLD", supply_pressure_pa=7.7e5)
        with shots_of(plan, bench) as source:
            assert source.hindrance(a_step()) is not None
            bench._status["supply_pressure_pa"] = short
            assert (source.hindrance(a_step()) is None) is (short > 7.7e5)
            bench._status |= {"state": "READY", "phase": "STANDING", "supply_pressure_pa": 1.0e5}
            with pytest.raises(Suspended, match=r"supply 7\.70 bar.*READY.*regulator"):
                source.hindrance(a_step())
            source.rest()  # a person has paused and continued the campaign
            assert source.hindrance(a_step()) is None


def test_live_shots_swing_ends_shortage_of_supply(plan: CampaignPlan) -> None:
    bench: Any = StandingBench(state="ARMED", phase="HOLD", supply_pressure_pa=7.7e5)
    with shots_of(plan, bench) as source:
        with pytest.raises(ShotPostponed):
            source._prepare(a_step(), bench.status())
        bench._status["supply_pressure_pa"] = 7.8e5
        assert source._prepare(a_step(), bench.status())
        bench._status |= {"state": "READY", "phase": "STANDING", "supply_pressure_pa": 1.0e5}
        assert source.hindrance(a_step()) is None  # vented after the swing


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> tuple[SwingRecord, Launch]:
    """Return the record of a swing that struck the ball, and the launch."""
    c, profile = SHIPPED, assessed()["default", "driver"]
    robot = Bench.of(c, profile)
    swing = simulate_swing(replace(robot, plant=replace(c.plant, ball=Ball())))
    assert swing.launch is not None
    metadata = {
        **robot.metadata(),
        "outcome": {"cause": "NONE"},
        "complete": True,
        "lost_records": 0,
        "time_utc": "2026-11-21T12:00:00+00:00",
    }
    path = tmp_path_factory.mktemp("record") / "swing.parquet"
    return SwingRecord(path, swing.cycles, json.loads(json.dumps(metadata))), swing.launch


def reported(launch: Launch, carry: float | None) -> ShotPublication:
    """Return the launch monitor's report of a ball."""
    told = LaunchRecord(1.0, "monitor", 1, **launch._asdict(), carry=carry)
    return shot_publication(shot_id="1", outcome=MatchOutcome.MATCHED, launch=launch_to_json(told))


def of_carry(plan: CampaignPlan, carry: Any) -> CampaignPlan:
    """Return `plan` that compares this carry."""
    return with_values(plan, analysis={"carry": carry})


def monitored_shot(
    plan: CampaignPlan, swing: SwingRecord, launch: Launch, carry: float | None = None, air: Air | None = None
) -> Shot:
    """Return the shot of a real bench with this record, of which a launch monitor reported `launch`."""
    source = shots_of(plan, StandingBench(), simulated=False, monitored=True, air=air)
    return source._taken(a_step(), 1, 1, swing, reported(launch, carry)).shot


def test_live_shots_monitored_simulated_bench_tees_balls_of_plan(
    plan: CampaignPlan, record: tuple[SwingRecord, Launch], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The launch monitor sees the ball that the plant strikes."""
    teed = list[str]()

    class Hands:
        def __init__(self, folder: Path) -> None: ...

        def __enter__(self) -> Hands:
            return self

        def __exit__(self, *_: object) -> None: ...

        def choose_ball(self, ball: Ball | None) -> None:
            teed.append(ball.name if ball else "its own")

    monkeypatch.setattr("bench.campaign.run._live_shots.SurroundingsWriter", Hands)
    monkeypatch.setattr("bench.network.bench_operator._FEED", 0.1)
    monkeypatch.setattr("bench.network.bench_operator.REST", 0.0)
    bench = StandingBench(state="ARMED", phase="HOLD", time=5.0, ball_present=False)
    step = a_step()._replace(trial=a_step().trial._replace(arm=Arm("default", "driver", "range")))
    with shots_of(plan, bench, monitored=True) as source:
        source.take(step, 1, 1)
        swing, launch = record
        taken = source._taken(step, 1, 1, swing, reported(launch, None))
    assert teed == ["range", "its own"]
    assert taken.metadata["varied"]["struck_in_the_plant"] == "range" != SHIPPED.plant.ball.name
    assert taken.shot.launch_source == "launch monitor"


def test_live_shots_reference_carry_uses_measured_air(
    plan: CampaignPlan, record: tuple[SwingRecord, Launch]
) -> None:
    carries, temperatures = [], []
    for air in (None, SHIPPED.air, Air(263.15)):
        shot = monitored_shot(of_carry(plan, "reference"), *record, air=air)
        assert shot.carry_m is not None
        carries.append(shot.carry_m)
        temperatures.append(shot.air_temperature_k)
    assert temperatures == [None, SHIPPED.air.temperature, 263.15]
    assert carries[0] == carries[1]
    assert carries[2] < carries[1]  # cold air is dense


def test_live_shots_time_is_begin_of_swing(plan: CampaignPlan, record: tuple[SwingRecord, Launch]) -> None:
    swing, launch = record
    waited = np.concatenate([np.repeat(swing.cycles[:1], 3), swing.cycles])
    waited["time"][:3] -= (9.0, 8.0, 7.0)
    waited["state"] = np.repeat([State.ARMED, State.SWINGING], [3, len(swing.cycles)])
    shot = monitored_shot(plan, swing._replace(cycles=waited), launch)
    assert shot.time_utc == swing.time_utc + timedelta(seconds=9.0)


def test_live_shots_real_carry_ignores_planned_ball(
    plan: CampaignPlan, record: tuple[SwingRecord, Launch]
) -> None:
    shots = []
    for drag in (1.0, 0.5):
        balls = {name: replace(ball, drag_factor=drag) for name, ball in plan.balls.items()}
        shots.append(monitored_shot(replace(plan, balls=balls), *record, carry=187.5))
    assert shots[0] == shots[1]
    (shot, _) = shots
    assert (shot.carry_m, shot.carry_monitor_m, shot.carry_source) == (187.5, 187.5, "monitor")
    assert shot.carry_reference_m is not None
    assert (shot.carry_measured_m, shot.total_m, shot.flight_source) == (None, None, "")
    silent = monitored_shot(plan, *record)
    assert silent.status is ShotStatus.EXCLUDED
    assert silent.reason == "no carry: the launch monitor reported none"


LOW_SUPPLY = """
[lifecycle]
hold_between_swings = true
[faults.compressor]
signal = "supply"
kind = "scale"
value = 0.9
duration = 45.0
"""


@pytest.mark.release
@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(400)
def test_run_campaign_low_supply_waits_and_continues(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "live", LOW_SUPPLY)
    (tmp_path / "plan.toml").write_text(PLAN)
    configuration = load_configuration(file)
    plan = load_plan(tmp_path / "plan.toml", configuration)
    stood = []
    with (
        running_bench(file) as bench,
        open_database(database_url("", configuration.bench.data_dir)) as engine,
    ):

        class Noting(Watcher):
            def standing(self, state: CampaignState, reason: str) -> None:
                stood.append((state, reason[:9], bench.client.status()["state"]))

        store, facts = CampaignStore(engine), bench_facts(plan, configuration, bench.client.status())
        entry = new_entry(plan, configuration, datetime.now(UTC), simulated=True, real_time=facts)
        store.begin(entry)
        outcome = run_campaign(entry, configuration, store, Noting(), never)
        assert (outcome.state, outcome.shots, outcome.valid) == (CampaignState.FINISHED, 2, 2)
        assert stood[:3] == [
            (CampaignState.RUNNING, "", "ESTOP"),
            (CampaignState.SUSPENDED, "supply 7.", "ARMED"),
            (CampaignState.RUNNING, "", "ARMED"),
        ]
        assert bench.client.status()["swings"] == 2
        assert [event.kind for event in store.events(entry.id)] == ["reset", "suspended"]


TWO_CLUBS = """
[campaign]
name = "two-clubs"
[design]
compare = "club"
balls = ["tour"]
clubs = ["driver-9", "driver"]
blocks = 1
seed = 1                          # driver first
[warm_up]
at_most = 0
practice = false
[gate]
reference = "planned"
club_speed = 4.0
shaft_lean_deg = 0.0
strike_x = 0.03
strike_y = 0.03
[analysis]
drift = "none"
[clubs.driver-9]
like = "driver"
loft_deg = 13.5
"""


def call(file: Path, *arguments: str | Path) -> tuple[int, str]:
    """Run `golfbench campaign ...` to its end."""
    with campaign(file, *arguments) as process:
        output, _ = process.communicate(timeout=120)
        return process.returncode, output


@pytest.mark.release
@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(400)
def test_campaign_runner_killed_during_club_change_resumes(
    tmp_path: Path,
) -> None:
    urls = tmp_path / "notify.urls"
    file = write_configuration(
        tmp_path, "clubs", f'[lifecycle]\nhold_between_swings = true\n[notifications]\nfile = "{urls}"\n'
    )
    (tmp_path / "plan.toml").write_text(TWO_CLUBS)
    data_dir = load_configuration(file).bench.data_dir
    with (
        webhook() as (url, notified, _),
        running_bench(file) as bench,
        open_database(database_url("", data_dir)) as engine,
    ):
        urls.write_text(url)
        urls.chmod(0o600)
        store = CampaignStore(engine)
        with campaign(file, "run", tmp_path / "plan.toml", "--ask") as process:
            while not (entries := store.entries()) or entries[0][1].state is not CampaignState.WAITING:
                time.sleep(0.1)
                assert process.poll() is None
            name = entries[0][0].id
            (told,) = bench.client._session.get(f"golfbench/{bench.configuration.bench.id}/campaign/{name}")
            assert told.ok is not None
            heard = json.loads(told.ok.payload.to_bytes())
            assert (heard["state"], heard["shots"], heard["planned"]) == ("waiting", 1, 2)
            assert heard["reason"] == "Mount club driver-9 in place of driver."
            assert bench.client.status()["state"] == "ACCESS"
            code, output = call(file, "run", tmp_path / "plan.toml")
            assert code == ExitCode.REFUSED, output
            assert f"campaign {name}" in " ".join(output.split())
            assert len(store.entries()) == 1
            process.kill()
        assert call(file, "answer", name, "--by", "Ann")[0] == ExitCode.OK
        assert call(file, "answer", name)[0] == ExitCode.REFUSED
        code, output = call(file, "resume", name, "--ask")
        assert code == ExitCode.OK, output
        (prompt,) = store.prompts(name)
        assert (prompt.before_shot, prompt.by) == (2, "Ann")
        titles = [body["title"].partition(": ")[2].partition(" ")[2] for body in notified]
        assert titles == ["waits for a person", "is finished"]
        first, second = (stored.shot for stored in store.shots(name))
        assert [(s.club, s.status) for s in (first, second)] == [
            ("driver", ShotStatus.VALID),
            ("driver-9", ShotStatus.VALID),
        ]
        assert (second.dynamic_loft_deg or 0.0) == pytest.approx(
            (first.dynamic_loft_deg or 0.0) - 1.5, abs=0.5
        )


def wait_for(store: CampaignStore, name: str, state: CampaignState, process: subprocess.Popen[str]) -> None:
    """Wait until a campaign stands at `state`."""
    while store.standing(name).state is not state:
        time.sleep(0.05)
        assert process.poll() is None


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(600)
def test_campaign_pause_stop_bench_kill_and_abort_keep_shots(tmp_path: Path) -> None:
    file = write_configuration(tmp_path, "obeys", "[lifecycle]\nhold_between_swings = true\n")
    (tmp_path / "plan.toml").write_text(PLAN.replace("blocks = 1", "blocks = 3"))
    data_dir = load_configuration(file).bench.data_dir

    def numbers() -> list[int]:
        return [stored.shot.shot for stored in store.shots(name)]

    with open_database(database_url("", data_dir)) as engine:
        store = CampaignStore(engine)
        with running_bench(file) as bench:
            with campaign(file, "run", tmp_path / "plan.toml") as process:
                in_swing(bench, 1)
                name = store.entries()[0][0].id
                ask(store, data_dir, name, "pause")  # at once: a command takes seconds to start
                wait_for(store, name, CampaignState.PAUSED, process)
                assert numbers() == [1], "the shot under way is completed and stored"
                bench.wait_until(lambda record: record["state"] == State.READY)
                assert call(file, "resume", name)[0] == ExitCode.OK
                in_swing(bench, 2)
                ask(store, data_dir, name, "stop")
                assert process.wait(60) == ExitCode.REFUSED
            assert store.standing(name).state is CampaignState.STOPPED
            assert numbers() == [1, 2]
            with campaign(file, "resume", name) as process:
                in_swing(bench, 3)
                bench.process.kill()  # the loop stops by itself, the runner hears nothing more
                output, _ = process.communicate(timeout=120)
                assert process.returncode == ExitCode.REFUSED, output
            assert store.standing(name).state is CampaignState.SUSPENDED
            assert numbers() == [1, 2]
        with running_bench(file) as bench, campaign(file, "resume", name) as process:
            in_swing(bench, 2)
            assert numbers() == [1, 2, 3]
            ask(store, data_dir, name, "abort")
            assert process.wait(60) == ExitCode.REFUSED
            assert bench.wait_until(lambda record: record["state"] == State.FAULT)["cause"]
            assert bench.cause == "OPERATOR_STOP"
        assert store.standing(name).state is CampaignState.ABORTED
        assert [stored.shot.status for stored in store.shots(name)][:3] == [ShotStatus.VALID] * 3
        events = store.events(name)
        stops = ["stopped", "look", "resumed", "suspended", "resumed", "reset"]
        assert [event.kind for event in events] == ["reset", "paused", "resumed", *stops, "aborted", "look"]
        assert "previous shutdown was unclean" in events[-3].text


class ArmableBench(StandingBench):
    """Arms, swings and stays armed, or not (`series`), at once."""

    def __init__(self, *, series: bool) -> None:
        super().__init__(time=0.0, ball_present=False, series=series)

    def status(self) -> dict[str, Any]:
        self._status["time"] += 2.0
        return self._status

    def arm(self, retry_timeout: float) -> None:
        self.asked.append("arm")
        self._status |= {"state": "ARMED", "phase": "HOLD"}

    def tee(self, retry_timeout: float) -> None:
        self.asked.append("tee")
        self._status["ball_present"] = True

    def swing(self, retry_timeout: float) -> None:
        self.asked.append("swing")
        self._status |= {"ball_present": False, "state": "ARMED" if self._status["series"] else "READY"}


@pytest.mark.parametrize(
    ("series", "practice", "planned", "asked"),
    [
        (True, True, False, ["arm", "swing", "tee", "swing", "tee", "swing"]),
        (False, True, False, ["arm", "tee", "swing", "arm", "tee", "swing"]),
        (True, False, False, ["arm", "tee", "swing", "tee", "swing"]),
        (True, True, True, ["arm", "tee", "swing", "tee", "swing"]),
        (False, True, True, ["arm", "tee", "swing", "arm", "tee", "swing"]),
    ],
)
def test_live_shots_arming_in_series_without_planned_air_adds_practice_swing(
    plan: CampaignPlan, series: bool, practice: bool, planned: bool, asked: list[str]
) -> None:
    plan = with_values(plan, warm_up={"practice": practice})
    bench = ArmableBench(series=series)
    with shots_of(plan, bench, planned=planned) as source:
        for _ in range(2):
            source._operator.begin_swing(lambda status: source._prepare(a_step(), status), ball=True)
            source._operator.wait_until_over()
    assert bench.asked == asked
    assert [kind for kind, _ in source._events] == ["practice"] * (series and practice and not planned)


def test_live_shots_second_drift_is_noted(plan: CampaignPlan) -> None:
    speed, strike = "club speed 43.1 m/s", "the head met the ball +18 mm off"
    with shots_of(plan, ArmableBench(series=True)) as source:
        for warnings in ([speed], [speed], [speed, strike], [speed, strike], [strike]):
            source._note_drift(warnings)
        noted = [text.partition(";")[0] for kind, text in source._events if kind == "drift"]
    assert noted == [speed, speed, strike]


def test_live_shots_drift_in_status_becomes_one_event(plan: CampaignPlan) -> None:
    bench, noted = ArmableBench(series=True), list[str]()
    with shots_of(plan, bench) as source:
        for drift in ([], ["club speed 43.1 m/s"], ["club speed 43.0 m/s"], [], ["club speed 42.9 m/s"]):
            bench._status["drift"] = drift
            source._operator.begin_swing(lambda status: source._prepare(a_step(), status), ball=True)
            noted += [text for kind, text in source._events if kind == "drift"]
            source._events.clear()
    assert noted == [f"club speed {speed} m/s; parts: golfbench wear" for speed in ("43.1", "42.9")]


class Listening(Watcher):
    """Keeps the texts."""

    def __init__(self) -> None:
        self.texts: list[str] = []

    def say(self, text: str) -> None:
        self.texts.append(text)


class Relearning(AsDesigned):
    """Corrects a drifted swing once, at the address."""

    def refresh(self, drift: Drift, number: int, robot: Any, truth: Any = None) -> str:
        profile = self.designed(drift.arm)
        with robot(SimpleNamespace(bench=SimpleNamespace(profile=profile))) as swinger:
            swinger.correct(np.zeros(1))
        return "relearned"


@pytest.mark.parametrize(
    ("state", "by", "error", "asked"),
    [
        ("FAULT", "", Suspended, []),
        ("READY", "abort", Suspended, ["stop"]),
        ("READY", "interrupt", KeyboardInterrupt, []),
    ],
)
def test_relearn_stop_by_person_ends_learning(
    plan: CampaignPlan, state: str, by: str, error: type[BaseException], asked: list[str]
) -> None:
    bench = StandingBench(
        state=state, driver="canopen", profile="default", launch_monitor=None, lease={"holder": "learn"}
    )
    source = shots_of(
        plan,
        bench,
        simulated=False,
        aborted=lambda: by == "abort",
        interrupted=lambda: by == "interrupt",
    )
    source._swings = Relearning(assessed())
    with source, pytest.raises(error):
        source.relearn(Drift(("default", "driver"), "drifted"), 1)
    assert bench.asked == asked


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.release
@pytest.mark.timeout(400)
def test_run_campaign_drift_relearns_swing_without_ball(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That it drifts is said here; a simulated robot of a running bench does not."""
    file = write_configuration(tmp_path, "relearned", "[lifecycle]\nhold_between_swings = true\n")
    (tmp_path / "plan.toml").write_text(PLAN + "[learning]\nrefresh = true\nswings = 1\n")
    configuration = load_configuration(file)
    plan = load_plan(tmp_path / "plan.toml", configuration)
    arm = ("default", "driver")
    asked = chain([None, Drift(arm, "drifted")], repeat(None))
    monkeypatch.setattr(
        "bench.campaign.run._corrections.DriftDetector.before", lambda self, step: next(asked)
    )
    monkeypatch.setattr("bench.learning.learn.LearningResult.within", True)
    url = database_url("", configuration.bench.data_dir)
    with running_bench(file) as bench, open_database(url) as engine:
        store, said = CampaignStore(engine), Listening()
        facts = bench_facts(plan, configuration, bench.client.status())
        entry = new_entry(plan, configuration, datetime.now(UTC), simulated=True, real_time=facts)
        store.begin(entry)
        outcome = run_campaign(entry, configuration, store, said, never)
        shots = [stored.shot for stored in store.shots(entry.id)]
        assert [shot.reason for shot in shots] == ["", ""], (outcome, said.texts)
        assert outcome.state is CampaignState.FINISHED
        assert bench.client.status()["swings"] == 4
        assert any("drifted; relearned in 1 learning swings, version 1" in text for text in said.texts)
        files = [configuration.bench.data_dir / stored.file for stored in store.shots(entry.id)]
        first, second = (read_swing(file)[1] for file in files)
        assert "correction" not in first["profile"]
        (learned,) = learned_swings(engine, configuration.bench.id, arm[0])
        assert second["profile"]["correction"]["weights"] == list(learned.weights)
        for record in bench.records:  # those of the learner stay with the bench
            assert not read_swing(record)[0]["ball_present"].any()
