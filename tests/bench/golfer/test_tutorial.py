"""Files that the tutorial prints are accepted; its commands are checked as those of all documents are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bench.campaign.plan.plan_file import load_plan
from bench.config import load_configuration

TUTORIAL = Path(__file__).resolve().parents[3] / "bench/manual/test_engineer/golfer_tutorial.md"


def test_golfer_tutorial_configuration_and_plan_load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    configuration, plan = re.findall(r"```toml\n(.*?)```", TUTORIAL.read_text(), flags=re.DOTALL)
    Path("config.toml").write_text(configuration)
    Path("anna-balls.toml").write_text(plan)
    loaded = load_plan(Path("anna-balls.toml"), load_configuration(Path("config.toml")))
    assert loaded.design.swings == ("anna.toml",)
    assert f"--profile {loaded.design.swings[0]}" in TUTORIAL.read_text()
