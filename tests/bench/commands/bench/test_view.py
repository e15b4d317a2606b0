from __future__ import annotations

import ipaddress
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import psutil
import pytest

from bench.base.errors import ExitCode
from bench.base.lifecycle import State
from bench.records.telemetry.record_file import write_swing
from tests.bench.golfer.synthetic import golfer_swing
from tests.bench.records.telemetry.fake_bench import BENCH, fake_bench, loopback
from tests.bench.records.telemetry.read_recording import Recording
from tests.conftest import Run

Cycles = np.ndarray[Any, Any]
HURRY = 60.0


@pytest.fixture
def records(tmp_path: Path, make_swing: Callable[[int], Cycles]) -> Path:
    folder = tmp_path / "swings"
    folder.mkdir()
    for number in (1, 2):
        write_swing(folder / f"{number:03d}.parquet", make_swing(number), {"number": number})
    return folder


def test_view_shot_save_writes_recorded_angles(
    records: Path, tmp_path: Path, make_swing: Callable[[int], Cycles], run: Run
) -> None:
    file = tmp_path / "shot.rrd"
    code, out, _ = run("view", "--shot", records / "002.parquet", "--save", file)
    assert (code, str(file) in out) == (ExitCode.OK, True)
    _, angles = Recording(file).read("/signals/angle_deg/actual", "Scalars:scalars")
    assert np.array_equal(angles, np.degrees(make_swing(2)["angle"]))


def test_view_campaign_save_writes_all_shots_and_tables(records: Path, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "series.rrd"
    assert run("view", "--campaign", records, "--save", file).code == ExitCode.OK
    recording = Recording(file)
    assert len(recording.read("/signals/valve/applied", "Scalars:scalars")[0]) == 4200
    _, tables = recording.read("/shots", "TextDocument:text")
    assert len(tables) == 2


def test_view_golfer_needs_swing_with_impact(
    records: Path,
    tmp_path: Path,
    make_swing: Callable[[int], Cycles],
    monkeypatch: pytest.MonkeyPatch,
    run: Run,
) -> None:
    file, shot = tmp_path / "two.rrd", records / "002.parquet"
    monkeypatch.setattr("bench.golfer.golfer_file.load_golfer", lambda _: golfer_swing())
    asked = ["view", "--golfer", "anna.golfer.toml", "--save", file]
    assert run(*asked, "--shot", shot).code == ExitCode.OK
    assert "/scene/golfer/club" in Recording(file).entities
    write_swing(shot, make_swing(2)[:300], {"number": 2})
    answer = run(*asked, "--shot", shot)
    assert answer.code == ExitCode.BAD_INPUT
    assert "no recorded swing reaches the ball" in answer.words


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--shot", "x.parquet", "--campaign", "y"], "--shot and --campaign"),
        (["--save", "x.csv"], ".rrd"),
        (["--shot", "absent.parquet"], "no such file"),
        (["--campaign", "absent"], "no such file"),
        (["--golfer", "anna.golfer.toml"], "without --shot or --campaign"),
    ],
)
def test_view_invalid_options_are_refused(options: list[str], words: str, run: Run) -> None:
    answer = run("view", *options)
    assert (answer.code, words in answer.words) == (ExitCode.BAD_INPUT, True)


def configuration(tmp_path: Path, endpoint: str) -> Path:
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "shipped"\n[bench]\nid = "{BENCH}"\n[network]\nendpoint = "{endpoint}"\n')
    return file


def test_view_without_bench_exits_no_answer(tmp_path: Path, run: Run) -> None:
    file = configuration(tmp_path, loopback().endpoint)
    code, _, err = run("--config", file, "view", "--save", tmp_path / "x.rrd")
    assert (code, "denied or not running" in err) == (ExitCode.NO_ANSWER, True)


@pytest.mark.live
def test_view_web_shows_live_bench_and_listens_on_loopback_only(
    tmp_path: Path, make_day: Callable[..., Cycles]
) -> None:
    network, file, day = loopback(), tmp_path / "live.rrd", make_day([(State.READY, 20)])
    bench_file = str(configuration(tmp_path, network.endpoint))
    command = [sys.executable, "-m", "bench", "--config", bench_file, "view"]
    with fake_bench(network) as bench:
        viewer = subprocess.Popen(
            [*command, "--web", "--save", str(file)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            assert viewer.stdout is not None
            page = viewer.stdout.readline().strip()
            assert re.fullmatch(r"http://127\.0\.0\.1:[0-9]+/\?url=.*", page)
            with urlopen(page, timeout=HURRY) as answer:  # noqa: S310 - its own page
                assert answer.status == 200
            deadline = time.monotonic() + HURRY
            while not file.exists() or file.stat().st_size < 200_000:
                assert viewer.poll() is None
                assert time.monotonic() < deadline
                bench.send(day)
                day["tick"] += 20
                day["time"] += 20 / 1024
                time.sleep(0.01)
            family = [psutil.Process(viewer.pid), *psutil.Process(viewer.pid).children(recursive=True)]
            ports = [c for p in family for c in p.net_connections("inet") if c.status == psutil.CONN_LISTEN]
            assert len(ports) >= 2
            assert all(ipaddress.ip_address(c.laddr.ip).is_loopback for c in ports)
            os.kill(viewer.pid, signal.SIGTERM)
            _, told = viewer.communicate(timeout=HURRY)
        finally:
            if viewer.poll() is None:
                viewer.kill()
                viewer.communicate()
    assert viewer.returncode == ExitCode.OK
    assert " 0 lost, 0 cycles lost in the ring" in told
    assert "age at the subscriber p50" in told
    at, _ = Recording(file).read("/signals/valve/applied", "Scalars:scalars")
    assert np.allclose(np.diff(at), 1 / 1024, atol=2e-9)
