"""A robot is held to its rules whichever option names the driver."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.base.errors import ExitCode
from bench.commands.cli import main


@pytest.mark.parametrize("driver", ["canopen", "daq"])
def test_run_command_hardware_driver_option_requires_hardware_settings(
    driver: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path}"\n', encoding="utf-8")
    with pytest.raises(SystemExit) as ended:
        main(["--config", str(file), "run", "--driver", driver])
    said = capsys.readouterr().err
    assert ended.value.code == ExitCode.BAD_INPUT
    assert "mine.toml: lifecycle.local_reset" in said
    assert "mine.toml: loop.realtime" in said
