"""Commissionings on the page: listed as they are stored, started and ended as at the command line.

The program is a script that notes its arguments; the real one runs in test_browser_commissioning.py.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from bench.base.address import BenchSettings
from bench.base.errors import Refused
from bench.commissioning.commissioning import ALL_STEPS, Commissioning, DoneStep, FaultRecord, folder_lock
from bench.config import Configuration
from bench.web._start_service import CommissioningService
from tests.bench.web.noting_program import NotingProgram
from tests.bench.web.running_page import HURRY, RunningPage, running_page
from tests.waiting import wait_until

SCRIPT = "<script>alert(1)</script>"
DAY = datetime(2026, 5, 1, 12, 0, tzinfo=UTC)
HOLDER = """
import sys, time
from pathlib import Path
from bench.commissioning.commissioning import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def page(configuration: Configuration, program: NotingProgram) -> Iterator[RunningPage]:
    with running_page(configuration, golfbench=program.command) as page:
        yield page


def stored(data_dir: Path, name: str, done: int = 1, wrong: bool = False) -> Path:
    """Store a commissioning with `done` steps."""
    folder = data_dir / "commissioning" / name
    state = Commissioning(folder, "0" * 16, "/srv/bench.toml", simulated=True, robot="/srv/other.toml")
    for step in ALL_STEPS[:done]:
        one = DoneStep(step.name, step.title, "bounds", DAY.isoformat(), 61.0, "records/1.npz", (), (SCRIPT,))
        state.done.append(one)
    if wrong:
        state.wrong = FaultRecord(
            ALL_STEPS[done].name, DAY.isoformat(), "hose", "air", "none", "Fit the hose."
        )
    state.save()
    (folder / "report.html").write_text(f"<!doctype html><title>Report</title>{SCRIPT}")
    return folder


def service_of(folder: Path) -> CommissioningService:
    """Return the commissionings in `folder`, without programs."""
    return CommissioningService(BenchSettings(id="bench1", data_dir=folder), Mock(), Mock())


def asked(page: RunningPage, path: str, **content: Any) -> tuple[int, Any]:
    page.numbers += 1
    answer = page.post(f"/api/commissioning/{path}", {"number": f"commission-{page.numbers}"} | content)
    return answer.status, answer.content


# What is shown ---------------------------------------------------------------------------------------


def test_commissioning_store_shows_steps_notes_and_faults(tmp_path: Path) -> None:
    shelf = service_of(tmp_path)
    assert shelf.view()["commissionings"] == []
    stored(tmp_path, "first-day", done=2, wrong=True)
    (one,) = shelf.view()["commissionings"]
    assert (one["name"], one["done"], one["robot"], one["process"]) == ("first-day", 2, "other", None)
    assert [step["title"] for step in one["steps"]] == [step.title for step in ALL_STEPS]
    assert [step["done"] for step in one["steps"]] == [True, True, *[False] * 7]
    assert one["steps"][0]["notes"] == [SCRIPT]
    assert one["wrong"]["action"] == "Fit the hose."
    assert one["files"] == ["report"]
    with folder_lock(tmp_path / "commissioning" / "first-day"):
        assert shelf.view()["commissionings"][0]["process"] == os.getpid()


def test_commissioning_store_unreadable_state_gives_reason(tmp_path: Path) -> None:
    folder = stored(tmp_path, "first-day")
    (folder / "commissioning.json").write_text("{")
    (one,) = service_of(tmp_path).view()["commissionings"]
    assert "Begin again in another folder" in one["unreadable"]


def test_commissioning_store_unlisted_names_are_refused(tmp_path: Path) -> None:
    folder = stored(tmp_path, "first-day")
    robots = tmp_path / "robots"
    robots.mkdir()
    (robots / "other.toml").write_text("")
    (robots / "--help.toml").write_text("")
    (robots / "linked.toml").symlink_to("/etc/passwd")
    (tmp_path / "commissioning" / "linked").symlink_to(folder)
    (folder / "robot.toml").symlink_to("/etc/passwd")
    shelf = service_of(tmp_path)
    assert shelf.view()["robots"] == ["other"]
    assert [one["name"] for one in shelf.view()["commissionings"]] == ["first-day"]
    assert shelf.folder("first-day") == folder
    assert shelf.robot("other") == robots / "other.toml"
    report = shelf.file({"commissioning": "first-day", "kind": "report"})
    assert report is not None
    assert report.path == folder / "report.html"
    for name in ("linked", "--help", "..", "", "../first-day", "/etc/passwd", SCRIPT):
        for look in (shelf.folder, shelf.robot):
            with pytest.raises(Refused) as refused:
                look(name)
            assert SCRIPT not in str(refused.value)
        assert shelf.file({"commissioning": name, "kind": "report"}) is None
    for kind in ("robot", "commissioning.json", "..", ""):
        assert shelf.file({"commissioning": "first-day", "kind": kind}) is None


def test_commissioning_change_reaches_page(page: RunningPage, configuration: Configuration) -> None:
    with page.stream() as following:
        assert following("commissioning")["commissionings"] == []
        stored(configuration.bench.data_dir, "first-day")
        while not (found := following("commissioning")["commissionings"]):
            pass
        assert found[0]["done"] == 1


def test_commissioning_report_runs_no_script(page: RunningPage, configuration: Configuration) -> None:
    folder = stored(configuration.bench.data_dir, "first-day")
    answer = page.ask("GET", "/commissioning/first-day/report")
    assert answer.status == 200
    assert "sandbox" in answer.headers["content-security-policy"]
    assert "script-src" not in answer.headers["content-security-policy"]
    assert page.ask("GET", "/commissioning/first-day/robot").status == 404
    (folder / "robot.toml").write_text("x = 1\n")
    answer = page.ask("GET", "/commissioning/first-day/robot")
    assert answer.body == b"x = 1\n"
    assert "attachment" in answer.headers["content-disposition"]
    for path in ("none/report", "first-day/state", "..%2ffirst-day/report", "..%2f..%2fetc/robot"):
        assert page.ask("GET", f"/commissioning/{path}").status == 404


# What is started -------------------------------------------------------------------------------------


def test_commissioning_page_check_and_start_run_command(
    page: RunningPage, program: NotingProgram, configuration: Configuration
) -> None:
    robots = configuration.bench.data_dir / "robots"
    robots.mkdir(parents=True)
    (robots / "other.toml").write_text("")
    first = stored(configuration.bench.data_dir, "first-day")
    status, content = asked(page, "check", robot="", resume="", repaired="")
    assert (status, content["steps"][0]["title"]) == (200, "T")
    check = program.asked[0]
    assert check[:2] == ["commission", "--sim"]
    assert check[2].startswith(f"--output={first.parent}/bench1-")
    assert check[3:] == ["--check", "--json"]
    with page.stream() as following:
        status, content = asked(page, "start", robot="other", resume="first-day", repaired="new hose")
        assert status == 200, content
        assert following("commissioner") == {"what": "first-day", "running": True, "text": ""}
        status, content = asked(page, "start", robot="", resume="", repaired="")
        assert (status, "no other" in content["what"]) == (409, True)
        wait_until(lambda: len(program.asked) == 2)
        given = ["commission", "--sim", f"--output={first}", f"--robot={robots / 'other.toml'}"]
        assert program.asked[1] == [*given, "--resume", "--repaired=new hose"]
        program.note("fail")
        program.note("end")
        assert following("commissioner")["text"] == "bench b: held by Ann; expected a free bench. Wait."
    status, content = asked(page, "check", robot="", resume="first-day", repaired="new hose")
    assert (status, content["what"], content["action"]) == (
        409,
        "Robot: no sensors; expected some.",
        "Fit them.",
    )


def test_commissioning_page_end_without_learned_swing_is_no_fault(
    page: RunningPage, program: NotingProgram
) -> None:
    program.note("refuse")
    program.note("end")
    with page.stream() as following:
        assert asked(page, "start", robot="", resume="", repaired="")[0] == 200
        while (said := following("commissioner"))["running"]:
            pass
        assert said["text"] == ""


@pytest.mark.slow
def test_commissioning_page_stops_process_of_earlier_page(
    page: RunningPage, configuration: Configuration
) -> None:
    folder = stored(configuration.bench.data_dir, "first-day")
    assert asked(page, "stop", name="first-day")[0] == 409
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            process.stdout.readline()
            status, content = asked(page, "stop", name="first-day")
            assert status == 200, content
            process.wait(HURRY)
        finally:
            process.kill()
    with page.stream() as following:
        while not (found := following("commissioning")["commissionings"]) or found[0]["process"] is not None:
            pass


@pytest.mark.parametrize(
    "content",
    [
        {"robot": "--help", "resume": "", "repaired": "nothing"},
        {"robot": "../../etc/passwd", "resume": "", "repaired": "nothing"},
        {"robot": "", "resume": "../first-day", "repaired": "nothing"},
        {"robot": SCRIPT, "resume": "", "repaired": "nothing"},
        {"robot": "", "resume": "x" * 200, "repaired": "nothing"},
        {"robot": 1, "resume": "", "repaired": "nothing"},
        {"robot": "", "resume": "a\nb", "repaired": "nothing"},
        {"robot": "", "resume": "first-day", "repaired": ""},
        {},
    ],
)
def test_commissioning_page_invalid_request_starts_nothing(
    page: RunningPage, program: NotingProgram, configuration: Configuration, content: dict[str, Any]
) -> None:
    stored(configuration.bench.data_dir, "first-day")
    for path in ("check", "start"):
        status, answer = asked(page, path, **content)
        assert status in (400, 409)
        assert SCRIPT not in json.dumps(answer)
    assert program.asked == []
