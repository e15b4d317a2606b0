"""Rerun's own program: its listening address, its data, and the scene of a late viewer."""

from __future__ import annotations

import ipaddress
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import psutil
import pytest
import rerun as rr

from bench.base.address import free_port
from bench.base.errors import BenchError
from bench.viewer import window as window_module
from bench.viewer._scene import Scene, bench_time
from bench.viewer.blueprint import live_blueprint
from bench.viewer.window import LOOPBACK, RerunWindow, quiet_environment, rerun_program
from sim.plant import PlantParameters
from tests.bench.records.telemetry.read_recording import Recording

HURRY = 30.0


def listening(pid: int) -> list[str]:
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    return [
        c.laddr.ip
        for process in family
        for c in process.net_connections("inet")
        if c.status == psutil.CONN_LISTEN
    ]


@pytest.mark.live
def test_rerun_window_web_listens_on_loopback_only() -> None:
    with RerunWindow(web=True) as window:
        stream = rr.RecordingStream("golfbench")
        stream.set_sinks(rr.GrpcSink(window.url), default_blueprint=live_blueprint())
        stream.log("x", rr.Scalars(1.0))
        stream.flush(timeout_sec=HURRY)
        addresses = listening(window.pid) + listening(os.getpid())
        assert window.page is not None
        with urlopen(window.page, timeout=HURRY) as page:  # noqa: S310 - its own page
            assert page.status == 200
            policy = page.headers["Content-Security-Policy"]
            assert b"<canvas" in page.read()
        stream.disconnect()
    assert len(addresses) >= 2
    assert all(ipaddress.ip_address(address).is_loopback for address in addresses)
    assert not window.alive
    places = [source for rule in policy.split("; ") for source in rule.split()[1:] if ":" in source]
    assert set(places) == {"data:", "blob:", f"http://127.0.0.1:{window.port}"}
    assert policy.startswith("default-src 'none'; ")


@pytest.mark.live
def test_rerun_window_late_viewer_receives_static_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(window_module, "MEMORY", "10MB")  # all but the scene is dropped
    file, rows = tmp_path / "late.rrd", 20_000
    with RerunWindow(web=True) as window:
        stream = rr.RecordingStream("golfbench")
        stream.set_sinks(rr.GrpcSink(window.url), default_blueprint=live_blueprint())
        scene, random = Scene(stream, PlantParameters()), np.random.default_rng(1)
        for part in range(60):
            at = 1e-3 * (part * rows + np.arange(rows, dtype=np.float64))
            scene.scalars("signals/valve/applied", bench_time(at), random.random((rows, 1)))
        stream.flush(timeout_sec=HURRY)
        command = [str(rerun_program()), window.url, "--save", str(file), "--bind", LOOPBACK]
        late = subprocess.Popen(
            [*command, "--port", str(free_port())],
            env=quiet_environment(tmp_path, os.environ),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            recording = wait_for_end_of(file, last=60 * rows * 1e-3)
        finally:
            late.terminate()
            late.wait()
            stream.disconnect()
    assert {"/scene/robot/club/drawn", "/scene/ball", "/range/grass", "/signals/phase"} <= recording.static
    at, _ = recording.read("/signals/valve/applied", "Scalars:scalars")
    assert len(at) < 60 * rows  # 10 MB do not hold them all


def wait_for_end_of(file: Path, last: float) -> Recording:
    deadline = time.monotonic() + HURRY
    while True:
        try:
            recording = Recording(file)
            at, _ = recording.read("/signals/valve/applied", "Scalars:scalars")
            if at[-1] > last - 0.01:
                return recording
        except (OSError, ValueError, RuntimeError):
            pass  # not yet there, or cut in a message
        assert time.monotonic() < deadline, "the newest data never came"
        time.sleep(0.2)


@pytest.mark.live
def test_quiet_environment_turns_analytics_off(tmp_path: Path) -> None:
    quiet = quiet_environment(tmp_path, {**os.environ, "FORCE_RERUN_ANALYTICS": "1"})
    assert "FORCE_RERUN_ANALYTICS" not in quiet
    assert {quiet[name] for name in ("ALL_PROXY", "https_proxy", "HTTP_PROXY")} == {"http://127.0.0.1:9"}
    assert quiet["NO_PROXY"] == "127.0.0.1"
    shown = subprocess.run(
        [str(rerun_program()), "analytics", "config"], env=quiet, capture_output=True, check=True, text=True
    ).stdout
    settings = json.loads(shown)
    assert settings["analytics_enabled"] is False
    assert Path(settings["config_file_path"]).is_relative_to(tmp_path)
    assert Path(settings["data_dir_path"]).is_relative_to(tmp_path)


def test_rerun_window_analytics_enabled_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "rerun"
    settings = '{"analytics_enabled": true}'
    folder = '"$XDG_CONFIG_HOME/rerun"'
    program.write_text(f"#!/bin/sh\nmkdir -p {folder}\necho '{settings}' > {folder}/analytics.json\n")
    program.chmod(0o755)
    monkeypatch.setattr("bench.viewer.window.rerun_program", lambda: program)
    with pytest.raises(BenchError, match="analytics_enabled True"):
        RerunWindow(web=True)


@pytest.mark.live
def test_recording_stream_opens_no_connection(tmp_path: Path) -> None:
    code = (
        "import rerun as rr, psutil, sys\n"
        "s = rr.RecordingStream('golfbench'); s.set_sinks(rr.FileSink(sys.argv[1]))\n"
        "s.log('x', rr.Scalars(1.0)); s.flush(timeout_sec=10)\n"
        "print(psutil.Process().net_connections('inet'))\n"
        "s.disconnect()\n"
    )
    home = {"XDG_CONFIG_HOME": str(tmp_path / "c"), "XDG_DATA_HOME": str(tmp_path / "d")}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "x.rrd")],
        env={**os.environ, **home},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"
    assert not (tmp_path / "d" / "rerun" / "analytics").exists()


@pytest.mark.live
def test_rerun_window_dead_viewer_reports_last_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "rerun"
    program.write_text("#!/bin/sh\necho no graphics here >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr("bench.viewer.window.rerun_program", lambda: program)
    monkeypatch.setattr("bench.viewer.window.quiet_environment", lambda folder, e: dict(e))
    with pytest.raises(BenchError, match="ended with 3: no graphics here"):
        RerunWindow(web=True)


def test_rerun_window_without_display_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(BenchError, match="--web"):
        RerunWindow(web=False)


@pytest.mark.live
def test_rerun_window_closed_viewer_is_not_alive() -> None:
    with RerunWindow(web=True) as window:
        assert window.alive
        os.kill(window.pid, signal.SIGTERM)
        deadline = time.monotonic() + HURRY
        while window.alive:
            assert time.monotonic() < deadline
            time.sleep(0.02)
