"""Campaigns started on the page, measured values entered on it, and the viewer: separate programs.

The program is a script that notes its arguments and answers as `golfbench` would: the real one is started in
test_browser_day.py.
"""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from bench.base.errors import BenchError, Refused
from bench.commands.cli import command_line as all_commands
from bench.config import Configuration
from bench.web import _command_line
from bench.web._answers import InvalidBody
from bench.web._command_line import MAX_COMMANDS, BackgroundCommand, CommandLine, ViewerProcess, fault_of
from bench.web._start_service import _FORMS, PlanCatalogue, form_arguments
from bench.web.page_server import run_outcome
from tests.bench.web.conftest import followed_page
from tests.bench.web.noting_program import NotingProgram
from tests.bench.web.running_page import HURRY, RunningPage
from tests.waiting import wait_until

SCRIPT = "<script>alert(1)</script>"


@pytest.fixture
def page(configuration: Configuration, program: NotingProgram) -> Iterator[RunningPage]:
    with followed_page(configuration, golfbench=program.command) as page:
        yield page


def entered(page: RunningPage, path: str, seen: float | None = None, **content: Any) -> tuple[int, Any]:
    page.numbers += 1
    at = time.monotonic() if seen is None else seen
    answer = page.post(path, {"number": f"entry-no-{page.numbers}", "seen": at, "by": "Ann"} | content)
    return answer.status, answer.content


# Programs --------------------------------------------------------------------------------------------


def said_of(*errors: BenchError) -> str:
    """Return the command line's machine-readable output of `errors`, after other words."""
    return "\n".join(["campaign x", *(json.dumps(error.record()) for error in errors), ""])


def test_fault_of_refused_command_keeps_message() -> None:
    one = Refused("bench b", "held", "free", "Wait.")
    fault = fault_of("golfbench campaign", 1, said_of(one))
    assert fault.record() == one.record()
    both = fault_of("golfbench campaign", 2, said_of(one, Refused("bench c", "held", "free", "Wait.")))
    assert "bench b" in both.found
    assert "bench c" in both.found
    names = [Refused("bench b", f"{name} held", "free", "Wait.") for name in ("a", "b")]
    merged = fault_of("golfbench campaign", 2, said_of(*names))
    assert merged.found.startswith("a ")
    assert "; b " in merged.found
    assert (merged.location, merged.expected, merged.action) == (fault.location, fault.expected, fault.action)
    broken = fault_of("golfbench calibrate", 1, "Traceback ...\nModuleNotFoundError: No module named 'x'\n")
    assert "No module named 'x'" in broken.found
    assert fault_of("x", 70, "").found == "exit code 70"
    assert len(fault_of("x", 70, "y" * 10_000).found) < 3000


def test_command_line_bounds_number_and_time(program: NotingProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    golfbench = CommandLine(program.command)
    for _ in range(MAX_COMMANDS):
        golfbench._free.acquire()
    with pytest.raises(Refused, match="too many"):
        golfbench.output("campaign", "air")
    golfbench._free.release()
    monkeypatch.setattr(_command_line, "COMMAND_TIMEOUT", 0.2)
    with pytest.raises(BenchError, match="still running"):
        golfbench.output("campaign", "run")
    golfbench.close()
    with pytest.raises(Refused, match="the page ends"):
        golfbench.output("campaign", "air")


def test_command_line_close_ends_commands(configuration: Configuration, program: NotingProgram) -> None:
    golfbench = CommandLine(program.command)
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(golfbench.output, "campaign", "run")
        wait_until(lambda: bool(program.asked), words=lambda: "not started")
        golfbench.close()
        with pytest.raises(BenchError):
            waiting.result(HURRY)


# Plans -----------------------------------------------------------------------------------------------


def test_plan_catalogue_lists_shipped_and_local_plans(tmp_path: Path) -> None:
    folder = tmp_path / "plans"
    folder.mkdir()
    (folder / "mine.toml").write_text(f'# About mine\n[campaign]\ntitle = "Mine {SCRIPT}"\n')
    (folder / "two-balls.toml").write_text("damaged = [")
    (folder / "--help.toml").write_text("")
    (folder / "linked.toml").symlink_to("/etc/passwd")
    (folder / "deep.toml").mkdir()
    (folder / "own.toml").write_text(
        '[design]\nclubs = ["driver", "mine", "other"]\n[clubs.mine]\nlike = "driver"\n'
    )
    (folder / "odd.toml").write_text('clubs = 3\n[design]\nclubs = "driver"\nballs = [1, 2]\n')
    shelf = PlanCatalogue(tmp_path, {"balls": ["tour", "range"], "clubs": ["driver"]})
    listed = {one["name"]: one for one in shelf.listed()}
    assert listed["mine"] == {
        "name": "mine",
        "title": f"Mine {SCRIPT}",
        "about": "About mine",
        "shipped": False,
        "lacks": [],
    }
    assert listed["own"]["lacks"] == ["other"]
    assert listed["odd"]["lacks"] == []
    assert "wedge56_wet" in listed["wedge"]["lacks"]
    lacking = [bool(one["lacks"]) for one in shelf.listed()]
    assert lacking == sorted(lacking)  # what cannot run here stands last
    assert listed["symmetry"]["shipped"]
    assert not listed["two-balls"]["shipped"]
    assert not {"--help", "linked", "deep"} & set(listed)
    assert shelf.file("mine") == folder / "mine.toml"
    for name in ("--help", "linked", "../secret", "..", "", "/etc/passwd", SCRIPT):
        with pytest.raises(Refused) as refused:
            shelf.file(name)
        assert SCRIPT not in str(refused.value)


_FORM: dict[str, Any] = {
    **{"name": "three-balls", "compare": "ball", "balls": ["tour", "range"], "clubs": ["driver"]},
    **{"swings": [], "difference": 2.0, "sd": 2.5, "save": False},
}


def test_new_plan_is_written_by_command(
    page: RunningPage, program: NotingProgram, configuration: Configuration
) -> None:
    names = page.ask("GET", "/api/names").content
    assert "tour" in names["balls"]
    assert "driver" in names["clubs"]
    assert "default" in names["swings"]
    for save in (False, True):
        status, content = entered(page, "/api/new-plan", **_FORM | {"save": save})
        assert (status, content["saved"]) == (200, save)
        asked = program.asked[-1]
        options = ["--compare=ball", "--ball=tour", "--ball=range", "--club=driver"]
        assert asked[:-1] == ["campaign", "new", *options, "--difference=2.0", "--sd=2.5", "--"]
        file = Path(asked[-1])
        assert file.name == "three-balls.toml"
        assert (file.parent == configuration.bench.data_dir / "plans") is save


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": "../x"},
        {"name": ""},
        {"balls": "tour"},
        {"balls": [1]},
        {"balls": ["b"] * 51},
        {"difference": "2"},
        {"sd": None},
    ],
)
def test_new_plan_invalid_form_reaches_no_program(
    page: RunningPage, program: NotingProgram, wrong: dict[str, Any]
) -> None:
    assert entered(page, "/api/new-plan", **_FORM | wrong)[0] == 400
    assert program.asked == []


def test_plan_page_check_and_start_run_command(
    page: RunningPage, program: NotingProgram, configuration: Configuration
) -> None:
    assert "two-balls" in [one["name"] for one in page.ask("GET", "/api/plans").content]
    preview = page.post("/api/plan/two-balls/check", {}).content
    assert preview["order"] == [{"section": 1, "block": 1, "shots": [["test", "s", "c", "b"]] * 3}]
    given = {"digest": preview["digest"], "units": "us", "ask": True}
    assert entered(page, "/api/plan/two-balls/start", seen=time.monotonic() - 60.0, **given)[0] == 409
    with page.stream() as following:
        status, content = entered(page, "/api/plan/two-balls/start", **given)
        assert status == 200, content
        assert following("runner") == {"what": "two-balls", "running": True, "text": ""}
        status, content = entered(page, "/api/plan/two-balls/start", **given)
        assert (status, "no other runner" in content["what"]) == (409, True)
        wait_until(lambda: len(program.asked) == 2, words=lambda: program.asked)
        run = program.asked[1]
        options = ["--json", "--by=Ann", "--units=us", "--expect=0123456789abcdef", "--ask", "--"]
        assert run[:-1] == ["campaign", "run", *options]
        assert run[-1].endswith("campaigns/two-balls.toml")
        program.note("fail")
        program.note("end")
        text = following("runner")["text"]
        assert text == "bench b: held by Ann; expected a free bench. Wait."


def test_background_command_outlives_page(tmp_path: Path, program: NotingProgram) -> None:
    log, said = tmp_path / "data" / "runner.log", list[Any]()
    runner = BackgroundCommand(
        CommandLine(program.command), log, lambda topic, content: said.append(content), "runner"
    )
    runner.start("x-1", "campaign", "resume", "--", "x-1")
    wait_until(lambda: bool(program.asked), words=log.read_text)
    process = runner._process
    assert process is not None
    assert (
        os.getsid(process.pid) == process.pid != os.getsid(0)
    )  # no signal of the page's terminal reaches it
    unit = (Path(__file__).parents[3] / "systemd" / "golfbench-page@.service").read_text()
    assert "\nKillMode=process\n" in unit
    os.kill(process.pid, signal.SIGKILL)
    wait_until(lambda: not said[-1]["running"], words=lambda: said)
    assert "exit code -9" in said[-1]["text"]


def test_background_command_suspended_campaign_reports_reason(tmp_path: Path) -> None:
    said = list[Any]()
    record = {"campaign": "x", "state": "suspended", "reason": "bench b: no answer", "shots": 2, "valid": 2}
    words = json.dumps(record, indent=2)
    program = CommandLine([sys.executable, "-c", f"print({words!r}); raise SystemExit(1)"])
    log = tmp_path / "log"
    runner = BackgroundCommand(
        program, log, lambda topic, content: said.append(content), "runner", outcome=run_outcome
    )
    runner.start("x", "campaign", "run")
    wait_until(lambda: not said[-1]["running"], words=lambda: said)
    assert said[-1]["text"] == "Suspended: bench b: no answer; 2 shots, 2 valid."


def test_background_command_without_log_folder_starts_nothing(tmp_path: Path, program: NotingProgram) -> None:
    (tmp_path / "data").write_text("no folder")
    runner = BackgroundCommand(
        CommandLine(program.command), tmp_path / "data" / "log", lambda *_: None, "runner"
    )
    with pytest.raises(BenchError):
        runner.start("x-1", "campaign", "resume", "--", "x-1")
    assert program.asked == []


# Measured values -------------------------------------------------------------------------------------

BALL: dict[str, Any] = {"x": 0.1, "y": -1.5, "uncertainty-mm": 2}
NOTES: dict[str, Any] = {"method": "tape", "note": ""}


def test_values_page_shows_and_enters_values(page: RunningPage, program: NotingProgram) -> None:
    shown = page.ask("GET", "/api/values").content
    assert [one["kind"] for one in shown["entries"]] == ["encoders", "ball", "club", "valves", "inputs"]
    assert shown["air"] is None
    assert "driver" in shown["clubs"]
    status, content = entered(page, "/api/values/ball", numbers=BALL, **NOTES)
    assert (status, content["note"]) == (200, f"ball version 1 of bench1 {SCRIPT}")
    options = ["--by=Ann", "--x", "0.1", "--y", "-1.5", "--uncertainty-mm", "2", "--method=tape"]
    assert program.asked == [["calibrate", "ball", *options]]
    status, content = entered(page, "/api/values/ball", numbers=BALL | {"x": 9}, **NOTES)
    assert status == 409
    assert content["what"] == "Calibrate ball: 9; expected up to 3 m."
    assert content["action"] == "Measure again."


def _options(command: str) -> set[str]:
    kind, name = command.split()
    parameters = all_commands().commands[kind].commands[name].params  # type: ignore[attr-defined]
    return {option.removeprefix("--") for one in parameters for option in one.opts}


def test_forms_of_browser_match_command_options() -> None:
    script = (Path(_command_line.__file__).parent / "static" / "forms.js").read_text()
    table = script.partition("const FORMS")[2].partition("\n];")[0]
    forms = {text.partition('"')[0]: text for text in re.split(r'\n    name: "', table)[1:]}
    assert set(forms) == {"air", "encoders", "ball", "club", "valves"}
    for name, text in forms.items():
        fields = set(re.findall(r'{ name: "([^"]+)"', text))
        assert fields, name
        assert fields == set(_FORMS[name]), name
        assert fields < _options(f"{'campaign' if name == 'air' else 'calibrate'} {name}"), name


def test_form_arguments_match_command_options() -> None:
    valves = {"centre": [0.01, -0.02, 0], "uncertainty": 1e-3, "expires-days": 30}
    body = {"numbers": valves, "method": "", "note": "--config=/etc/passwd"}
    assert form_arguments("valves", body, "--help") == [
        *("calibrate", "valves", "--by=--help", "--centre", "0.01", "-0.02", "0"),
        *("--uncertainty", "0.001", "--expires-days", "30", "--note=--config=/etc/passwd"),
    ]
    found = form_arguments("club", {"numbers": {"length": 1}, "club": "--help"}, "Ann")
    assert found == ["calibrate", "club", "--by=Ann", "--length", "1", "--", "--help"]
    assert form_arguments("air", {"numbers": {"pressure": 1000.5}}, "Ann")[:2] == ["campaign", "air"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"numbers": BALL | {"x": "1; reboot"}},
        {"numbers": BALL | {"x": None}},
        {"numbers": BALL | {"x": True}},
        {"numbers": BALL | {"x": {"a": 1}}},
        {"numbers": BALL | {"x": 1e300}},
        {"numbers": BALL | {"x": [1, 2, "3"]}},
        {"numbers": BALL | {"x": [1, 2, float("nan")]}},
        {"numbers": BALL | {"x=1 --y": 1}},
        {"numbers": BALL | {"-c": 1}},
        {"numbers": BALL | {"help": []}},
        {"numbers": BALL | {"by": 7}},
        {"numbers": BALL | {"x": [1, 2]}},
        {"numbers": [1]},
        {"numbers": None},
        {"method": "a\nb"},
        {"method": None},
        {"note": "x" * 201},
    ],
)
def test_form_arguments_invalid_value_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InvalidBody):
        form_arguments("ball", {"numbers": BALL} | NOTES | wrong, "Ann")


# The viewer ------------------------------------------------------------------------------------------


def test_viewer_path_opens_from_same_origin_only_and_closes(
    page: RunningPage, program: NotingProgram
) -> None:
    own = {"sec-fetch-site": "same-origin"}
    for headers in ({}, {"sec-fetch-site": "none"}, {"sec-fetch-site": "cross-site"}):
        assert page.ask("GET", "/viewer", None, headers).status == 403
    assert program.asked == []
    for _ in range(2):
        answer = page.ask("GET", "/viewer", None, own)
        assert answer.status == 303, answer.body
        assert answer.headers["location"].startswith("http://127.0.0.1:9999/?url=")
    assert program.asked == [["view", "--web"]]
    with page.stream() as following:
        assert following("viewer") == {"open": True}
        assert page.post("/api/viewer/close", {}).status == 200
        assert following("viewer") == {"open": False}
    program.note("fail")
    answer = page.ask("GET", "/viewer", None, own)
    assert (answer.status, answer.content["action"]) == (409, "Install it.")


def test_viewer_process_without_url_is_ended(program: NotingProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_command_line, "START", 0.2)
    silent = CommandLine((sys.executable, "-S", "-c", "import time; time.sleep(600)"))
    viewer = ViewerProcess(silent, lambda *_: None)
    with pytest.raises(BenchError, match="no URL"):
        viewer.url()
    assert viewer._process is None
    viewer.close()
