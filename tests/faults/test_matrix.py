"""A part of the matrix, deterministic and quick; `make faults` runs all of it."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from typer.testing import CliRunner

import bench.faults.matrix
from bench.commands.common import Session
from bench.commands.machine.faults import app, matrix_page, matrix_table
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.faults._verdict import CaseOutcome
from bench.faults.catalogue import ACCESS, CATALOGUE, START, Breakage, Instant, instants_of, irrelevant
from bench.faults.matrix import (
    FaultStudy,
    MatrixPlan,
    Workbench,
    instants_for,
    matrix_store,
    plan_matrix,
    run_matrix,
)
from bench.faults.summary import PHASES, hazard_table, matrix_digest, summarise, summary_text
from bench.simulation.sweep import InProcess
from bench.swing.profile import Profile
from drivers.base import JOINTS
from sim.faults import KINDS, SIGNALS, sort_of
from tests.compiled_only import needs_speed
from tests.faults.made_matrix import BREAKAGE, ORIGIN, instant, outcome, whole_matrix

ROOT = Path(__file__).parents[2]


def test_catalogue_covers_every_signal_and_kind() -> None:
    not_shipped = {f"{joint} spool feedback" for joint in JOINTS}
    assert {breakage.fault.signal for breakage in CATALOGUE} == set(SIGNALS) - not_shipped
    assert {breakage.fault.kind for breakage in CATALOGUE} == set(KINDS)
    assert len(BREAKAGE) == len(CATALOGUE)


def test_instants_cover_every_phase(profile: Profile) -> None:
    instants = instants_of(profile)
    phases = dict.fromkeys(instant.phase for instant in (*START, *ACCESS, *instants))
    assert list(phases) == list(PHASES)
    assert len({instant.name for instant in instants}) == len(instants)


def test_plan_matrix_skips_only_by_rule(profile: Profile) -> None:
    plan = plan_matrix(profile, model_check=True)
    assert len(plan.cases) + len(plan.skipped) == sum(len(instants_for(b, profile)) for b in CATALOGUE)
    assert {s.family for s in plan.skipped} == {"one fault"}
    assert all(skipped.rule for skipped in plan.skipped)
    moving = [s for s in plan.skipped if sort_of(s.signal) in ("encoder", "valve", "link", "clock", "loop")]
    assert not moving


@needs_speed
@pytest.mark.parametrize(
    ("name", "at", "detected_by", "most_ticks"),
    [
        ("wrist encoder off", "backswing 50 %", "WRIST_ENCODER", 5),
        ("arm encoder off", "downswing 80 %", "ARM_ENCODER", 5),
        ("guard closed off", "top 50 %", "GUARD", 1),
        ("emergency stop off", "downswing 20 %", "EMERGENCY_STOP", 1),
        ("emergency stop off", "impact +0 ms", "EMERGENCY_STOP", 1),
        ("link cut", "committed 10 %", "SHOULDER_ENCODER", 5),
        ("loop stalls 50 ms", "backswing 10 %", "DEVICE_PASSIVE", 50),
        ("clock stands still", "backswing 50 %", "TICK_GAP", 2),
        ("supervisor dead", "return 300 ms", "SUPERVISOR", 1),
        ("shoulder valve stuck open", "follow-through 40 %", "SHOULDER_AIR", 20),
        ("shoulder valve stuck open in reverse", "backswing 50 %", "SHOULDER_AIR", 20),
        ("shoulder encoder +0.1 rad", "hold", "SHOULDER_SPEED", 2),
    ],
)
def test_matrix_fault_is_detected_in_time_and_safe(
    workbench: Workbench, profile: Profile, name: str, at: str, detected_by: str, most_ticks: int
) -> None:
    outcome = workbench.run(BREAKAGE[name], instant(profile, at))
    assert (outcome.verdict, outcome.reasons) == ("safe", ())
    assert outcome.detected_by == detected_by
    assert 0 <= outcome.detection_ticks <= most_ticks
    assert outcome.reaction_ticks >= outcome.detection_ticks
    assert outcome.operator != "nothing"
    assert detected_by in outcome.record


@needs_speed
def test_dead_loop_valve_node_watchdog_reacts_passive(workbench: Workbench, profile: Profile) -> None:
    outcome = workbench.run(BREAKAGE["loop dead"], instant(profile, "top 50 %"))
    assert outcome.detected_by == "watchdog of the valve node"
    assert outcome.reaction == "PASSIVE (valve node)"
    assert outcome.verdict == "safe"


@needs_speed
def test_valve_stuck_open_without_model_check_is_unsafe(profile: Profile) -> None:
    configuration = load_configuration(shipped_configuration())
    bench_without = Workbench(configuration, profile, model_check=False)
    outcome = bench_without.run(
        BREAKAGE["shoulder valve stuck open"], instant(profile, "follow-through 40 %")
    )
    assert outcome.verdict == "unsafe"
    assert "rated energy" in outcome.reasons[0]
    assert outcome.detection_ticks > 20


@needs_speed
def test_missing_ball_is_harmless_or_safe(workbench: Workbench, profile: Profile) -> None:
    outcome = workbench.run(BREAKAGE["no ball on the tee, then no ball"], instant(profile, "hold"))
    assert outcome.verdict in ("harmless", "safe")


@needs_speed
def test_lost_lease_swing_completes_and_disarms(workbench: Workbench, profile: Profile) -> None:
    outcome = workbench.run(BREAKAGE["lease lost"], instant(profile, "downswing 80 %"))
    assert (outcome.verdict, outcome.detected_by) == ("safe", "disarmed: no lease")
    assert outcome.record.startswith("READY")


@needs_speed
def test_workbench_same_case_gives_equal_outcome(workbench: Workbench, profile: Profile) -> None:
    case = BREAKAGE["arm encoder garbage"], instant(profile, "downswing 20 %")
    assert workbench.run(*case) == workbench.run(*case)


@pytest.fixture
def few(profile: Profile) -> tuple[MatrixPlan, list[CaseOutcome]]:
    plan = plan_matrix(profile, model_check=True, signals=("guard closed", "launch"), phases=("top", "hold"))
    outcomes = [outcome(b, i, "unsafe" if b.fault.kind == "garbage" else "safe") for b, i in plan.cases]
    return plan, outcomes


def test_summarise_counts_verdicts_and_page_is_self_contained(
    few: tuple[MatrixPlan, list[CaseOutcome]],
) -> None:
    plan, outcomes = few
    summary = summarise(
        outcomes, plan.skipped, model_check=True, profile="default", seconds=1.0, origin=ORIGIN
    )
    assert summary["verdicts"] == {"harmless": 0, "safe": 8, "undetected": 0, "unsafe": 2}
    assert summary["left_out_by_rule"] == len(plan.skipped) == 14
    assert summary["reaction_ticks"]["switch off"]["greatest"] == 1
    page = matrix_page(summary)
    assert "200 %" in page
    assert not any(text in page for text in ("http:", "https:", "src=", "href="))
    assert matrix_table(summary).row_count == len(summary["rows"])
    table = hazard_table(json.loads(json.dumps(summary)))
    assert "guard switches of two channels" in table
    assert "commit 0123456789ab" in table
    assert summary["families"]["one fault"] == summary["verdicts"]
    assert summary["reasons"]["unsafe"] == {"wrist lower stop took … % of its rated energy": 2}
    assert "| 10 | 0 | 2 |" in table


def test_run_matrix_skips_stored_cases(
    few: tuple[MatrixPlan, list[CaseOutcome]],
    tmp_path: Path,
    profile: Profile,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan, outcomes = few
    configuration = load_configuration(shipped_configuration())
    study = FaultStudy(configuration, profile, True)
    path = tmp_path / "cases.jsonl"
    names = [f"{o.breakage}, {o.instant}" for o in outcomes]
    matrix_store(path, study).add(dict(zip(names[:-1], outcomes[:-1], strict=True)))
    with path.open("a") as file:
        file.write('{"case": "torn')
    ran = []

    class Recorded:
        def __init__(self, *_: object, **__: object) -> None:
            pass

        def run(self, breakage: Breakage, at: Instant) -> CaseOutcome:
            ran.append((breakage.name, at.name))
            return outcome(breakage, at, "safe")

    monkeypatch.setattr(bench.faults.matrix, "Workbench", Recorded)
    told: list[int] = []
    store = matrix_store(path, study)
    found = run_matrix(plan, study, store, InProcess(), progress=told.append)
    assert ran == [(outcomes[-1].breakage, outcomes[-1].instant)]
    assert [o.breakage for o in found] == [o.breakage for o in outcomes]
    assert told == [9, 10]
    assert len(matrix_store(path, study).results) == 10
    assert not matrix_store(path, replace(study, model_check=False)).results


def test_faults_run_unsafe_case_exits_with_1(
    few: tuple[MatrixPlan, list[CaseOutcome]],
    tmp_path: Path,
    profile: Profile,
    configuration: Configuration,
) -> None:
    _plan, outcomes = few
    store = matrix_store(tmp_path / "cases.jsonl", FaultStudy(configuration, profile, True))
    store.add({f"{o.breakage}, {o.instant}": o for o in outcomes})
    arguments = ["run", "--output", str(tmp_path), "--phase", "top", "--phase", "hold", "--signal", "launch"]
    arguments += ["--signal", "guard closed", "--processes", "1"]
    session = Session(config=shipped_configuration())
    result = CliRunner().invoke(app, arguments, obj=session)
    assert result.exit_code == 1
    assert json.loads((tmp_path / "matrix.json").read_text())["cases"] == 10
    assert (tmp_path / "matrix.html").exists()


@pytest.mark.live
@pytest.mark.parametrize(
    ("number", "at_work"), [(signal.SIGKILL, False), pytest.param(signal.SIGTERM, True, marks=needs_speed)]
)
def test_faults_run_ended_by_signal_leaves_no_worker(
    tmp_path: Path, number: signal.Signals, at_work: bool
) -> None:
    command = [sys.executable, "-m", "bench", "faults", "run", "--output", str(tmp_path), "--processes", "2"]
    run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    workers: list[psutil.Process] = []
    try:
        while len(workers) < 2 or (at_work and (tmp_path / "cases.jsonl").read_text().count("\n") < 2):
            workers = [child for child in psutil.Process(run.pid).children() if _is_worker(child)]
            time.sleep(0.05)  # the test's own time-out ends this
    finally:
        run.send_signal(number)
        assert run.wait(10.0) == -number
    _, alive = psutil.wait_procs(workers, 20.0)
    assert not alive


def _is_worker(process: psutil.Process) -> bool:
    with suppress(psutil.Error):
        return "spawn_main" in " ".join(process.cmdline())
    return False


def test_irrelevant_returns_rule_or_empty_text() -> None:
    launch = BREAKAGE["launch monitor off"]
    assert "launch monitor" in irrelevant(launch, "impact", model_check=True)
    assert irrelevant(BREAKAGE["guard closed off"], "impact", model_check=True) == ""


def test_matrix_digest_depends_on_outcomes_not_date() -> None:
    summary = whole_matrix()
    digest = matrix_digest(summary)
    later = summary | {"seconds": 9.0, "origin": ORIGIN | {"commit": "f", "time_utc": "2027"}}
    assert matrix_digest(json.loads(summary_text(later))) == digest
    assert matrix_digest(summary | {"rows": [summary["rows"][0] | {"detection_ticks": [2]}]}) != digest


def test_hazard_table_counts_every_case_once() -> None:
    summary = whole_matrix()
    rows = hazard_table(summary).split("| part |")[1].split("\n\n")[0].splitlines()[2:]
    counts = [tuple(map(int, row.split(" | ")[1:5])) for row in rows]
    verdicts = summary["verdicts"]
    expected = (summary["cases"], verdicts["undetected"], verdicts["unsafe"])
    assert tuple(map(sum, zip(*counts, strict=True)))[1:] == expected


def test_committed_fault_tables_share_digest_and_fault_count() -> None:
    brief, hazards = ((ROOT / "sim" / name).read_text() for name in ("FAULTS.md", "HAZARDS.md"))
    digest = re.search(r"Digest of all outcomes: (\w{16})", brief)
    assert digest is not None
    assert digest[1] in hazards
    assert f"{len(CATALOGUE)} faults, " in brief
