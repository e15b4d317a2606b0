from __future__ import annotations

import json
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.supervisor.status import RunMarker


def run(folder: Path, *, clean: bool, stop: dict[str, str] | None = None, fatal: bool = False) -> RunMarker:
    marker = RunMarker(folder, "b1")
    marker.begin(1234, "2026-01-02T03:04:05+00:00")
    marker.note_state("SWINGING", "TOP")
    if stop is not None:
        marker.note_stop(stop, fatal=fatal)
    marker.end(clean=clean)
    return marker


def reread(folder: Path) -> RunMarker:
    marker = RunMarker(folder, "b1")
    marker.end(clean=False)
    return marker


def test_run_marker_first_run_has_no_last_stop(tmp_path: Path) -> None:
    first = run(tmp_path, clean=True)
    assert (first.was_killed, first.last_stop) == (False, None)


def test_run_marker_clean_end_reports_no_kill(tmp_path: Path) -> None:
    run(tmp_path, clean=True, stop={"cause": "GUARD"})
    after = reread(tmp_path)
    assert (after.was_killed, after.last_stop) == (False, {"cause": "GUARD"})


def test_run_marker_unclean_end_reports_restart(tmp_path: Path) -> None:
    run(tmp_path, clean=False)
    after = reread(tmp_path)
    assert after.was_killed
    assert after.last_stop is not None
    assert after.last_stop["cause"] == "RESTART"
    assert "supervisor was killed" in after.last_stop["text"]
    assert (after.last_stop["state"], after.last_stop["phase"]) == ("SWINGING", "TOP")


def test_run_marker_fatal_stop_is_kept_across_runs(tmp_path: Path) -> None:
    stop = {"cause": "RESTART", "text": "the loop killed by SIGKILL in phase DOWNSWING"}
    run(tmp_path, clean=False, stop=stop, fatal=True)
    after = run(tmp_path, clean=True)
    assert (after.was_killed, after.last_stop) == (True, stop)
    assert reread(tmp_path).last_stop == stop


@pytest.mark.parametrize("garbage", ["", "{", "[]", "\0" * 100, '{"running": {"a": 1}}'])
def test_run_marker_invalid_file_is_replaced(tmp_path: Path, garbage: str) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "b1.json").write_text(garbage)
    reread(tmp_path)
    run(tmp_path, clean=True)
    assert json.loads((tmp_path / "state" / "b1.json").read_text())["running"] is False


def test_run_marker_unusable_state_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    with pytest.raises(BenchError, match="state"):
        RunMarker(tmp_path, "b1")
