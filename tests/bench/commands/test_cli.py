"""The frame of the command line: quick to start, and every error with its action and exit code."""

from __future__ import annotations

import errno
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.metadata import version
from io import BytesIO, TextIOWrapper
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import psutil
import pytest

from bench.base.address import free_port
from bench.base.errors import FOR_PROGRAMS, BenchError, ExitCode, Refused
from bench.base.interrupt import Terminated
from bench.commands.cli import accept_any_text, command_line
from drivers.base import DriverError
from tests.bench.fake_bench_service import FakeDesk, loopback_configuration, running_plane
from tests.conftest import Outcome, Run
from tests.sampling import release_except

TOP = Path(__file__).resolve().parents[3]
HEAVY = (
    "can",
    "filterpy",
    "matplotlib",
    "numba",
    "numpy",
    "pyarrow",
    "rerun",
    "scipy",
    "sqlalchemy",
    "zenoh",
)
BAD_PRESSURE = BenchError("config.toml supply.pressure", "-3", "0.1e6 to 1.1e6 Pa", "Correct the value.")
BAD_KEY = BenchError("config.toml supply.presure", "an unknown key", "pressure", "Correct the key.")
UNSAFE = Refused("hook.toml follow_through", "78 J at the stop", "at most 40 J", "Lower the speed.")


@pytest.fixture
def failing(run: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a command that raises the given error."""

    def fail(error: BaseException, *arguments: str) -> Outcome:
        monkeypatch.setattr("bench.commands.machine.doctor_bench.probes", Mock(side_effect=error))
        return run(*arguments, "doctor")

    return fail


def test_help_lists_commands_and_exit_codes(run: Run) -> None:
    exit_code, out, _ = run("--help")
    assert exit_code == 0
    assert "doctor" in out
    for code in ExitCode:
        assert f" {code.value}  " in out


def test_help_loads_no_heavy_packages() -> None:
    code = "import sys, atexit; atexit.register(lambda: print(*sys.modules))\n"
    code += "from bench.commands.cli import main; main(['--help'])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(answer.stdout.splitlines()[-1].split())
    assert "bench.commands.cli" in loaded
    assert loaded.isdisjoint(HEAVY)


NO_CLIENTS = frozenset(
    {
        "llvmlite",
        "matplotlib",
        "numba",
        "numpy",
        "pandas",
        "pyarrow",
        "pydantic",
        "scipy",
        "sim",
        "sqlalchemy",
    }
)
"""Packages that a command of a running bench does without: who stops a robot does not wait for them."""


DAY = (
    *("lease take", "lease renew", "lease show", "status", "status --json", "reset", "access"),
    *("access --end", "home", "arm", "tee", "swing --no-wait", "arm", "swing", "arm", "disarm"),
    *("stop", "reset", "estop", "reset", "lease release"),
)


def _loaded(folder: Path, *lines: str, port: int | None = None) -> list[tuple[int, set[str]]]:
    """Run command lines in one process; return the exit code of each and what is loaded by then."""
    code = (
        "import sys; import bench.commands.cli\n"
        "bench.commands.cli.leave = lambda code: print('\\nLOADED', int(code), *sys.modules)\n"
        "for line in sys.argv[2:]: bench.commands.cli.main(['--config', sys.argv[1], *line.split()])\n"
        "from bench.base.interrupt import leave; leave(0)"
    )
    file = folder / "bench.toml"
    network = f'[network]\nendpoint = "tcp/127.0.0.1:{port or free_port()}"\n'
    file.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{folder}"\n{network}')
    command = [sys.executable, "-c", code, str(file), *lines]
    environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
    printed = subprocess.check_output(command, env=environment, cwd=folder, text=True).splitlines()
    ends = [line.split()[1:] for line in printed if line.startswith("LOADED ")]
    return [(int(end), {name.partition(".")[0] for name in names}) for end, *names in ends]


def test_operate_commands_load_no_model_packages(tmp_path: Path) -> None:
    """With a bench that answers everything and swings at once."""
    with running_plane(FakeDesk(), loopback_configuration(port := free_port())):
        ended = _loaded(tmp_path, *DAY, port=port)
    assert len(ended) == len(DAY)
    for line, (code, loaded) in zip(DAY, ended, strict=True):
        assert (code, loaded & NO_CLIENTS) == (ExitCode.OK, set()), line
        assert "zenoh" in loaded, line


def test_campaign_commands_load_no_model_packages(tmp_path: Path) -> None:
    lines = ("campaign list", "campaign stop nothing", "campaign watch")
    ended = _loaded(tmp_path, *lines)
    assert ended[0][0] == ExitCode.OK
    assert ended[-1][1] >= {"sqlalchemy", "zenoh"}
    for line, (_, loaded) in zip(lines, ended, strict=True):
        assert not loaded & (NO_CLIENTS - {"pydantic", "sqlalchemy"}), line


def test_simulation_free_commands_load_no_compiler(tmp_path: Path) -> None:
    lines = ("profile list", "campaign air")
    for line, (code, loaded) in zip(lines, _loaded(tmp_path, *lines), strict=True):
        assert (code, loaded & {"numba", "scipy", "matplotlib"}) == (ExitCode.OK, set()), line


def _pages(command: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name, below in getattr(command, "commands", {}).items():
        yield from _pages(below, *path, name)


@pytest.mark.parametrize(
    ("path", "command"), [pytest.param(*page, id=" ".join(page[0])) for page in _pages(command_line())]
)
def test_help_page_shows_complete_texts_and_each_option(
    path: tuple[str, ...], command: Any, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    """Brackets are style tags to the library that prints it: "Where to [default: here]." lost its default."""
    monkeypatch.setenv("COLUMNS", "400")
    shown = run(*path, "--help").out
    texts = [command.help or "", *(getattr(parameter, "help", "") for parameter in command.params)]
    texts += [text for p in command.params if isinstance(text := getattr(p, "show_default", ""), str)]
    for text in texts:
        for paragraph in text.replace("\\[", "[").split("\n\n"):
            assert " ".join(paragraph.split()) in shown
    assert not re.search(r" \.(\s|$)", shown)
    assert "<bool>" not in shown, "a flag takes no value"
    assert "[[" not in shown
    monkeypatch.setenv("COLUMNS", "80")
    shown = run(*path, "--help").out
    assert [name for p in command.params for name in p.opts if name[0] == "-" and name not in shown] == []


def test_version_option_prints_package_version(run: Run) -> None:
    assert run("--version")[1] == f"golfbench {version('golfbench')}\n"


@pytest.mark.parametrize("arguments", [["dcotor"], ["doctor", "--jsno"], ["--config"], []])
def test_cli_wrong_usage_exits_with_2(arguments: list[str], run: Run) -> None:
    code, _, err = run(*arguments)
    assert code == ExitCode.BAD_INPUT
    assert "Traceback" not in err


def test_cli_wrong_choice_lists_choices_alone(run: Run) -> None:
    _, _, err = run("export", "--format", "parquet", "a")
    assert "is not one of 'csv'" in err
    assert "Value error" not in err


def test_shell_completion_completes_command_name() -> None:
    words = {"_GOLFBENCH_COMPLETE": "complete_bash", "COMP_WORDS": "golfbench do", "COMP_CWORD": "1"}
    command = [sys.executable, "-m", "bench"]
    assert subprocess.check_output(command, text=True, env=os.environ | words).split() == ["doctor"]


@pytest.mark.parametrize(
    ("error", "code", "texts"),
    [
        (BAD_PRESSURE, 2, ["supply.pressure", "-3", "0.1e6 to 1.1e6 Pa", "Correct the value."]),
        (UNSAFE, 1, ["hook.toml", "78 J", "at most 40 J", "Lower the speed."]),
        (
            ExceptionGroup("config.toml", [BAD_PRESSURE, BAD_KEY]),
            2,
            ["Correct the value.", "Correct the key."],
        ),
        (
            DriverError("valve island: found no answer"),
            69,
            ["error: device", "valve island: found no answer"],
        ),
        (
            FileNotFoundError(2, "No such file or directory", "swing.toml"),
            74,
            ["error: swing.toml\n", "found:    No such file", "Check path"],
        ),
        (
            OSError(errno.ENOSPC, "No space left on device"),
            74,
            ["error: standard output or a file\n  found:    No space left on device\n"],
        ),
        (ZeroDivisionError("1/0"), 70, ["error: internal error", "ZeroDivisionError: 1/0", "--debug"]),
        (KeyboardInterrupt(), 130, []),
        (Terminated(), 143, []),
    ],
)
def test_main_error_prints_action_and_exit_code_without_traceback(
    error: BaseException,
    code: int,
    texts: list[str],
    failing: Run,
) -> None:
    answer = failing(error)
    assert answer.code == code
    assert [text for text in texts if text not in answer.err] == []
    assert "Traceback" not in answer.err


@pytest.mark.parametrize("line", [("schema",), ("profile", "list"), ("profile", "list", "--json")])
@pytest.mark.parametrize("errors", release_except({""}, ["", "json"]))
def test_main_closed_pipe_ends_quietly_with_file_code(line: tuple[str, ...], errors: str) -> None:
    """Tables and plain text notice it in different packages."""
    command = [sys.executable, "-m", "bench", "--config", "shipped", *line]
    environment = {**os.environ, FOR_PROGRAMS: errors}
    with subprocess.Popen(
        command, cwd=TOP, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == ExitCode.FILE


def test_main_error_for_programs_prints_json_lines(failing: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOR_PROGRAMS, "json")
    code, _, err = failing(ExceptionGroup("config.toml", [BAD_PRESSURE, BAD_KEY]))
    assert code == ExitCode.BAD_INPUT
    assert [json.loads(line) for line in err.splitlines()] == [BAD_PRESSURE.record(), BAD_KEY.record()]
    for error, expected, key, value in (
        (NotADirectoryError(20, "Not a directory", "data"), ExitCode.FILE, "location", "data"),
        (DriverError("canopen: no link"), ExitCode.DEVICE, "found", "canopen: no link"),
        (ZeroDivisionError("1/0"), ExitCode.INTERNAL, "location", "internal error"),
    ):
        code, _, err = failing(error)
        assert (code, json.loads(err)[key]) == (expected, value)


@pytest.mark.parametrize("arguments", [[], ["nonsense"], ["arm", "--nonsense"], ["campaign", "run"]])
def test_main_usage_error_for_programs_is_json_line(
    arguments: list[str], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOR_PROGRAMS, "json")
    code, _, err = run(*arguments)
    fault = json.loads(err)
    assert code == ExitCode.BAD_INPUT
    assert (fault["location"], bool(fault["found"])) == ("command line", True)


def test_debug_option_prints_traceback(failing: Run) -> None:
    assert "Traceback (most recent call last)" in failing(ZeroDivisionError("1/0"), "--debug").err


def test_bench_error_pickle_keeps_type_and_text() -> None:
    copy = pickle.loads(pickle.dumps(UNSAFE))  # noqa: S301 - our own bytes
    assert type(copy) is Refused
    assert (
        str(copy)
        == "hook.toml follow_through: found 78 J at the stop, expected at most 40 J. Lower the speed."
    )


def test_main_deleted_working_directory_is_reported(
    failing: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    code, _, err = failing(FileNotFoundError(errno.ENOENT, "No such file or directory"))
    assert (code, "working directory\n  found:    it was deleted" in err) == (ExitCode.FILE, True)


@pytest.mark.parametrize("name", ["sim/__init__.py", "drivers/__init__.py", "sim.py"])
def test_import_bench_shadowed_package_reports_both_paths(tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    (tmp_path / "script.py").write_text("import bench\n")
    path = {**os.environ, "PYTHONPATH": str(TOP)}
    script = [sys.executable, str(tmp_path / "script.py")]
    answer = subprocess.run(script, capture_output=True, text=True, check=False, env=path)
    package = name.partition("/")[0].removesuffix(".py")
    assert f"golfbench: found '{package}' in {tmp_path}" in answer.stderr
    assert f"expected it in {TOP / package}" in answer.stderr
    script.insert(1, "-P")
    subprocess.run(script, check=True, env=path)


@pytest.mark.live
def test_main_ctrl_c_exits_with_130_without_traceback() -> None:
    command = [sys.executable, "-m", "bench", "doctor", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not psutil.Process(process.pid).children():  # until it examines packages in a child
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=20)
    assert (process.returncode, output) == (ExitCode.INTERRUPTED, "")
    assert "Traceback" not in errors


def test_main_ctrl_c_during_import_exits_with_130_without_traceback() -> None:
    script = """
import sys
from bench.__main__ import main

class Interrupted:
    def find_spec(name, *_):
        if name == "typer":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupted)
main()
"""
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (answer.returncode, answer.stdout, answer.stderr) == (ExitCode.INTERRUPTED, "", "")


@pytest.mark.parametrize(
    "arguments",
    [
        ["profile", "limits", "default", "--output", "-"],
        ["campaign", "export", "NAME", "--output", "-"],
        ["campaign", "new", "-"],
        ["nodes", "--dbc", "-"],
        ["export", "-", "--format", "csv"],
    ],
)
def test_cli_dash_as_file_is_refused(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = run(*arguments)
    assert (code, "found:    '-'" in err) == (ExitCode.BAD_INPUT, True)
    assert list(tmp_path.iterdir()) == []


def test_cli_path_of_file_called_dash_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run("nodes", "--dbc", "./-").code == 0
    assert (tmp_path / "-").is_file()


@pytest.mark.live
def test_main_closed_pipe_prints_no_error() -> None:
    command = f"{sys.executable} -m bench doctor --json | head -c 10"
    answer = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True)
    assert answer.stdout.startswith("{")
    assert answer.stderr == ""


@pytest.mark.parametrize(
    ("encoding", "written"),
    [
        ("ascii", "12.5 deg +- 3 um - ... <= ?"),
        ("iso8859-15", "12.5° ± 3 µm - ... <= ?"),
        ("cp437", "12.5° ± 3 µm - ... ≤ ?"),
        ("utf-8", "12.5° ± 3 µm – … ≤ \N{BLACK CHESS KING}"),
    ],
)
def test_accept_any_text_missing_characters_are_replaced(
    monkeypatch: pytest.MonkeyPatch, encoding: str, written: str
) -> None:
    kept = BytesIO()
    with TextIOWrapper(kept, encoding=encoding, write_through=True) as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        accept_any_text()
        print("12.5° ± 3 µm – … ≤ \N{BLACK CHESS KING}", end="")
        assert kept.getvalue().decode(encoding) == written


def test_accept_any_text_undecodable_file_name_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = BytesIO()
    with TextIOWrapper(kept, encoding="utf-8", write_through=True) as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        accept_any_text()
        print(b"a\xff.toml".decode("utf-8", "surrogateescape"), end="", file=sys.stderr)
        assert kept.getvalue() == b"a?.toml"
