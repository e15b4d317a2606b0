"""golfbench campaign: a simulated campaign from its plan to its report, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from bench.campaign.shot_table import read_shot_table
from bench.cli import app
from bench.errors import ExitCode, Refused

Call = Callable[..., Result]

PLAN = """
[campaign]
name = "short"
title = "Short"
[design]
balls = ["tour", "range"]
blocks = 2
[control]
ball = "tour"
[warm_up]
window = 2
at_most = 4
[simulation]
missing_launch = [5]
feeder_jam = [7]
door_opened = [9]
"""


@pytest.fixture
def call(tmp_path: Path) -> Call:
    (tmp_path / "bench.toml").write_text(f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path / "data"}"\n')
    (tmp_path / "short.toml").write_text(PLAN)

    def run(*arguments: str | Path) -> Result:
        options = ["--config", str(tmp_path / "bench.toml"), "campaign", *map(str, arguments)]
        return CliRunner().invoke(app, options)

    return run


def test_a_simulated_campaign_from_plan_to_report(call: Call, tmp_path: Path) -> None:
    baseline = tmp_path / "baseline.toml"
    baseline.write_text('[[figure]]\npath = "sections.0.levels.tour.spread.mean"\nlow = 150\nhigh = 250\n')
    outputs = ("--report", tmp_path / "r.html", "--junit", tmp_path / "j.xml", "--check", baseline, "--json")
    done = call("run", tmp_path / "short.toml", "--sim", *outputs)
    assert done.exit_code == ExitCode.OK, done.output
    told = json.loads(done.stdout)
    assert told["state"] == "finished"
    assert told["baseline"][0]["holds"]
    assert told["findings"]["by_status"] == {"valid": 12, "excluded": 1, "failed": 1}
    assert "Short" in (tmp_path / "r.html").read_text()
    assert (tmp_path / "j.xml").read_text().count("<testcase") == 10 + 2

    listed = json.loads(call("list", "--json").stdout)
    assert [entry["state"] for entry in listed] == ["finished"]
    campaign = listed[0]["id"]
    call("export", campaign, "--output", tmp_path / "shots.csv")
    shots = read_shot_table(tmp_path / "shots.csv")
    assert [shot.reason for shot in shots if shot.reason] == [
        "the launch monitor saw no ball", "feeder jam: no ball came",
    ]  # fmt: skip
    assert shots[4].club_speed_mps is not None
    assert shots[4].carry_m is None
    assert len(list((tmp_path / "data" / "campaigns" / campaign / "swings").glob("*.parquet"))) == 13
    report = call("report", campaign)
    assert "guard opened" in Path(report.stdout.strip()).read_text()
    refused = call("resume", campaign)
    assert isinstance(refused.exception, Refused)

    baseline.write_text('[[figure]]\npath = "sections.0.levels.tour.spread.mean"\nlow = 250\n')
    again = call("run", tmp_path / "short.toml", "--sim", "--check", baseline)
    assert again.exit_code == ExitCode.REFUSED
    assert "OUTSIDE" in again.stdout
    second = json.loads(call("list", "--json").stdout)[0]["id"]
    assert second != campaign
    assert call("export", second).stdout_bytes == (tmp_path / "shots.csv").read_bytes()


def test_a_campaign_without_a_bench_or_with_a_wrong_baseline_begins_nothing(
    call: Call, tmp_path: Path
) -> None:
    (tmp_path / "wrong.toml").write_text("x = 1")
    done = call("run", tmp_path / "short.toml", "--sim", "--check", tmp_path / "wrong.toml")
    assert done.exception is not None
    assert call("list").stdout.strip() == "No campaigns yet."
    assert call("report", "nothing").exception is not None


@pytest.mark.parametrize("verb", ["pause", "stop", "abort", "resume", "export", "report"])
def test_an_unknown_campaign_is_told(call: Call, verb: str) -> None:
    assert "no such campaign" in str(call(verb, "xyz").exception)


def test_the_gate_of_ci_holds_and_sees_a_club_that_rebounds_less(tmp_path: Path) -> None:
    gate = Path(__file__).parents[3] / ".github"
    assert "--check .github/two-balls.baseline.toml" in (gate / "workflows" / "check.yml").read_text()
    for restitution, expected in ((0.83, ExitCode.OK), (0.82, ExitCode.REFUSED)):
        (tmp_path / "bench.toml").write_text(
            f'base = "shipped"\n[bench]\ndata_dir = "{tmp_path / "data"}"\n'
            f"[clubs.driver]\nrestitution = {restitution}\n"
        )
        options = ["--config", str(tmp_path / "bench.toml"), "campaign", "run", "two-balls", "--sim"]
        done = CliRunner().invoke(app, [*options, "--check", str(gate / "two-balls.baseline.toml")])
        assert done.exit_code == expected, done.output
        assert ("OUTSIDE" in done.stdout) == (expected is ExitCode.REFUSED)
