"""`golfbench demo` as its user sees it: files, refusals, and Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numba
import pyarrow.parquet as pq
import pytest
from rerun.chunk import RrdReader

from bench.base.atomic_file import NotStored
from bench.base.errors import ExitCode
from bench.commands.campaign.demo import new_folder, run_demo
from bench.config import load_configuration
from bench.control.settings import EnvelopeSettings
from bench.records.shot.shot import COLUMNS, Shot, ShotStatus
from bench.records.telemetry.record_file import read_swing
from bench.swing.library import find_profile
from tests.bench.records.shot.read_shots import read_shot_table
from tests.conftest import Outcome, Run

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="a whole swing takes minutes without compilation"
)


def _demo(run: Run, output: Path | str, *options: str | Path) -> Outcome:
    return run(*options, "demo", "--engine", "compiled", "--swings", "2", "--output", output)


def _names(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def _figures(shots: list[Shot]) -> list[tuple[object, ...]]:
    return [tuple(getattr(s, name) for name in COLUMNS if name != "time_utc") for s in shots]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files of two swings."""
    folder: Path = tmp_path_factory.mktemp("demo")
    assert run_demo(load_configuration(), folder, 2, 1, live=False)
    return folder


def _swings(folder: Path) -> list[Path]:
    return sorted(folder.glob("bench/campaigns/*/swings/*.parquet"))


@pytest.mark.slow
def test_demo_writes_report_recording_table_database_and_swings(folder: Path) -> None:
    top = {path.name for path in folder.iterdir()}
    assert top == {"report.html", "demo.rrd", "shots.csv", "bench"}
    assert [path.name for path in _swings(folder)] == ["000001.parquet", "000002.parquet"]
    assert (folder / "bench" / "golfbench.sqlite").exists()


@pytest.mark.slow
def test_demo_shot_table_has_export_columns_and_both_balls(folder: Path) -> None:
    header = (folder / "shots.csv").read_text().splitlines()[0]
    assert header.split(",") == [*COLUMNS]
    shots = read_shot_table(folder / "shots.csv")
    assert [(s.shot, s.block, s.position) for s in shots] == [(1, 1, 1), (2, 1, 2)]
    assert {s.ball for s in shots} == {"tour", "range"}
    assert [(s.status, s.launch_source) for s in shots] == [(ShotStatus.VALID, "simulated")] * 2
    assert all(s.club_speed_mps is not None and s.club_speed_mps > 40 for s in shots)


@pytest.mark.slow
def test_demo_report_loads_no_external_file_and_names_variation(folder: Path) -> None:
    report = (folder / "report.html").read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", report)
    assert "Two balls" in report or "Tour ball against range ball" in report
    assert "supply pressure" in report


@pytest.mark.slow
def test_demo_recording_has_ball_speed_series(folder: Path) -> None:
    entities = {str(chunk.entity_path) for chunk in RrdReader(str(folder / "demo.rrd")).stream()}
    assert "/signals/ball_speed_mps" in entities


@pytest.mark.slow
def test_demo_swing_record_has_shot_and_varied_supply(folder: Path) -> None:
    cycles, metadata = read_swing(_swings(folder)[1])
    assert len(cycles) == pq.read_metadata(_swings(folder)[1]).num_rows > 1000
    assert metadata["shot"]["shot"] == 2
    supply = metadata["varied"]["supply_pressure"]
    assert 0 < abs(supply / load_configuration().plant.supply.pressure - 1) < 0.005


@pytest.mark.slow
def test_demo_same_seed_repeats_shots_and_other_seed_differs(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    configuration = load_configuration()
    again_in = tmp_path / "again [red]:car:"
    assert run_demo(configuration, again_in, 2, 1, live=False)
    again = read_shot_table(again_in / "shots.csv")
    assert _figures(again) == _figures(read_shot_table(folder / "shots.csv"))
    text = " ".join(capsys.readouterr().out.split())
    assert "2 simulated swings: driver" in text
    assert "Everything is simulated" in text
    assert "drawn from seed 1: supply pressure" in text
    for name in ("report.html", "demo.rrd", "shots.csv"):
        assert str(again_in / name) in text
    assert run_demo(configuration, tmp_path / "other", 2, 2, live=False)
    assert _figures(read_shot_table(tmp_path / "other" / "shots.csv")) != _figures(again)


@pytest.mark.slow
def test_demo_failed_swings_are_reported_with_reason(tmp_path: Path, run: Run) -> None:
    lame = tmp_path / "lame.toml"
    following = EnvelopeSettings().max_following_error
    tight = "\n".join(f"{name} = [0.001, 0.001, 0.001]" for name in following if name == "backswing")
    lame.write_text(f'base = "shipped"\n[envelope.max_following_error]\n{tight}\n')
    answer = _demo(run, tmp_path / "out", "--config", lame)
    assert (answer.code, "shots in a row not valid" in answer.words) == (ExitCode.REFUSED, True)
    shots = read_shot_table(tmp_path / "out" / "shots.csv")
    # The stopped club may sink against the ball: then it was hit, and is excluded.
    assert {shot.status for shot in shots} <= {ShotStatus.FAILED, ShotStatus.EXCLUDED}
    assert all("reference" in shot.reason for shot in shots)
    assert (tmp_path / "out" / "report.html").exists()


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ('[swing]\nprofile = "bad.toml"', "impact_time_s"),
        ("[envelope]\nmax_speed = [5.0, 6.0, 48.0]", "at most 5 rad/s"),
    ],
)
def test_demo_impossible_swing_is_refused_without_output(
    section: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.chdir(tmp_path)
    text = find_profile("default").read_text()
    Path("bad.toml").write_text(re.sub(r"(?m)^impact_time_s = .*$", "impact_time_s = nan", text))
    Path("own.toml").write_text(f'base = "shipped"\n{section}\n')
    answer = _demo(run, "out", "--config", "own.toml")
    assert (answer.code, words in answer.err) == (ExitCode.BAD_INPUT, True)
    assert _names(tmp_path) == {"bad.toml", "own.toml"}


def test_demo_output_folder_in_use_is_refused_unchanged(folder: Path, run: Run) -> None:
    before = _names(folder)
    answer = _demo(run, folder)
    assert (answer.code, "--output" in answer.err) == (ExitCode.REFUSED, True)
    assert _names(folder) == before


def test_demo_output_folder_not_creatable_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(NotStored, match=r"--output"):
        run_demo(load_configuration(), tmp_path / "file" / "below", 1, 1, live=False)


def test_demo_output_folder_of_other_demo_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bench").mkdir()
    monkeypatch.setattr(Path, "iterdir", lambda _: iter(()))  # as the other demo found the folder
    with pytest.raises(NotStored, match="File exists"):
        new_folder(tmp_path, load_configuration(), datetime.now(UTC))


@pytest.mark.live
@pytest.mark.parametrize(
    ("number", "code", "name"),
    [
        (signal.SIGINT, ExitCode.INTERRUPTED, "Ctrl-C"),
        (signal.SIGTERM, ExitCode.TERMINATED, "SIGTERM"),
    ],
)
def test_demo_signal_exits_with_code_and_keeps_complete_records(
    tmp_path: Path, number: signal.Signals, code: ExitCode, name: str
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "bench", "demo", "--engine", "compiled", "--swings", "200"]
    command += ["--output", str(out)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        limit = time.monotonic() + 100
        while len(_swings(out)) < 2:
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < limit
            time.sleep(0.01)
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
    assert process.returncode == code
    assert "Traceback" not in errors
    assert f"stopped by {name}" in output
    shots = read_shot_table(out / "shots.csv")
    assert 2 <= len(shots) < 200
    assert not (out / "report.html").exists()
    assert [int(path.stem) for path in _swings(out)][: len(shots)] == [shot.shot for shot in shots]
    for shot in shots[:3]:
        assert read_swing(_swings(out)[shot.shot - 1])[1]["shot"]["ball"] == shot.ball
