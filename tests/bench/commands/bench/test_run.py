"""`golfbench run` holds a robot to its rules; `golfbench check` reports the model-based check."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.base.errors import ExitCode
from tests.conftest import Run


@pytest.mark.parametrize("driver", ["canopen", "daq"])
def test_run_command_hardware_driver_option_requires_hardware_settings(
    driver: str, tmp_path: Path, run: Run
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path}"\n', encoding="utf-8")
    code, _, said = run("--config", file, "run", "--driver", driver)
    assert code == ExitCode.BAD_INPUT
    assert "mine.toml: lifecycle.local_reset" in said
    assert "mine.toml: loop.realtime" in said


@pytest.mark.parametrize(("setting", "off"), [("simulated", False), ("off", True)])
def test_check_reports_disabled_model_based_check(setting: str, off: bool, tmp_path: Path, run: Run) -> None:
    file = tmp_path / "mine.toml"
    text = f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path}"\n[envelope.model]\ncheck = "{setting}"\n'
    file.write_text(text, encoding="utf-8")
    answer = run("--config", file, "check")
    said = answer.words
    assert answer.code == 0, said
    assert ("warning: the model-based check is off" in said) is off
    assert ("limits of the model-based check" in said) is not off


def test_check_path_with_brackets_is_printed_literally(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b[old].toml").write_text('base = "shipped"\n[bench]\ndata_dir = "d[new]:car:"\n')
    answer = run("--config", "b[old].toml", "check")
    said = answer.words
    assert answer.code == 0, said
    assert "configuration b[old].toml over" in said
    assert "records in d[new]:car:" in said
