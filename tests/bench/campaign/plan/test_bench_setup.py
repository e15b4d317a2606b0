"""Operator tasks between shots: prompted, stored, answered from any terminal, and never lost."""

from __future__ import annotations

import os
import pty
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bench.base.errors import Refused
from bench.campaign.plan.bench_setup import (
    Fitting,
    Preparation,
    coming_balls,
    fitting_after,
    load_lists,
    missing,
)
from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import Arm, PlannedShot, Role, Step, all_trials
from bench.campaign.report.preview import preview_record, show_preview
from bench.campaign.run.campaign_control import answer, runner_lock
from bench.campaign.run.plan_requirements import Profiles, require_swings
from bench.campaign.run.runner import Runner, RunOutcome
from bench.campaign.run.runner_control import course_of, new_entry
from bench.campaign.run.shot_source import Watcher
from bench.commands.campaign.campaign_terminal import CampaignBar, TerminalOperator
from bench.config import database_url
from bench.records.shot.shot import ShotStatus
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignState, Hit, Prompt, PromptKind, places
from tests.bench.campaign.plans import NOW, SHIPPED, row_of, shipped_plan, with_values
from tests.bench.campaign.run.test_runner import JAM, Scripted, acting, cut_power

PROFILES = dict[tuple[tuple[str, ...], tuple[str, ...]], Profiles]()
"""Assessed once for each swings and clubs of a plan."""


class Rig(Scripted):
    """Records each access of a person; `lacking` is the preparation required at restart."""

    def __init__(self, script: Callable[[int], dict[str, Any]] = lambda _: {}) -> None:
        super().__init__(script)
        self.doors: list[str] = []
        self.lacking: Preparation | None = None

    def required_restart(self, step: Step) -> Preparation | None:
        return self.lacking

    def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        self.doors.append(f"{kind} open")

    def resume_after_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
        self.doors.append(f"{kind} shut")
        if kind is PromptKind.BENCH:
            self.lacking = None


class Person:
    """Answers the first `times` prompts at once, later ones never."""

    def __init__(self, times: int = 1000, kinds: frozenset[PromptKind] = frozenset(PromptKind)) -> None:
        self.name, self.kinds, self.times = "Ann", kinds, times
        self.shown: list[Prompt] = []
        self.seen = threading.Event()

    def show(self, prompt: Prompt) -> None:
        self.shown.append(prompt)
        self.seen.set()

    def answered(self) -> bool:
        return len(self.shown) <= self.times

    def hide(self) -> None:
        pass

    def once_asked(self, series: Series, request: str) -> Callable[[], None]:
        """Return the task to send `request` once a prompt is shown."""

        def send() -> None:
            self.seen.wait(30.0)
            series.store.change(series.entry.id, requested=request)

        return send


class PowerCut(Person):
    """Ends the run while it waits."""

    def answered(self) -> bool:
        cut_power()


class Series:
    """A plan with a club change, in its own database."""

    def __init__(self, folder: Path, engine: Any, plan: CampaignPlan, *, real: bool = False) -> None:
        configuration = replace(SHIPPED, bench=replace(SHIPPED.bench, data_dir=folder))
        self.folder, self.plan, self.store = folder, plan, CampaignStore(engine)
        facts = {"driver": "canopen", "club": "driver"} if real else None
        self.entry = new_entry(plan, configuration, datetime.now(UTC), simulated=not real, real_time=facts)
        self.store.begin(self.entry)

    def run(
        self, source: Rig, person: Person | None = None, interrupted: Callable[[], bool] = never
    ) -> RunOutcome:
        design = self.plan.design
        if (used := (design.swings, design.clubs)) not in PROFILES:
            PROFILES[used] = require_swings(self.plan, SHIPPED)
        person = person or Person(kinds=frozenset({PromptKind.BENCH}))
        runner = Runner(self.entry, self.plan, self.store, self.folder, source, Watcher(), 4, person)
        return runner.run(course_of(self.plan, PROFILES[used], SHIPPED.plant.robot.lie), interrupted)

    @property
    def prompts(self) -> list[Prompt]:
        return self.store.prompts(self.entry.id)

    @property
    def state(self) -> CampaignState:
        return self.store.standing(self.entry.id).state


def clubs_plan(**handling: Any) -> CampaignPlan:
    design = {"blocks": 2, "clubs": ("driver", "driver-9")}
    return shipped_plan("clubs", design=design, warm_up={"at_most": 0}, ball_handling=handling)


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[..., Series]]:
    with open_database(database_url("", tmp_path), NOW) as engine:
        yield lambda plan=None, **how: Series(tmp_path, engine, plan or clubs_plan(), **how)


@contextmanager
def beside(work: Callable[[], object]) -> Iterator[None]:
    """Run `work` in a thread for the time of a block."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join(30.0)


def changes(plan: CampaignPlan) -> list[tuple[int, str]]:
    """Return before which shots which club is to be mounted."""
    mounted, found = "driver", []
    for number, trial in enumerate(all_trials(plan), 1):
        if trial.arm.club != mounted:
            found.append((number, trial.arm.club))
        mounted = trial.arm.club
    return found


def test_runner_simulation_answers_club_prompts(make: Callable[..., Series]) -> None:
    series, rig = make(), Rig()
    assert series.run(rig).state is CampaignState.FINISHED
    assert [(p.before_shot, p.content["club"]) for p in series.prompts] == changes(series.plan)
    assert {p.by for p in series.prompts} == {"simulation"}
    assert [p.number for p in series.prompts] == list(range(1, len(series.prompts) + 1))
    assert rig.doors == ["club open", "club shut"] * len(series.prompts)


def test_runner_operator_answer_is_stored(make: Callable[..., Series]) -> None:
    series, person = make(), Person()
    assert series.run(Rig(), person).state is CampaignState.FINISHED
    assert [(p.before_shot, p.content["club"]) for p in series.prompts] == changes(series.plan)
    assert all(p.by == "Ann" and p.answered and p.answered >= p.asked for p in series.prompts)
    assert person.shown[0].text.startswith("Mount club driver")


def test_answer_from_other_terminal_continues_campaign(make: Callable[..., Series]) -> None:
    series, person = make(), Person(times=0)
    expected = len(changes(series.plan))

    def answers() -> None:
        for number in range(1, expected + 1):
            while len(series.prompts) < number or series.state is not CampaignState.WAITING:
                time.sleep(0.01)
            text, _ = answer(series.store, series.folder, series.entry.id, "Bob", NOW)
            assert text == series.store.standing(series.entry.id).reason

    with beside(answers):
        outcome = series.run(Rig(), person)
    assert outcome.state is CampaignState.FINISHED
    assert {p.by for p in series.prompts} == {"Bob"}
    with pytest.raises(Refused, match="no open prompt"):
        answer(series.store, series.folder, series.entry.id, "Bob", NOW)


@pytest.mark.parametrize("request_", ["stop", "abort"])
def test_runner_stop_or_abort_while_waiting_keeps_prompt(make: Callable[..., Series], request_: str) -> None:
    series, person = make(), Person(times=0)
    with beside(person.once_asked(series, request_)):
        outcome = series.run(Rig(), person)
    ended = {"stop": CampaignState.STOPPED, "abort": CampaignState.ABORTED}[request_]
    assert outcome.state is ended
    assert series.prompts[-1].answered is None
    if ended is CampaignState.STOPPED:
        before = len(series.prompts)
        again = Person(times=1)
        series.run(Rig(), again, lambda: len(again.shown) > 1)
        assert again.shown[0].number == before, "the same prompt, not another one"
        assert series.prompts[before - 1].by == "Ann"


def test_runner_crash_keeps_open_prompt(make: Callable[..., Series]) -> None:
    series = make()
    with pytest.raises(RuntimeError):
        series.run(Rig(), PowerCut())
    assert series.state is CampaignState.WAITING
    (prompt,) = series.prompts
    text, goes_on = answer(series.store, series.folder, series.entry.id, "Bob", NOW)
    assert (text, goes_on) == (prompt.text, False)
    rig, person = Rig(), Person()
    assert series.run(rig, person).state is CampaignState.FINISHED
    assert rig.doors[0] == "club shut", "the guard is locked again"
    assert [(p.before_shot, p.content["club"]) for p in series.prompts] == changes(series.plan)
    assert [p.by for p in series.prompts] == ["Bob"] + ["Ann"] * (len(series.prompts) - 1)


def test_runner_real_bench_knows_club_of_previous_campaign(make: Callable[..., Series]) -> None:
    def plan_with(name: str, *clubs: str) -> CampaignPlan:
        design = {"clubs": clubs, "compare": "ball", "balls": ("tour", "range"), "blocks": 1}
        plan = with_values(clubs_plan(), campaign={"name": name}, design=design)
        return replace(plan, balls={name: SHIPPED.balls[name] for name in ("tour", "range")})

    first = make(plan_with("one", "driver-9"), real=True)
    assert first.run(Rig(), Person()).state is CampaignState.FINISHED
    second = make(plan_with("two", "driver"), real=True)
    second.run(Rig(), Person())
    assert [p.text for p in second.prompts] == ["Mount club driver in place of driver-9."]
    third = make(plan_with("three", "driver"), real=True)
    third.run(Rig(), Person())
    assert third.prompts == []


def test_runner_bench_restart_prompts_operator(make: Callable[..., Series]) -> None:
    series, rig, person = make(), Rig(), Person(kinds=frozenset({PromptKind.BENCH}))
    rig.lacking = Preparation(PromptKind.BENCH, "Restart the bench.", {"profile": "slow"})
    assert series.run(rig, person).state is CampaignState.FINISHED
    assert [p.kind for p in person.shown] == [PromptKind.BENCH]
    assert rig.doors[:2] == ["bench open", "bench shut"]


def test_runner_prompt_met_before_resume_is_closed(make: Callable[..., Series]) -> None:
    def seen(_: int) -> dict[str, Any]:
        states.append(series.state)
        return {}

    states: list[CampaignState] = []
    series, person = make(), Person(times=0, kinds=frozenset({PromptKind.BENCH}))
    rig = Rig(seen)
    rig.lacking = Preparation(PromptKind.BENCH, "Restart the bench.", {"profile": "slow"})
    with beside(person.once_asked(series, "stop")):
        assert series.run(rig, person).state is CampaignState.STOPPED
    rig.lacking = None  # restarted meanwhile
    assert series.run(rig).state is CampaignState.FINISHED
    assert set(states) == {CampaignState.RUNNING}
    assert rig.doors[:2] == ["bench open", "bench shut"]
    assert series.prompts[0].by == "no one: no longer needed"


def test_runner_stopped_at_prompt_after_automatic_one_resumes(make: Callable[..., Series]) -> None:
    series = make(with_values(clubs_plan(), design={"clubs": ("driver-9",)}))
    rig, person = Rig(), Person(times=0, kinds=frozenset({PromptKind.BENCH}))
    rig.lacking = Preparation(PromptKind.BENCH, "Restart the bench.", {"profile": "slow"})
    with beside(person.once_asked(series, "stop")):
        assert series.run(rig, person).state is CampaignState.STOPPED
    assert series.run(rig, Person(kinds=person.kinds)).state is CampaignState.FINISHED
    assert [(p.number, p.kind, p.by) for p in series.prompts] == [
        (1, "club", "simulation"),
        (2, "bench", "Ann"),
    ]


def ten_shots(magazine: int) -> CampaignPlan:
    """Return the plan of two balls with five blocks, balls filled in by hand."""
    return shipped_plan("two-balls", design={"blocks": 5}, ball_handling={"magazine": magazine})


def test_runner_feeder_loads_in_order_and_refills_after_jam(make: Callable[..., Series]) -> None:
    series, rig = make(ten_shots(magazine=4)), Rig(lambda n: JAM if n == 6 else {})
    assert series.run(rig, Person()).state is CampaignState.FINISHED
    taken = [(step.trial.arm.ball, sample) for _, step, sample in rig.taken]
    fills = {p.before_shot: [tuple(ball) for ball in p.content["balls"]] for p in series.prompts}
    assert sorted(fills) == [1, 5, 7, 11]
    assert fills[1] == taken[:4]
    assert fills[5][:2] == taken[4:6]
    assert fills[7] == taken[6:10], "after a jam the contents are unknown"
    assert "23 ± 1 °C for 3 h" in series.prompts[0].text


def test_runner_excluded_shot_prompts_feeder_reload(make: Callable[..., Series]) -> None:
    series = make(ten_shots(magazine=10))
    series.run(Rig(lambda n: {"club_speed_mps": 50.0} if n == 3 else {}), Person())
    assert [p.before_shot for p in series.prompts] == [1, 4]
    assert series.prompts[1].text.startswith("Empty the feeder, then fill it")


def test_runner_work_before_access_is_shown_as_reason_of_waiting(make: Callable[..., Series]) -> None:
    shown: list[tuple[CampaignState, str]] = []

    class Gauged(Rig):
        """Has no chamber sensors."""

        def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
            ask("Read the gauges.")
            standing = series.store.standing(series.entry.id)
            shown.append((standing.state, standing.reason))

    series = make(ten_shots(magazine=10))
    assert series.run(Gauged(), Person()).state is CampaignState.FINISHED
    assert shown == [(CampaignState.WAITING, "Read the gauges.")]


@pytest.mark.parametrize("earlier_run", [False, True])
def test_answer_before_access_is_refused(make: Callable[..., Series], earlier_run: bool) -> None:
    class Gauged(Rig):
        """Has no chamber sensors."""

        def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
            for asks in (False, True):
                if asks:
                    ask("Read the gauges.")
                with runner_lock(series.folder, series.entry.id), pytest.raises(Refused, match="prompt"):
                    answer(series.store, series.folder, series.entry.id, "Bob", NOW)
            super().grant_access(kind, ask)

    series, rig = make(ten_shots(magazine=10)), Gauged()
    if earlier_run:
        with pytest.raises(RuntimeError):
            series.run(Rig(), PowerCut())
    assert series.run(rig, Person()).state is CampaignState.FINISHED
    assert [prompt.by for prompt in series.prompts] == ["Ann"]
    assert rig.doors == ["balls open", "balls shut"]


@pytest.mark.parametrize("person", ["pauses", "shut the supply"])
def test_runner_pauses_between_access_and_arming(make: Callable[..., Series], person: str) -> None:
    class Gauged(Rig):
        """Was opened with its supply shut, or paused by a person."""

        def resume_after_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
            super().resume_after_access(kind, ask)
            if person == "pauses":
                series.store.change(series.entry.id, requested="pause")
            else:
                work.append("Open the supply.")

        def work_before_arming(self) -> str:
            return work.pop() if work else ""

    def confirms() -> None:
        end = time.monotonic() + 20.0
        while series.state is not CampaignState.PAUSED and time.monotonic() < end:
            time.sleep(0.01)
        reasons.append(series.store.standing(series.entry.id).reason)
        taken.append(len(rig.taken))
        series.store.change(series.entry.id, requested="")

    series, rig, taken = make(ten_shots(magazine=10)), Gauged(), list[int]()
    work, reasons = list[str](), list[str]()
    with beside(confirms):
        assert series.run(rig, Person()).state is CampaignState.FINISHED
    assert (taken, reasons) == ([0], ["paused by request" if person == "pauses" else "Open the supply."])


@pytest.mark.parametrize("answered", [False, True])
def test_runner_stop_while_person_is_at_robot_is_obeyed(make: Callable[..., Series], answered: bool) -> None:
    class Gauged(Rig):
        """Waits for a person."""

        def wait(self, ask: Callable[[str], None]) -> None:
            ask("")
            ask("Read the gauges.")
            series.store.change(series.entry.id, requested="stop", requested_by="Bob")
            for _ in range(3):
                ask("Read the gauges.")
            raise AssertionError("still waiting")

        def grant_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
            if not answered:
                self.wait(ask)

        def resume_after_access(self, kind: PromptKind, ask: Callable[[str], None]) -> None:
            self.wait(ask)

    series = make(ten_shots(magazine=10))
    outcome = series.run(Gauged(), Person())
    assert outcome.state is CampaignState.STOPPED
    assert outcome.reason == "stopped by request of Bob while it waited (Read the gauges)"


def test_runner_real_time_crash_prompts_feeder_reload(make: Callable[..., Series]) -> None:
    plan = ten_shots(magazine=10)
    for real, asked in ((True, [1, 3]), (False, [1])):
        series = make(with_values(plan, campaign={"name": f"real-{int(real)}"}), real=real)
        with pytest.raises(RuntimeError):
            series.run(Rig(acting({3: cut_power})), Person())
        series.run(Rig(), Person())
        assert [p.before_shot for p in series.prompts] == asked
        assert series.prompts[-1].text.endswith("Check that club driver is mounted.")


def test_coming_balls_lists_each_ball_once_across_club_changes() -> None:
    plan = clubs_plan(magazine=50, samples=3)
    first = all_trials(plan)[0]
    balls = coming_balls(plan, first, {})
    assert len(balls) == len(set(balls)) <= 3
    trials = all_trials(clubs_plan(magazine=4))
    assert len({trial.arm.club for trial in trials[:4]}) > 1
    assert coming_balls(clubs_plan(magazine=4), first, {}) == [("tour", n) for n in range(1, 5)]
    warm = PlannedShot(Role.WARM_UP, 1, 0, 2, Arm("default", "driver", "tour"))
    assert coming_balls(plan, warm, {}) == [("tour", 1), ("tour", 2)]
    longer = with_values(plan, warm_up={"at_most": 8})
    assert len(coming_balls(longer, warm._replace(position=4), {})) == 3, "one load for all that may come"
    used = Counter({Hit("ball", "tour", 1): 20})
    assert coming_balls(clubs_plan(magazine=1, hits=20), first, used) == [("tour", 2)]


def test_load_lists_match_prompts_of_run(make: Callable[..., Series]) -> None:
    plan = ten_shots(magazine=4)
    series = make(plan)
    series.run(Rig(), Person())
    asked = [prompt.balls for prompt in series.prompts]
    loads = load_lists(plan, {})
    assert [load.balls for load in loads] == asked
    assert [load.before.role for load in loads][:2] == [Role.WARM_UP, Role.TEST] or not plan.warm_up.at_most
    assert sum(len(load.balls) for load in loads) == len(series.store.shots(series.entry.id))
    used = Counter({Hit("ball", "tour", n): 1 for n in range(1, 5)})
    assert ("tour", 5) in load_lists(plan, used)[0].balls
    assert load_lists(ten_shots(magazine=0), {}) == []


def test_show_preview_prints_load_lists() -> None:
    plan, text = ten_shots(magazine=4), StringIO()
    loads = load_lists(plan, {})
    show_preview(plan, {}, Console(file=text, width=100))
    assert "Load lists: a magazine of 4" in text.getvalue()
    assert "  ".join(places(loads[0].balls)) in text.getvalue()
    assert [load["balls"] for load in preview_record(plan, {})["loads"]] == [load.balls for load in loads]
    show_preview(ten_shots(magazine=0), {}, Console(file=text, width=100))
    assert text.getvalue().count("Load lists") == 1


@pytest.mark.parametrize(
    ("count", "words"),
    [(3, r"3 balls loaded, expected 4, as listed. Load the rest from 4\. "), (5, "Empty the")],
)
def test_answer_wrong_ball_count_is_refused(make: Callable[..., Series], count: int, words: str) -> None:
    series = make(ten_shots(magazine=4))
    series.run(Rig(), person := Person(times=0), lambda: bool(person.shown))
    (prompt,) = series.prompts
    assert prompt.text.startswith("Fill the feeder with 4 balls in this order: 1. ")
    with pytest.raises(Refused, match=words):
        answer(series.store, series.folder, series.entry.id, "Bob", NOW, count)
    assert series.prompts[0].answered is None
    answer(series.store, series.folder, series.entry.id, "Bob", NOW, 4)
    assert series.prompts[0].by == "Bob"
    with pytest.raises(Refused, match="no open prompt"):
        answer(series.store, series.folder, series.entry.id, "Bob", NOW, 4)


def test_require_count_club_prompt_is_refused() -> None:
    with pytest.raises(Refused, match="Answer without a number"):
        Prompt(1, 2, "club", "Mount club iron.", {"club": "iron"}, NOW).require_count(1)


def test_fitting_after_follows_prompts_and_shots() -> None:
    def prompt(number: int, before: int, content: dict[str, Any], *, done: bool = True) -> Prompt:
        return Prompt(number, before, "x", "x", content, NOW, NOW if done else None)

    trial = PlannedShot(Role.TEST, 1, 1, 1, Arm("default", "driver", "tour"))
    shots = [row_of(trial, n) for n in (1, 2)]
    balls = prompt(2, 2, {"balls": [["tour", 2], ["range", 1], ["tour", 3]]})
    prompts = [prompt(1, 2, {"club": "iron"}), balls, prompt(3, 3, {"club": "wood"}, done=False)]
    assert fitting_after("driver", shots, prompts) == Fitting("iron", (("range", 1), ("tour", 3)), 1)
    failed = replace(shots[1], status=ShotStatus.FAILED, reason="jam")
    assert fitting_after("driver", [shots[0], failed], prompts).feeder == ()
    assert missing(clubs_plan(), Fitting("driver"), Step(trial, 1, Centre()), 1, {}) is None


@contextmanager
def terminal_operator(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[TerminalOperator, int, StringIO]]:
    """Yield an operator at a terminal, the terminal's other end, and the printed text."""
    master, slave = pty.openpty()
    out = StringIO()
    with os.fdopen(slave, "r") as terminal, CampaignBar(console=Console(file=out), disable=True) as bar:
        monkeypatch.setattr("sys.stdin", terminal)
        yield TerminalOperator(bar, "clubs-1", frozenset(PromptKind)), master, out


def test_terminal_operator_accepts_enter_only_after_prompt(monkeypatch: pytest.MonkeyPatch) -> None:
    with terminal_operator(monkeypatch) as (person, master, out):
        os.write(master, b"\n")
        person.show(Prompt(1, 7, PromptKind.CLUB, "Mount club driver-9 [sic].", {}, NOW))
        assert not person.answered()
        os.write(master, b"\n")
        deadline = time.monotonic() + 5.0
        while not person.answered():
            assert time.monotonic() < deadline
        person.hide()
        os.close(master)
        assert not person.answered()
    text = out.getvalue()
    assert "before shot 7" in text
    assert "Mount club driver-9 [sic]." in text
    assert "golfbench campaign answer clubs-1" in text


def test_terminal_operator_load_list_requires_correct_count(monkeypatch: pytest.MonkeyPatch) -> None:
    balls = [["tour", 1], ["range", 1], ["tour", 2], ["range", 2], ["tour", 3]]
    with terminal_operator(monkeypatch) as (person, master, out):
        person.show(Prompt(1, 7, PromptKind.BALLS, "Fill it.", {"balls": balls}, NOW))

        def answers(line: str, expected: bool) -> None:
            os.write(master, f"{line}\n".encode())
            deadline, before = time.monotonic() + 5.0, out.getvalue()
            while (found := person.answered()) is False and out.getvalue() == before:
                assert time.monotonic() < deadline
            assert found is expected

        answers("4", False)
        assert "4 balls loaded, expected 5, as listed. Load the rest from 5. tour 3 on" in _line(out)
        answers("6", False)
        assert "Empty the feeder and load it by the list" in _line(out)
        answers("maybe", False)
        assert "'maybe' is no answer" in _line(out)
        answers("0_5", False)
        assert "'0_5' is no answer" in _line(out)
        answers("5", True)
        os.close(master)
    assert "1. tour 1   2. range 1   3. tour 2   4. range 2" in out.getvalue()
    assert "5. tour 3" in out.getvalue()


def _line(out: StringIO) -> str:
    return " ".join(out.getvalue().split())


def test_runner_with_operator_gives_same_shots(make: Callable[..., Series]) -> None:
    plan = clubs_plan()
    by_itself, by_person = make(), make(with_values(plan, campaign={"name": "b"}))
    by_itself.run(Rig())
    by_person.run(Rig(), Person())
    shots = [[stored.shot for stored in s.store.shots(s.entry.id)] for s in (by_itself, by_person)]
    assert shots[0] == shots[1]
