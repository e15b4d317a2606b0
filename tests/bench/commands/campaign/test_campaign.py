"""golfbench campaign: a simulated campaign from its plan to its report, and refusals."""

from __future__ import annotations

import json
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from markupsafe import escape

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError, ExitCode, Refused
from bench.campaign.plan.plan_file import campaign_names, load_plan
from bench.campaign.plan.shot_sequence import all_trials
from bench.campaign.report.campaign_record import load_record
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.report.report_format import UnitSystem
from bench.campaign.run._simulated_shots import BEGIN
from bench.campaign.run.campaign_control import bench_lock, find_campaign, runner_lock
from bench.campaign.run.runner import RunOutcome
from bench.campaign.run.runner_control import new_entry, run_campaign
from bench.campaign.run.shot_source import Watcher
from bench.commands.campaign import campaign_run
from bench.config import database_url, load_configuration
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignState
from tests.bench.records.shot.read_shots import read_shot_table
from tests.conftest import Outcome, Run
from tests.sampling import release_except


def said(outcome: Outcome) -> tuple[int, str]:
    return outcome.code, outcome.words


PLAN = """
[campaign]
name = "short"
title = "Short"
[design]
balls = ["tour", "range"]
blocks = 2
[control]
ball = "tour"
[warm_up]
window = 2
at_most = 4
[simulation]
missing_launch = [5]
feeder_jam = [7]
guard_opened = [9]
"""


SHORT = """
[campaign]
name = "short"
[design]
balls = ["tour", "range"]
blocks = 1
[warm_up]
at_most = 0
[gate]
reference = "planned"
"""


@pytest.fixture
def user(tmp_path: Path, run: Run) -> Run:
    """Return a function that runs `golfbench campaign ...` of a bench with an empty folder."""
    (tmp_path / "bench.toml").write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path / "data"}"\n')
    (tmp_path / "short.toml").write_text(SHORT)
    return partial(run, "--config", tmp_path / "bench.toml", "campaign")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_here")
def test_campaign_commands_simulated_run_to_issued_and_verified_report(
    user: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "short.toml").write_text(PLAN)
    baseline = tmp_path / "baseline.toml"
    baseline.write_text('[[figure]]\npath = "sections.0.levels.tour.spread.mean"\nlow = 150\nhigh = 250\n')
    outputs = ("--report", tmp_path / "r.html", "--junit", tmp_path / "j.xml", "--check", baseline, "--json")
    done = user("run", tmp_path / "short.toml", "--sim", *outputs)
    assert done.code == ExitCode.OK, done.err
    told = json.loads(done.out)
    assert told["state"] == "finished"
    assert told["baseline"][0]["holds"]
    assert told["findings"]["by_status"] == {"valid": 12, "excluded": 1, "failed": 1}
    assert "Short" in (tmp_path / "r.html").read_text()
    assert (tmp_path / "j.xml").read_text().count("<testcase") == 10 + 2

    listed = json.loads(user("list", "--json").out)
    assert [entry["state"] for entry in listed] == ["finished"]
    campaign = listed[0]["id"]
    user("export", campaign, "--output", tmp_path / "shots.csv")
    shots = read_shot_table(tmp_path / "shots.csv")
    assert [shot.reason for shot in shots if shot.reason] == [
        "the launch monitor saw no ball",
        "feeder jam: no ball came",
    ]
    assert shots[4].club_speed_mps is not None
    assert shots[4].carry_m is None
    assert len(list((tmp_path / "data" / "campaigns" / campaign / "swings").glob("*.parquet"))) == 13
    assert user("mark", campaign, "a gust", "--shot", "3").out == "shot 3 marked: a gust\n"
    assert "up to 200" in user("mark", campaign, 201 * "x", "--shot", "3").err
    assert "no shot 99" in user("mark", campaign, "--shot", "99").err
    reason = ("--reason", "leaf on the tee", "--by", "Ann")
    assert user("exclude", campaign, "3", *reason).out == "shot 3 excluded: leaf on the tee\n"
    assert "excluded by hand: leaf on the tee" in user("export", campaign).out
    assert user("exclude", campaign, "4").code == 2, "no reason"
    report = Path(user("report", campaign).out.strip())
    page = report.read_text()
    assert "guard opened" in page
    assert "2 excluded (1 by hand)" in page
    assert "note: a gust (" in page
    assert f"{campaign}-draft" in page
    verified = user("verify", campaign)
    assert (verified.code, "\nverified: " in verified.out) == (ExitCode.OK, True), verified
    monkeypatch.setattr("bench.commissioning.swings.wear.MAX_FITTED", 2)
    assert user("report", campaign, "--wear").code == ExitCode.OK
    assert "wear of the robot's parts" in report.read_text()
    assert user("verify", campaign).code == ExitCode.OK
    assert user("report", campaign, "--issue", "--output", "/no/r.html").code == ExitCode.FILE
    assert user("report", campaign, "--output", ".").code == ExitCode.FILE
    assert user("report", campaign, "--issue", "--json").code == ExitCode.BAD_INPUT
    assert user("report", campaign).code == ExitCode.OK
    assert f"{campaign}-draft" in report.read_text(), "not issued"
    assert user("report", campaign, "--issue", "--by", "Ann", "--units", "us").code == ExitCode.OK
    page = report.read_text()
    assert f"{campaign}-R1" in page
    assert "issued by Ann" in page
    assert user("verify", campaign).code == ExitCode.OK
    assert user("report", campaign, "--issue").code == ExitCode.REFUSED
    assert "needs an amendment" in user("exclude", campaign, "3", "--undo", *reason).out
    told = user("exclude", campaign, "3", *reason).out
    assert f"needs an amendment: golfbench campaign report {campaign} --issue --reason TEXT\n" in told
    amended = user("report", campaign, "--issue", "--reason", "leaf").out
    first, second = (report.with_name(f"report-R{n}.html") for n in (1, 2))
    assert f"issued as {campaign}-R2: {second}" in amended
    assert f"{campaign}-R1" in first.read_text()
    assert "replaces" not in first.read_text()
    assert f"replaces {campaign}-R1: leaf" in second.read_text()
    assert user("verify", campaign, "--report", tmp_path / "none.html").code == ExitCode.BAD_INPUT
    with sqlite3.connect(tmp_path / "data" / "golfbench.sqlite") as database:
        database.execute("UPDATE shots SET ball_speed_mps = ball_speed_mps + 1 WHERE shot = 3")
    changed = user("verify", campaign)
    assert changed.code == ExitCode.REFUSED
    assert "shot 3: not as reported" in changed.out
    assert "NOT VERIFIED" in changed.out
    with sqlite3.connect(tmp_path / "data" / "golfbench.sqlite") as database:
        database.execute("UPDATE shots SET ball_speed_mps = ball_speed_mps - 1 WHERE shot = 3")
    assert user("resume", campaign).code == ExitCode.REFUSED

    baseline.write_text('[[figure]]\npath = "sections.0.levels.tour.spread.mean"\nlow = 250\n')
    checked = json.loads(user("check", tmp_path / "short.toml", "--json").out)
    given = ("--by", "Ann", "--expect", checked["digest"])
    again = user("run", tmp_path / "short.toml", "--sim", "--check", baseline, *given)
    assert (again.code, "OUTSIDE" in again.out) == (ExitCode.REFUSED, True)
    second = json.loads(user("list", "--json").out)[0]["id"]
    assert second != campaign
    with sqlite3.connect(tmp_path / "data" / "golfbench.sqlite") as database:
        by = dict(database.execute("SELECT campaign, by FROM campaign_runs"))
    assert (by[second], "@" in by[campaign]) == ("Ann", True)
    assert user("export", second).out == (tmp_path / "shots.csv").read_bytes().decode()

    with sqlite3.connect(tmp_path / "data" / "golfbench.sqlite") as database:  # as a killed runner leaves it
        database.execute("UPDATE campaigns SET state = 'running' WHERE id = ?", (second,))
    page = Path(user("report", second).out.strip()).read_text()
    assert "This campaign is not finished: interrupted" in page


def test_campaign_run_cut_off_before_first_shot_is_listed_as_interrupted(
    user: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_off(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(campaign_run, "_run", cut_off)
    user("run", tmp_path / "short.toml", "--sim")
    (listed,) = json.loads(user("list", "--json").out)
    assert listed["state"] == "interrupted"
    assert "campaign resume" in listed["reason"]


def test_campaign_run_wrong_baseline_or_digest_starts_no_campaign(user: Run, tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_text("x = 1")
    for option, value, words in (
        ("--check", tmp_path / "wrong.toml", "[[figure]] entries"),
        ("--expect", "0" * 16, "as checked"),
        ("--report", tmp_path / "no" / "x", "a file in a folder that exists"),
        ("--junit", tmp_path / "no" / "x", "a file in a folder that exists"),
    ):
        assert words in user("run", tmp_path / "short.toml", "--sim", option, value).words
    assert user("list").out == "No campaigns yet.\n"


@pytest.mark.parametrize("state", [CampaignState.STOPPED, CampaignState.FINISHED])
def test_campaign_run_ended_early_prints_resume_command(
    state: CampaignState, capsys: pytest.CaptureFixture[str]
) -> None:
    found: Any = SimpleNamespace(sections=[], rules=[])
    outcome = RunOutcome(state, f"{state} by Ctrl-C", 3, 2)
    campaign_run._tell("c7", outcome, found, [], UnitSystem.SI)
    resume = "Next: golfbench campaign resume c7\n" * (state is CampaignState.STOPPED)
    assert capsys.readouterr().out == f"{state} by Ctrl-C; 3 shots, 2 valid\n{resume}"


def test_campaign_command_unknown_id_is_refused(user: Run) -> None:
    for verb in ("pause", "resume", "export", "report"):
        assert "no such campaign" in user(verb, "xyz").err


@pytest.mark.release
def test_campaign_read_commands_without_database_create_none(user: Run, tmp_path: Path) -> None:
    assert json.loads(user("list", "--json").out) == []
    assert "no database in" in user("export", "short").err
    assert not (tmp_path / "data").exists()


@pytest.mark.slow
def test_ci_baseline_detects_lower_club_restitution(user: Run, tmp_path: Path) -> None:
    gate = Path(__file__).parents[4] / ".github"
    assert "--check .github/two-balls.baseline.toml" in (gate / "workflows" / "check.yml").read_text()
    for restitution, expected in ((0.882, ExitCode.OK), (0.872, ExitCode.REFUSED)):
        (tmp_path / "bench.toml").write_text(
            f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path / "data"}"\n'
            f"[clubs.driver]\nrestitution = {restitution}\n"
        )
        done = user("run", "two-balls", "--sim", "--check", gate / "two-balls.baseline.toml")
        assert done.code == expected, done
        assert ("OUTSIDE" in done.out) == (expected is ExitCode.REFUSED)


@pytest.mark.parametrize(
    ("change", "location", "words"),
    [
        (('"range"]', '"rnage"]'), "short.toml: design.balls", "Did you mean range?"),
        (("blocks = 1", 'blocks = 1\nclubs = ["thesis"]'), "default.toml: club", "[swings.default] thesis ="),
        (("[gate]", '[swings.fast]\ndriver = "default"\n[gate]'), "swings.fast", "Add it to design.swings"),
        (("[gate]", "[ball_handling]\nmagazine = -1\n[gate]"), "ball_handling.magazine", "0 to 1000"),
        (("[gate]", "[gate"), "short.toml", "TOML"),
    ],
)
def test_campaign_run_invalid_plan_is_refused_without_data(
    user: Run, tmp_path: Path, change: tuple[str, str], location: str, words: str
) -> None:
    (tmp_path / "short.toml").write_text(SHORT.replace(*change))
    for command in (("check", tmp_path / "short.toml"), ("run", tmp_path / "short.toml", "--sim")):
        code, text = said(user(*command))
        assert code == ExitCode.BAD_INPUT
        assert location in text
        assert words in text
    assert not (tmp_path / "data").exists()


def test_campaign_commands_newer_database_is_refused_unchanged(user: Run, tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    with open_database(database_url("", tmp_path / "data")) as engine, engine.begin() as connection:
        connection.exec_driver_sql("UPDATE schema_version SET version = 99")
    before = (tmp_path / "data" / "golfbench.sqlite").read_bytes()
    for command in (("run", tmp_path / "short.toml", "--sim"), ("list",), ("answer", "short")):
        code, text = said(user(*command))
        assert code == ExitCode.BAD_INPUT
        assert "schema version 99" in text
    assert (tmp_path / "data" / "golfbench.sqlite").read_bytes() == before
    assert not (tmp_path / "data" / "campaigns").exists()


def test_campaign_resume_changed_plan_or_configuration_is_refused(
    user: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *_: object) -> None:
        raise NotStored(str(path), "No space left on device", "space for a swing", "Free some.")

    with monkeypatch.context() as patched:
        patched.setattr("bench.campaign.run.runner.write_swing", full)
        code, text = said(user("run", tmp_path / "short.toml", "--sim"))
        assert (code, "No space left on device" in text) == (ExitCode.FILE, True)
        assert "nothing was stored" not in text
        assert "0 shots are stored" in text
    (tmp_path / "short.toml").write_text(SHORT.replace("blocks = 1", "blocks = 2"))
    code, text = said(user("resume", "short", tmp_path / "short.toml"))
    assert code == ExitCode.REFUSED
    assert "a different plan" in text
    (tmp_path / "bench.toml").write_text(
        (tmp_path / "bench.toml").read_text() + "[air]\ntemperature = 300.0\n"
    )
    code, text = said(user("resume", "short"))
    assert code == ExitCode.REFUSED
    assert "air.temperature" in text
    assert "short" in user("list").out


@pytest.mark.slow
def test_campaign_run_closed_pipe_stops_and_can_be_resumed(user: Run, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "bench", "--config", str(tmp_path / "bench.toml"), "campaign", "run"]
    with subprocess.Popen(
        [*command, "two-balls", "--sim"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        assert any(line.startswith(b"campaign ") for line in process.stdout)  # after those of compilation
        process.stdout.close()
        assert process.wait(300.0) == ExitCode.TERMINATED
    (listed,) = json.loads(user("list", "--json").out)
    assert listed["state"] == "stopped"
    assert listed["reason"].startswith("stopped by a closed pipe")


@pytest.mark.slow
def test_campaign_run_file_size_limit_stops_and_resume_finishes(user: Run, run: Run, tmp_path: Path) -> None:
    """The limit on a file's size makes the operating system itself refuse the write."""
    # Compiled code is in its cache before the limit holds: it is not the file that the test is about.
    (tmp_path / "warm.toml").write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path / "warm"}"\n')
    run("--config", tmp_path / "warm.toml", "campaign", "run", tmp_path / "short.toml", "--sim")
    limited = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))\n"
        "from bench.commands.cli import main\n"
        "main(sys.argv[1:])\n"
    )
    arguments = ["--config", str(tmp_path / "bench.toml"), "campaign", "run", str(tmp_path / "short.toml")]
    done = subprocess.run(
        [sys.executable, "-c", limited, *arguments, "--sim"],
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert done.returncode == ExitCode.FILE, done.stderr
    assert "File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "data").rglob("*.parquet"))
    code, text = said(user("resume", "short"))
    assert (code, "finished; 2 shots" in text) == (ExitCode.OK, True)


def test_runner_lock_second_runner_is_refused(user: Run, tmp_path: Path) -> None:
    configuration = load_configuration(tmp_path / "bench.toml")
    plan = load_plan(tmp_path / "short.toml", configuration)
    entry = new_entry(plan, configuration, datetime.now(UTC), simulated=True)
    with open_database(database_url("", tmp_path / "data")) as engine:
        CampaignStore(engine).begin(entry)
    with runner_lock(tmp_path / "data", entry.id):
        assert "continues" in user("resume", "short").out, "the runner continues, there is no second one"
    with (
        bench_lock(tmp_path / "data", entry.bench, entry.id),
        pytest.raises(Refused, match=f"runs campaign {entry.id}"),
        bench_lock(tmp_path / "data", entry.bench),
    ):
        pass
    with bench_lock(tmp_path / "data", entry.bench):
        pass


@pytest.mark.parametrize("name", release_except({"two-balls"}, campaign_names()))
def test_shipped_plans_simulated_run_finishes_and_renders_report(name: str, tmp_path: Path) -> None:
    """With two blocks."""
    shipped = load_configuration(Path("bag" if name in {"bag", "wedge"} else "shipped"))
    configuration = replace(shipped, bench=replace(shipped.bench, data_dir=tmp_path))
    plan = load_plan(Path(name), configuration)
    plan = replace(plan, design=replace(plan.design, blocks=2), stop=replace(plan.stop, rule="fixed"))
    entry = new_entry(plan, configuration, BEGIN, simulated=True)
    with open_database(database_url("", tmp_path)) as engine:
        store = CampaignStore(engine)
        store.begin(entry)
        outcome = run_campaign(entry, configuration, store, Watcher(), never)
        record = load_record(store, entry)
    assert outcome.state is CampaignState.FINISHED, outcome.reason
    found = findings(plan, record.shots)
    assert found.by_status["valid"] >= len(all_trials(plan))
    assert all(section.verdicts for section in found.sections)
    assert escape(entry.title) in render_campaign_report(record, found)


def test_campaign_air_reading_is_stored_and_shown(user: Run) -> None:
    assert "No reading of the air yet" in user("air").out
    told = user("air", "--temperature", "-40", "--pressure", "1008.2", "--humidity", "40", "--by", "Ann")
    assert told.code == ExitCode.OK, told.err
    shown = user("air").out
    assert shown == told.out
    assert shown.startswith("-40.0 deg C, 1008.2 hPa, 40 %; read 20")
    assert shown.endswith("by Ann\n")


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("--temperature", "21"), "--pressure, --humidity"),
        (("--temperature", "210", "--pressure", "1000", "--humidity", "40"), "temperature"),
        (("--temperature", "21", "--pressure", "nan", "--humidity", "40"), "pressure"),
        (("--temperature", "21", "--pressure", "29.9", "--humidity", "40"), "200 to 1200 hPa"),
        (("--temperature", "21", "--pressure", "1000", "--humidity", "0.4"), "1 to 100 %"),
    ],
)
def test_campaign_air_invalid_reading_is_refused(user: Run, arguments: tuple[str, ...], what: str) -> None:
    refused = user("air", *arguments)
    assert (refused.code, what in refused.words) == (ExitCode.BAD_INPUT, True)
    assert "No reading of the air yet" in user("air").out


Begin = Callable[[int], list[str]]


@pytest.fixture
def begin(user: Run, tmp_path: Path) -> Begin:
    """Start campaigns of one plan without a runner; return their ids, the newest first."""

    def begin(number: int) -> list[str]:
        configuration = load_configuration(tmp_path / "bench.toml")
        plan = load_plan(tmp_path / "short.toml", configuration)
        dates = [datetime(2026, 1, 1, 0, 0, second, tzinfo=UTC) for second in range(number)]
        entries = [new_entry(plan, configuration, date, simulated=True) for date in dates]
        with open_database(database_url("", tmp_path / "data")) as engine:
            store = CampaignStore(engine)
            for entry in entries:
                store.begin(entry)
                store.change(
                    entry.id, state=CampaignState.SUSPENDED, reason="no ball came, five times running"
                )
        return [entry.id for entry in reversed(entries)]

    return begin


@pytest.fixture
def two(begin: Begin) -> list[str]:
    return begin(2)


def state_of(user: Run, campaign: str) -> str:
    return {entry["id"]: str(entry["state"]) for entry in json.loads(user("list", "--json").out)}[campaign]


@pytest.mark.parametrize("columns", ["20", "80"])
def test_campaign_list_any_width_shows_complete_ids(
    user: Run, two: list[str], columns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    code, text = said(user("list"))
    assert code == ExitCode.OK
    for word in (*two, "bench1", "2026-01-01", "suspended", "no ball came", "excluded"):
        assert word in text


@pytest.mark.parametrize("verb", ["abort", "resume", "export", "answer"])
def test_campaign_command_ambiguous_id_prefix_is_refused(user: Run, two: list[str], verb: str) -> None:
    code, text = said(user(verb, "short"))
    assert code == ExitCode.BAD_INPUT
    assert f"2 campaigns begin so: {two[0]}, {two[1]}" in text
    assert f"Give the id: for the newest, {two[0]}." in text
    assert state_of(user, two[0]) == "suspended"


def test_campaign_abort_unique_id_prefix_selects_campaign(user: Run, two: list[str]) -> None:
    code, text = said(user("abort", "--yes", two[1][:-1]))
    assert code == ExitCode.OK
    assert text.startswith(f"{two[1]} aborted")
    assert (state_of(user, two[0]), state_of(user, two[1])) == ("suspended", "aborted")


def test_campaign_abort_id_prefix_under_4_characters_is_refused(begin: Begin, user: Run) -> None:
    (campaign,) = begin(1)
    code, text = said(user("abort", "--yes", "sho"))
    assert code == ExitCode.BAD_INPUT
    assert f"1 campaign begins so: {campaign}" in text
    assert "at least 4 characters" in text
    assert "no such campaign" in user("abort", "--yes", "lon").words
    assert state_of(user, campaign) == "suspended"


def test_find_campaign_unique_short_name_selects_campaign() -> None:
    names = ("bag", "bag-two", "wedge", "wedge")
    entries = [SimpleNamespace(id=f"{name}-2026{n}", name=name) for n, name in enumerate(names)]
    store: Any = SimpleNamespace(entries=lambda: [(entry, None, None) for entry in entries])
    assert find_campaign(store, "bag").id == "bag-20260"
    with pytest.raises(BenchError, match="2 campaigns begin so"):
        find_campaign(store, "wedge")


@pytest.mark.parametrize(("typed", "state"), [("y\n", "aborted"), ("n\n", "suspended"), ("", "suspended")])
def test_campaign_abort_without_yes_requires_confirmation(
    user: Run, two: list[str], typed: str, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", StringIO(typed))
    code, text = said(user("abort", two[0]))
    assert f"Abort campaign {two[0]} (suspended, 0 shots)? It cannot be resumed. [y/N]" in text
    assert state_of(user, two[0]) == state
    assert code == (ExitCode.OK if state == "aborted" else ExitCode.REFUSED)
    if code:
        assert f"action: golfbench campaign abort --yes {two[0]}" in text


@pytest.mark.usefixtures("undrawn_here")
def test_campaign_resume_writes_report_and_checks_baseline(user: Run, two: list[str], tmp_path: Path) -> None:
    (tmp_path / "band.toml").write_text('[[figure]]\npath = "shots"\nlow = 3\n')
    outputs = ("--report", tmp_path / "r.html", "--check", tmp_path / "band.toml")
    code, text = said(user("resume", two[0], *outputs))
    assert code == ExitCode.REFUSED
    assert "finished; 2 shots, 2 valid" in text
    assert "OUTSIDE" in text
    assert two[0] in (tmp_path / "r.html").read_text()
