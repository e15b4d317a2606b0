"""The runner obeys, stores batches, evaluates deliveries, and resumes after an interruption."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache, reduce
from operator import getitem
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest
from sqlalchemy import make_url

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError, Refused
from bench.campaign.interruptions import changed
from bench.campaign.plan.bench_setup import sample_for
from bench.campaign.plan.gate import Centre, outside
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role, Step, all_trials
from bench.campaign.run._corrections import Drift
from bench.campaign.run.campaign_control import ask, is_running, runner_lock
from bench.campaign.run.plan_requirements import Profiles, require_swings
from bench.campaign.run.runner import Runner, RunOutcome
from bench.campaign.run.runner_control import (
    CANNOT_CHANGE_A_SHOT,
    course_of,
    new_entry,
    require_resumable,
    run_start,
)
from bench.campaign.run.shot_source import (
    BlockingCondition,
    ShotPostponed,
    ShotSource,
    Suspended,
    Taken,
    Watcher,
)
from bench.config import database_url
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import read_swing, write_swing
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignEntry, CampaignRun, CampaignState, Hit
from drivers.base import ACTUATORS
from drivers.base.compiled import new_record
from tests.bench.campaign.plans import NOW, SHIPPED, row_of, shipped_plan, with_values
from tests.bench.running_postgres import running_postgres
from tests.sampling import release_except


class Scripted(ShotSource):
    """Shots without a robot; `script` gives columns of single shots by number, or raises."""

    simulated = True

    def __init__(self, script: Callable[[int], dict[str, Any]] = lambda _: {}) -> None:
        self.script = script
        self.taken: list[tuple[int, Step, int]] = []

    def time_of(self, number: int) -> datetime:
        return NOW + timedelta(seconds=48 * number)

    def relearn(self, drift: Drift, number: int) -> str:
        return f"learned {drift.arm} before {number}"

    def take(self, step: Step, number: int, sample: int) -> Taken:
        self.taken.append((number, step, sample))
        values: dict[str, Any] = {
            "club_speed_mps": 42.9,
            "attack_angle_deg": 2.0,
            "dynamic_loft_deg": 11.1,
            "strike_x_mm": 0.0,
            "strike_y_mm": 0.0,
            "carry_m": 180.0 + 0.1 * (number * 7 % 11),
            "ball_speed_mps": 62.0,
            "delivery_source": "simulated",
            "time_utc": self.time_of(number),
        } | self.script(number)
        shot = row_of(step.trial, number, sample, step.attempt, **values)
        cycles = None if "jam" in shot.reason else new_record(CYCLE, 3)
        return Taken(shot, cycles, {"seed": 1}, shot.ball_speed_mps is not None)


def acting(actions: Mapping[int, Callable[[], object]]) -> Callable[[int], dict[str, Any]]:
    """Return a script that acts at some shots."""

    def script(number: int) -> dict[str, Any]:
        if number in actions:
            actions[number]()
        return {}

    return script


JAM = {"status": ShotStatus.FAILED, "reason": "feeder jam: no ball came", "ball_speed_mps": None}


def cut_power() -> NoReturn:
    raise RuntimeError("power cut")


PLAN = shipped_plan("symmetry", design={"blocks": 3}, stop={"rule": "fixed"})


@cache
def profiles() -> Profiles:
    """Return the profiles of the plan, assessed once for all tests."""
    return require_swings(PLAN, SHIPPED)


class Bench:
    """A plan, a database and a runner a call."""

    def __init__(self, folder: Path, engine: Any, plan: CampaignPlan) -> None:
        self.configuration = replace(SHIPPED, bench=replace(SHIPPED.bench, data_dir=folder))
        self.folder, self.plan = folder, plan
        self.store = CampaignStore(engine)
        begun = NOW + timedelta(seconds=len(self.store.entries()))
        self.entry: CampaignEntry = new_entry(plan, self.configuration, begun, simulated=True)
        self.store.begin(self.entry)
        self.watcher = Watcher()

    def run(
        self,
        source: Scripted,
        interrupted: Callable[[], bool] = never,
        batch: int = 4,
        start: CampaignRun | None = None,
    ) -> RunOutcome:
        runner = Runner(
            self.entry, self.plan, self.store, self.folder, source, self.watcher, batch, start=start
        )
        return runner.run(course_of(self.plan, profiles(), SHIPPED.plant.robot.lie), interrupted)

    @property
    def shots(self) -> list[Shot]:
        return [stored.shot for stored in self.store.shots(self.entry.id)]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Bench]]:
    monkeypatch.setattr("bench.store.database.BUSY_TIMEOUT", 0.1)
    with open_database(database_url("", tmp_path), NOW) as engine:
        yield lambda **changes: Bench(tmp_path, engine, with_values(PLAN, **changes))


class Whole(NamedTuple):
    """A campaign in a single run."""

    stored: list[StoredShot]
    hits: Mapping[Hit, int]

    @property
    def shots(self) -> list[Shot]:
        return [one.shot for one in self.stored]


def run_whole(folder: Path, source: Scripted) -> Whole:
    with open_database(database_url("", folder), NOW) as engine:
        bench = Bench(folder, engine, PLAN)
        bench.run(source)
        return Whole(bench.store.shots(bench.entry.id), bench.store.hits(bench.entry.id))


def test_runner_completes_campaign_with_every_shot_and_file(make: Callable[..., Bench]) -> None:
    bench = make()
    outcome = bench.run(Scripted())
    assert outcome == (CampaignState.FINISHED, "", 18, 18)
    assert [shot.role for shot in bench.shots][:3] == ["warm-up"] * 3
    assert [shot.shot for shot in bench.shots] == list(range(1, 19))
    for stored in bench.store.shots(bench.entry.id):
        cycles, metadata = read_swing(bench.folder / stored.file)
        assert len(cycles) == 3
        assert metadata["shot"]["shot"] == stored.shot.shot
        assert metadata["campaign"] == bench.entry.id
    hits = bench.store.hits(bench.entry.id)
    assert hits[Hit("club", "driver")] == hits[Hit("valve", ACTUATORS[0])] == 18
    assert sum(n for hit, n in hits.items() if hit.kind == "ball") == 18


def test_runner_invalid_shot_is_repeated_within_limit(make: Callable[..., Bench]) -> None:
    bench = make()
    lost = {"status": ShotStatus.EXCLUDED, "reason": "the launch monitor saw no ball", "ball_speed_mps": None}
    outcome = bench.run(Scripted(lambda n: lost if n in {5, 8, 9, 10} else {}))
    assert outcome.state is CampaignState.FINISHED
    attempts = [(s.shot, s.position, s.attempt) for s in bench.shots if s.block == 1]
    expected = [(1, 1), (2, 1), (2, 2), (3, 1), (4, 1), (4, 2), (4, 3), (5, 1)]
    assert attempts == [(shot, *place) for shot, place in enumerate(expected, 4)]


def test_runner_delivery_outside_gate_is_excluded(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.run(Scripted(lambda n: {"club_speed_mps": 44.0} if n == 6 else {}))
    excluded = [shot for shot in bench.shots if shot.status is ShotStatus.EXCLUDED]
    assert [shot.shot for shot in excluded] == [6]
    assert excluded[0].reason == "club speed 44.00 m/s, outside 42.90 ± 1.00 m/s (simulated)"


def test_runner_ball_flight_excludes_no_shot(make: Callable[..., Bench]) -> None:
    bench = make()
    assert bench.run(Scripted(lambda n: {"carry_m": 10.0 * n, "ball_speed_mps": 1.0 + n})).valid == 18


def test_runner_warm_up_ends_at_stable_speed_or_suspends(make: Callable[..., Bench]) -> None:
    bench = make()
    outcome = bench.run(Scripted(lambda n: {"club_speed_mps": 40.0 + n} if n < 4 else {}))
    assert outcome.state is CampaignState.FINISHED
    assert sum(shot.role == "warm-up" for shot in bench.shots) == 5
    other = make(campaign={"name": "cold"})
    refused = other.run(Scripted(lambda n: {"club_speed_mps": 40.0 + n}))
    assert refused.state is CampaignState.SUSPENDED
    assert "did not warm up" in refused.reason
    assert refused.shots == 10


def test_runner_control_ball_speed_outside_tolerance_suspends(make: Callable[..., Bench]) -> None:
    bench = make(set_up={"control_ball_speed": 60.0, "tolerance": 1.0})
    outcome = bench.run(Scripted())
    assert outcome.state is CampaignState.SUSPENDED
    assert "62.00 m/s, wanted 60 ± 1 m/s" in outcome.reason


def test_runner_consecutive_failures_suspend_and_resume_finishes(make: Callable[..., Bench]) -> None:
    bench = make()
    outcome = bench.run(Scripted(lambda n: JAM if n >= 7 else {}))
    assert outcome.state is CampaignState.SUSPENDED
    assert outcome.reason == "5 shots in a row not valid, the last: feeder jam: no ball came"
    assert bench.store.shots(bench.entry.id)[-1].file == ""
    assert bench.run(Scripted()).state is CampaignState.FINISHED


def test_runner_samples_alternate_up_to_hit_limit(make: Callable[..., Bench]) -> None:
    bench = make(ball_handling={"samples": 2, "hits": 3})
    source = Scripted()
    outcome = bench.run(source)
    assert outcome.state is CampaignState.SUSPENDED
    assert "balls used up: every sample of 'tour' has its 3 hits" in outcome.reason
    assert max(bench.store.hits(bench.entry.id)[Hit("ball", "tour", n)] for n in (1, 2)) == 3
    samples = [sample for _, step, sample in source.taken if step.trial.arm.ball == "tour"]
    assert samples == [1, 2, 1, 2, 1, 2]


def test_runner_stopping_rule_ends_section_early(make: Callable[..., Bench]) -> None:
    bench = make(
        design={"blocks": 12}, stop={"rule": "width", "width": 5.0, "min_blocks": 3, "interim_analyses": 4}
    )
    outcome = bench.run(Scripted())
    assert outcome.state is CampaignState.FINISHED
    assert "section 1 after 3 of 12 blocks" in outcome.reason
    assert max(shot.block for shot in bench.shots) == 3


def test_runner_obeys_stop_pause_and_abort(make: Callable[..., Bench]) -> None:
    bench = make()

    def asked(request: str, at: int) -> Callable[[int], dict[str, Any]]:
        return acting({at: lambda: bench.store.change(bench.entry.id, requested=request)})

    stopped = bench.run(Scripted(asked("stop", 6)))
    assert (stopped.state, stopped.shots) == (CampaignState.STOPPED, 6)
    assert len(bench.shots) == 6

    def let_go() -> None:
        while bench.store.standing(bench.entry.id).state is not CampaignState.PAUSED:
            time.sleep(0.02)
        assert len(bench.shots) == 9
        bench.store.change(bench.entry.id, requested="")

    friend = threading.Thread(target=let_go)
    friend.start()
    paused = bench.run(Scripted(asked("pause", 9)))
    friend.join()
    assert paused == (CampaignState.FINISHED, "", 18, 18)
    other = make(campaign={"name": "other"})
    bench = other
    aborted = other.run(Scripted(asked("abort", 5)))
    assert (aborted.state, aborted.shots) == (CampaignState.ABORTED, 5)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return run_whole(tmp_path_factory.mktemp("whole"), Scripted())


@pytest.mark.parametrize("at", release_except({1, 6, 18}, [1, 5, 6, 13, 18]))
def test_runner_resume_after_any_shot_equals_single_run(
    make: Callable[..., Bench], at: int, whole: Whole
) -> None:
    broken = make(campaign={"name": "broken"})
    with pytest.raises(RuntimeError):
        broken.run(Scripted(acting({at: cut_power})))
    assert len(broken.shots) == at - 1
    broken.run(Scripted())
    assert broken.shots == whole.shots
    assert broken.store.hits(broken.entry.id) == whole.hits


def test_runner_full_disk_keeps_shots_and_resumes(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make()
    real = write_swing

    def full(path: Path, *arguments: Any) -> None:
        if path.stem == "000007":
            raise NotStored(str(path), "No space left on device", "space", "Free some.")
        real(path, *arguments)

    monkeypatch.setattr("bench.campaign.run.runner.write_swing", full)
    with pytest.raises(NotStored):
        bench.run(Scripted())
    assert [shot.shot for shot in bench.shots] == list(range(1, 7))
    monkeypatch.setattr("bench.campaign.run.runner.write_swing", real)
    assert bench.run(Scripted()) == (CampaignState.FINISHED, "", 18, 18)


def test_runner_stored_shot_of_other_plan_is_refused(make: Callable[..., Bench]) -> None:
    bench = make()
    bench.run(Scripted(), batch=4)
    bench.plan = with_values(PLAN, design={"seed": 99})
    with pytest.raises(BenchError, match="do not belong to its plan"):
        bench.run(Scripted())


def test_require_resumable_other_plan_or_configuration_is_refused(make: Callable[..., Bench]) -> None:
    bench = make()
    state, configuration = CampaignState.STOPPED, bench.configuration
    require_resumable(bench.entry, state, configuration, bench.plan)
    other = with_values(PLAN, design={"blocks": 4})
    with pytest.raises(Refused, match="a different plan"):
        require_resumable(bench.entry, state, configuration, other)
    before = json.loads(json.dumps(bench.entry.configuration))
    del before["plant"]["robot"]["club"]["restitution_slope"]
    with pytest.raises(Refused, match="restitution_slope"):
        require_resumable(replace(bench.entry, configuration=before), state, configuration, bench.plan)
    warmer = replace(configuration, air=replace(configuration.air, temperature=300.0))
    with pytest.raises(Refused, match=r"air\.temperature"):
        require_resumable(bench.entry, state, warmer, None)
    with pytest.raises(Refused, match="finished"):
        require_resumable(bench.entry, CampaignState.FINISHED, configuration, None)


@pytest.mark.parametrize("key", CANNOT_CHANGE_A_SHOT)
def test_require_resumable_change_without_effect_on_shots_passes(
    make: Callable[..., Bench], key: str
) -> None:
    bench = make()
    stored = json.loads(json.dumps(bench.entry.configuration))
    *tables, last = key.split(".")
    table = reduce(getitem, tables, stored)
    assert last in table
    table[last] = "as it was"
    before = replace(bench.entry, configuration=stored)
    require_resumable(before, CampaignState.SUSPENDED, bench.configuration, None)


def test_changed_reports_moved_network_endpoint(make: Callable[..., Bench]) -> None:
    bench = make()
    c = bench.configuration
    moved = replace(c, network=replace(c.network, endpoint="tcp/127.0.0.1:9"))
    changes = changed(run_start("", c, {}).facts, run_start("", moved, {}).facts)
    assert changes == [f"network.endpoint {c.network.endpoint} → tcp/127.0.0.1:9"]


def test_runner_lock_allows_one_runner_per_campaign(make: Callable[..., Bench]) -> None:
    bench = make()
    name = bench.entry.id
    with pytest.raises(Refused, match="no runner"):
        ask(bench.store, bench.folder, name, "pause")
    with runner_lock(bench.folder, name):
        assert is_running(bench.folder, name)
        with pytest.raises(Refused, match=f"which runs campaign {name}"), runner_lock(bench.folder, name):
            pass
        assert "pauses" in ask(bench.store, bench.folder, name, "pause")
        assert bench.store.standing(name).requested == "pause"
    assert not is_running(bench.folder, name)
    assert "aborted" in ask(bench.store, bench.folder, name, "abort")
    with pytest.raises(Refused, match="unfinished"):
        ask(bench.store, bench.folder, name, "stop")


def test_sample_for_selects_least_used_ball() -> None:
    plan = with_values(PLAN, ball_handling={"samples": 3, "first_sample": 5, "hits": 2})
    hits = Counter({Hit("ball", "pole", 5): 1, Hit("ball", "pole", 7): 2})
    trial = PlannedShot(Role.TEST, 1, 1, 1, Arm("default", "driver", "pole"))
    assert sample_for(plan, trial, hits) == 6
    assert sample_for(plan, trial, Counter({Hit("ball", "pole", n): 2 for n in (5, 6, 7)})) is None


def test_outside_unmeasured_figure_is_reported_only_with_centre() -> None:
    shot, club = row_of(all_trials(PLAN)[0], 1, delivery_source="simulated"), PLAN.clubs["driver"]
    assert outside(shot, club, Centre(), PLAN.gate) == ("", "")
    found = outside(shot, club, Centre(club_speed=43.0), PLAN.gate)
    assert found == ("club_speed", "club speed not measured")
    by_monitor = replace(PLAN.gate, sources=("launch monitor",))
    assert outside(shot, club, Centre(), by_monitor) == (
        "",
        "delivery from simulated, which the plan does not accept",
    )


@pytest.mark.release
@pytest.mark.live
@pytest.mark.paced
def test_campaign_random_kills_give_same_shots() -> None:
    """Two hundred kills: `python -m tests.benchmarks campaign_kills`."""
    command = [sys.executable, "-m", "tests.benchmarks", "campaign_kills"]
    # A process of its own: it forks its runners, and must not have started threads before.
    options = ["--kills", "3", "--batch", "3", "--blocks", "24"]
    done = subprocess.run([*command, *options], capture_output=True, text=True, timeout=110, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


class Clock(Scripted):
    """Shots every 48 s of a clock that jumps by `jumps` (s) before some of them, at some other `speeds`."""

    def __init__(self, jumps: dict[int, float], speeds: dict[int, float] | None = None) -> None:
        speeds = speeds or {}
        super().__init__(lambda n: {"club_speed_mps": speeds[n]} if n in speeds else {})
        self.jumps = jumps

    def time_of(self, number: int) -> datetime:
        late = sum(jump for at, jump in self.jumps.items() if at <= number)
        return super().time_of(number) + timedelta(seconds=late)


def _events(bench: Bench) -> list[tuple[int, str, str]]:
    return [(event.before_shot, event.kind, event.text) for event in bench.store.events(bench.entry.id)]


def test_runner_long_gap_repeats_warm_up_and_restarts_block(make: Callable[..., Bench]) -> None:
    """The robot is 1.5 m/s slower the next day: by the centre of the day before no shot would be valid."""
    bench = make()
    slower = dict.fromkeys(range(8, 60), 41.4)
    clock = Clock({8: 9.3 * 3600}, slower)
    outcome = bench.run(clock, lambda: len(clock.taken) == 7)
    assert outcome.state is CampaignState.STOPPED
    assert bench.run(Clock({8: 9.3 * 3600}, slower)) == (CampaignState.FINISHED, "", 25, 21)
    stored = bench.store.shots(bench.entry.id)
    assert [one.shot.shot for one in stored if one.set_aside] == [4, 5, 6, 7]
    assert {one.shot.status for one in stored if one.set_aside} == {ShotStatus.EXCLUDED}
    assert [(one.shot.role, one.shot.block, one.shot.position) for one in stored[7:12]] == [
        ("warm-up", 0, 1),
        ("warm-up", 0, 2),
        ("warm-up", 0, 3),
        ("control", 1, 1),
        ("test", 1, 2),
    ]
    assert not [s.reason for s in bench.shots if s.status is ShotStatus.EXCLUDED and s.shot > 7]
    (restart,) = [event for event in _events(bench) if event[1] == "restart"]
    assert restart[0] == 8
    assert restart[2] == "9.3 h without a shot: block 1 restarts after a new warm-up; set aside: shots 4 to 7"
    assert all(stored[n].shot.reason == restart[2] for n in range(3, 7))


JUMPS = {8: 5000.0, 17: 2000.0}


@pytest.fixture(scope="module")
def restarted(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    return run_whole(tmp_path_factory.mktemp("restarted"), Clock(JUMPS))


@pytest.mark.parametrize("at", release_except({7, 9, 17}, range(1, 24, 2)))
def test_runner_resume_after_block_restart_equals_single_run(
    make: Callable[..., Bench], at: int, restarted: Whole
) -> None:
    cut, clock = make(), Clock(JUMPS)
    cut.run(clock, lambda: len(clock.taken) == at, batch=1)
    cut.run(Clock(JUMPS))
    assert cut.shots == restarted.shots
    marks = [one.set_aside for one in cut.store.shots(cut.entry.id)]
    assert marks == [one.set_aside for one in restarted.stored]
    assert any(marks)


def test_runner_tolerated_gap_restarts_no_block(make: Callable[..., Bench]) -> None:
    bench = make()
    assert bench.run(Clock({7: 1700.0})).shots == 18
    never_restarted = make(interruption={"restart_after": 0.0})
    assert never_restarted.run(Clock({7: 1e6})).shots == 18
    between = make(warm_up={"at_most": 0}, gate={"reference": "planned"})
    assert between.run(Clock({1: 1e6, 6: 1e6})).shots == 15
    assert [(at, kind) for at, kind, _ in _events(between)] == [(6, "gap")]


def test_runner_slow_block_restarts_at_most_twice(make: Callable[..., Bench]) -> None:
    bench = make(warm_up={"at_most": 0}, gate={"reference": "planned"})
    outcome = bench.run(Clock(dict.fromkeys(range(3, 200), 4000.0)))
    assert outcome.state is CampaignState.FINISHED
    kinds = Counter(kind for _, kind, _ in _events(bench))
    assert kinds["restart"] == 6
    assert "was restarted 2 times already and continues" in _events(bench)[-1][2]


def test_runner_clock_set_back_restarts_block(make: Callable[..., Bench]) -> None:
    bench = make()
    assert bench.run(Clock({7: -3600.0})).state is CampaignState.FINISHED
    (restart,) = [text for _, kind, text in _events(bench) if kind == "restart"]
    assert restart.startswith("an unknown time without a shot (the clock went back): block 1 restarts")


def test_runner_interruptions_are_stored_as_events(make: Callable[..., Bench]) -> None:
    bench = make()
    before = datetime.now(UTC)
    for _ in range(2):
        with pytest.raises(RuntimeError):
            bench.run(Scripted(acting({5: cut_power})), batch=1)
    source = Scripted()
    bench.run(source, lambda: len(source.taken) == 2, batch=1)
    bench.run(Scripted(lambda _: JAM), batch=1)
    assert bench.run(Scripted()).state is CampaignState.FINISHED
    assert [(at, kind) for at, kind, _ in _events(bench)] == [
        (5, "killed"),
        (5, "killed"),
        (7, "stopped"),
        (7, "resumed"),
        (12, "suspended"),
        (12, "resumed"),
    ]
    events = bench.store.events(bench.entry.id)
    assert all(before <= event.date <= datetime.now(UTC) for event in events)
    assert "the runner had ended without closing the campaign; resumed, " in events[0].text
    assert events[2].text == "stopped by Ctrl-C"
    assert "feeder jam" in events[4].text
    assert "it was suspended (5 shots in a row not valid" in events[5].text


def test_runner_pause_and_stop_store_requester(make: Callable[..., Bench]) -> None:
    bench = make()
    pausing = threading.Event()

    def pause() -> None:
        ask(bench.store, bench.folder, bench.entry.id, "pause", "ann@lab")
        pausing.set()

    def stop() -> None:
        ask(bench.store, bench.folder, bench.entry.id, "stop", "bob@office")

    def go_on() -> None:
        pausing.wait(20)
        while bench.store.standing(bench.entry.id).state is not CampaignState.PAUSED:
            time.sleep(0.01)
        ask(bench.store, bench.folder, bench.entry.id, "")

    helper = threading.Thread(target=go_on)
    helper.start()
    with runner_lock(bench.folder, bench.entry.id):
        outcome = bench.run(Scripted(acting({4: pause, 9: stop})), batch=1)
    helper.join()
    assert outcome.reason == "stopped by request of bob@office"
    words = [text for _, _, text in _events(bench)]
    assert words[0] == "paused by request of ann@lab"
    assert words[1].startswith("continued after a pause of ")
    assert words[2] == "stopped by request of bob@office"


def test_runner_changed_software_or_bench_is_stored_as_event(make: Callable[..., Bench]) -> None:
    bench = make()
    first, second = (
        CampaignRun(0, NOW, by, {"numpy": numpy, "source": source}, {"club": "driver", "loop": {"cpu": cpu}})
        for by, numpy, source, cpu in (("ann", "2.4.5", "aaa", 1), ("bob", "2.4.6", "bbb", 2))
    )
    source = Scripted()
    bench.run(source, lambda: len(source.taken) == 5, start=first)
    bench.run(source, lambda: len(source.taken) == 8, start=first)
    bench.run(source, start=second)
    assert [event for event in _events(bench) if event[1] in {"software", "configuration"}] == [
        (9, "software", "software changed since run 2: numpy 2.4.5 → 2.4.6, source aaa → bbb"),
        (9, "configuration", "bench changed since run 2: loop.cpu 1 → 2"),
    ]
    assert [run.by for run in bench.store.runs(bench.entry.id)] == ["ann", "ann", "bob"]


def _hold(bench: Bench) -> sqlite3.Connection:
    """Take the database's write lock as another program does."""
    other = sqlite3.connect(bench.folder / "golfbench.sqlite", isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")
    return other


def test_runner_locked_database_is_retried_without_loss(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench, held = make(), list[sqlite3.Connection]()

    def release(text: str) -> None:
        if "database is locked" in text:
            held.pop().close()

    monkeypatch.setattr(bench.watcher, "say", release)
    script = acting({5: lambda: held.append(_hold(bench))})
    assert bench.run(Scripted(script), batch=1) == (CampaignState.FINISHED, "", 18, 18)
    assert held == []
    assert [kind for _, kind, _ in _events(bench)] == ["database"]


def test_runner_database_locked_beyond_timeout_suspends(
    make: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.campaign.run.runner._DATABASE_TIMEOUT", 0.2)
    bench, held = make(), list[sqlite3.Connection]()
    outcome = bench.run(Scripted(acting({5: lambda: held.append(_hold(bench))})), batch=1)
    held[0].close()
    assert outcome.state is CampaignState.SUSPENDED
    assert "the database was locked by another process for" in outcome.reason
    assert "the last shot is not stored and is taken again" in outcome.reason
    assert len(bench.shots) == 4
    assert bench.run(Scripted()) == (CampaignState.FINISHED, "", 18, 18)
    assert [kind for _, kind, _ in _events(bench)] == ["killed"]


@pytest.mark.live
@pytest.mark.requires("postgres")
def test_runner_restarted_database_server_is_retried_without_loss(
    make: Callable[..., Bench], tool: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make()
    heard: list[str] = []
    monkeypatch.setattr(bench.watcher, "say", heard.append)
    with (
        running_postgres(Path(tool("postgres"))) as server,
        open_database(make_url(server.url), NOW) as engine,
    ):
        bench.store = CampaignStore(engine)
        bench.store.begin(bench.entry)

        def restart() -> None:
            server.stop()
            threading.Timer(1.0, server.start).start()

        assert bench.run(Scripted(acting({5: restart})), batch=1) == (CampaignState.FINISHED, "", 18, 18)
        assert [shot.shot for shot in bench.shots] == list(range(1, 19))
        assert [kind for _, kind, _ in _events(bench)] == ["database"]
    assert any("out of reach" in text for text in heard)


class Unseen(Scripted):
    """A bench whose launch monitor goes before shot 3 and is back for good at the fifth look after it."""

    def __init__(self) -> None:
        super().__init__()
        self.looks, self.rests = 0, 0

    def hindrance(self, step: Step) -> BlockingCondition | None:
        if len(self.taken) != 2:
            return None
        self.looks += 1
        away = self.looks < 5 and self.looks != 3
        return BlockingCondition("no launch monitor is connected") if away else None

    def rest(self) -> None:
        self.rests += 1


class VirtualTime:
    """A clock that only sleep moves: a stall of the machine is no time (s)."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += seconds


@pytest.fixture
def virtual_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.campaign.run.runner.time", VirtualTime())


@pytest.mark.usefixtures("virtual_time")
def test_runner_temporary_blocking_condition_suspends_then_continues(make: Callable[..., Bench]) -> None:
    bench, source, stood = make(), Unseen(), []

    class Noting(Watcher):
        def standing(self, state: CampaignState, reason: str) -> None:
            stood.append((state, reason, len(source.taken)))

    bench.watcher = Noting()
    outcome = bench.run(source)
    assert outcome.state is CampaignState.FINISHED
    assert stood[:3] == [
        (CampaignState.RUNNING, "", 0),
        (CampaignState.SUSPENDED, "no launch monitor is connected", 2),
        (CampaignState.RUNNING, "", 2),
    ]
    assert source.looks >= 6  # it must stay away: back for one look is not back
    assert source.rests == 1
    (event,) = bench.store.events(bench.entry.id)
    assert (event.kind, event.before_shot) == ("suspended", 3)
    assert "no launch monitor is connected; continued automatically after" in event.text


@pytest.mark.usefixtures("virtual_time")
def test_runner_blocking_condition_on_machine_waits_for_resume(make: Callable[..., Bench]) -> None:
    bench, source = make(), Unseen()
    source.simulated = False
    outcome = bench.run(source)
    assert (outcome.state, outcome.reason) == (CampaignState.SUSPENDED, "no launch monitor is connected")
    assert (len(source.taken), source.rests, source.looks) == (2, 1, 1)


@pytest.mark.parametrize(("request_", "state"), [("stop", "STOPPED"), ("abort", "ABORTED")])
@pytest.mark.usefixtures("virtual_time")
def test_runner_stop_or_abort_while_suspended_is_obeyed(
    make: Callable[..., Bench], request_: str, state: str
) -> None:
    bench = make()

    class Away(Unseen):
        def hindrance(self, step: Step) -> BlockingCondition | None:
            if len(self.taken) == 2:
                bench.store.change(bench.entry.id, requested=request_)
            return super().hindrance(step)

    assert bench.run(Away()).state is CampaignState[state]
    assert len(bench.shots) == 2


class ShortOfAir(Scripted):
    """A bench whose supply is low when it comes to shot 3, for `long` looks; it disarms after `held`."""

    def __init__(self, long: int, held: int) -> None:
        super().__init__()
        self.left, self.held, self.armed, self.log = long, held, False, list[str]()

    def hindrance(self, step: Step) -> BlockingCondition | None:
        if len(self.taken) != 2 or not self.armed or self.left <= 0:
            return None
        self.left, self.held = self.left - 1, self.held - 1
        if self.held < 0:
            raise Suspended("supply 7.0 bar; now the bench is READY")
        return BlockingCondition("supply 7.0 bar", armed=True)

    def rest(self) -> None:
        self.log.append("rest")
        self.armed = False

    def take(self, step: Step, number: int, sample: int) -> Taken:
        self.armed = number == 3
        if number == 3 and self.left > 0:
            self.log.append("not now")
            raise ShotPostponed(("practice", "a swing without a ball"))
        return super().take(step, number, sample)


@pytest.mark.usefixtures("virtual_time")
def test_runner_low_supply_waits_with_robot_armed(make: Callable[..., Bench]) -> None:
    bench, source = make(), ShortOfAir(5, 60)
    assert bench.run(source).state is CampaignState.FINISHED
    assert source.log == ["not now"]  # never vented: a vented bench does not see its supply
    assert [shot.shot for shot in bench.shots] == list(range(1, len(bench.shots) + 1))
    events = [(event.kind, event.before_shot) for event in bench.store.events(bench.entry.id)]
    assert events == [("practice", 3), ("suspended", 3)]


@pytest.mark.usefixtures("virtual_time")
def test_runner_low_supply_until_disarmed_suspends(make: Callable[..., Bench]) -> None:
    bench, source = make(), ShortOfAir(100, 10)
    outcome = bench.run(source)
    assert (outcome.state, outcome.reason) == (
        CampaignState.SUSPENDED,
        "supply 7.0 bar; now the bench is READY",
    )
    assert source.log == ["not now"]
    source.left = 0
    assert bench.run(source).state is CampaignState.FINISHED


def drifting(number: int) -> dict[str, Any]:
    """Return a club that gets faster in the third block."""
    return {"club_speed_mps": 42.9 + (0.5 if 14 <= number <= 18 else 0.0)}


def test_runner_drift_relearns_between_blocks_and_after_resume(make: Callable[..., Bench]) -> None:
    learned: list[int] = []

    class Learner(Scripted):
        def relearn(self, drift: Drift, number: int) -> str:
            learned.append(number)
            return super().relearn(drift, number)

    bench, learner = make(learning={"refresh": True}, design={"blocks": 5}), Learner(drifting)
    assert bench.run(learner, interrupted=lambda: len(learner.taken) >= 20).state is CampaignState.STOPPED
    assert learned == [19]
    assert bench.run(Learner(drifting)).state is CampaignState.FINISHED
    assert learned == [19, 19]  # it is asked again, and answers with what it learned then
    (event,) = [event for event in bench.store.events(bench.entry.id) if event.kind == "learned"]
    assert (event.before_shot, event.text) == (19, "learned ('default', 'driver') before 19")
