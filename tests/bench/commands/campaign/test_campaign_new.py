"""golfbench campaign new: a commented plan that the bench takes, or all that is missing."""

from __future__ import annotations

import errno
import json
import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError
from bench.commands.cli import app
from tests.sampling import release_except

TWO = ("--compare", "ball", "--ball", "tour", "--ball", "range", "--club", "driver")
SIZES = ("--difference", "2", "--sd", "1")
Call = Callable[..., Result]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Call:
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str, answers: str | None = None) -> Result:
        return CliRunner().invoke(app, ["campaign", *arguments], input=answers)

    return run


def test_campaign_new_writes_commented_plan_with_computed_blocks(call: Call, tmp_path: Path) -> None:
    done = call("new", "two-balls.toml", *TWO, *SIZES)
    assert done.exit_code == 0, done.output
    text = (tmp_path / "two-balls.toml").read_text()
    plan = tomllib.loads(text)
    assert plan["campaign"] == {"name": "two-balls", "title": "Two balls"}
    assert plan["design"]["blocks"] == 7
    assert "# worth finding, same unit" in text
    assert "14 shots, about 11 min" in done.stdout
    assert call("check", "two-balls.toml").exit_code == 0


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--control", "range")], ids=" ".join)
@pytest.mark.parametrize("difference", release_except({"1.5"}, ["1", "1.5", "2.74"]))
def test_campaign_new_computed_blocks_are_fewest_for_power(
    call: Call, tmp_path: Path, options: tuple[str, ...], difference: str
) -> None:
    asked = (*TWO, *options, "--difference", difference, "--sd", "1")
    assert call("new", "a.toml", *asked).exit_code == 0
    blocks = int(tomllib.loads((tmp_path / "a.toml").read_text())["design"]["blocks"])
    chances = []
    for number in (blocks - 1, blocks):
        assert call("new", f"{number}.toml", *asked, "--blocks", str(number)).exit_code == 0
        found = json.loads(call("check", f"{number}.toml", "--json").stdout)["outlook"]["power"]
        chances.append(found or 0.0)
    assert chances[0] < 0.8 <= chances[1]


def test_campaign_new_control_shots_reduce_reported_ball_count(call: Call) -> None:
    blocks = ("--blocks", "10")
    assert "judged by its balls: 10 of each" in call("new", "a.toml", *TWO, *SIZES, *blocks).stdout
    controlled = call("new", "b.toml", *TWO, *SIZES, *blocks, "--control", "range")
    assert "judged by its balls: 6 of each" in controlled.stdout


def test_campaign_new_clubs_writes_swing_of_each_club(call: Call, tmp_path: Path) -> None:
    bag = ("--config", "bag", "campaign", "new", "bag.toml", "--compare", "club", "--ball", "tour", *SIZES)
    clubs = [f"--club={club}" for club in ("driver", "iron7", "wedge56")]
    done = CliRunner().invoke(app, [*bag, *clubs])
    assert done.exit_code == 0, done.output
    plan = tomllib.loads((tmp_path / "bag.toml").read_text())
    assert plan["swings"] == {"default": {"iron7": "iron7-78mph", "wedge56": "wedge56-55yd"}}
    assert CliRunner().invoke(app, ["--config", "bag", "campaign", "check", "bag.toml"]).exit_code == 0


def test_campaign_new_club_without_swing_keeps_file_and_reports_club(call: Call, tmp_path: Path) -> None:
    error = call("new", "old.toml", *TWO, "--club", "thesis", *SIZES).exception
    assert isinstance(error, ExceptionGroup)
    (told,) = error.exceptions
    assert isinstance(told, BenchError)
    assert told.expected.startswith("one for 'thesis'")
    assert (tmp_path / "old.toml").exists()


def test_campaign_new_without_terminal_lists_missing_options(call: Call, tmp_path: Path) -> None:
    error = call("new", "two.toml", "--club", "driver").exception
    assert isinstance(error, BenchError)
    assert error.found == "no --compare, --ball, --difference, --sd"
    options = ("--compare", "swing", "--ball", "tour", "--club", "driver", "--sd", "1", "--difference", "1")
    error = call("new", "two.toml", *options).exception
    assert isinstance(error, BenchError)
    assert error.found == "no --swing"
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_zero_difference_reports_key(call: Call) -> None:
    error = call("new", "two.toml", *TWO, "--difference", "0", "--sd", "1").exception
    assert isinstance(error, ExceptionGroup)
    (told,) = error.exceptions
    assert isinstance(told, BenchError)
    assert told.location.endswith("two.toml: analysis.target_difference")
    assert told.found == "0.0"


def test_campaign_new_wrong_answer_repeats_question(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.commands.campaign.campaign_new.at_terminal", lambda: True)
    done = call("new", "two.toml", answers="bal\nball\ntour, range\ndriver\nx\n0,5\n2\n")
    assert done.exit_code == 0, done.output
    plan = tomllib.loads((tmp_path / "two.toml").read_text())
    assert plan["design"]["balls"] == ["tour", "range"]
    assert plan["analysis"]["expected_sd"] == 0.5
    assert "found 'bal', expected one of ball, club, swing" in done.output


@pytest.mark.parametrize("name", ["Two.toml", "two", "two balls.toml", f"{'a' * 42}.toml"])
def test_campaign_new_invalid_file_name_is_refused(call: Call, tmp_path: Path, name: str) -> None:
    error = call("new", name, *TWO, *SIZES).exception
    assert isinstance(error, BenchError)
    assert "two-balls.toml" in error.action
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_existing_file_is_refused_unchanged(call: Call, tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text("kept")
    assert isinstance(call("new", "two.toml", *TWO, *SIZES).exception, BenchError)
    assert (tmp_path / "two.toml").read_text() == "kept"


def test_campaign_new_full_disk_leaves_no_file(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    error = call("new", "two.toml", *TWO, *SIZES).exception
    assert isinstance(error, NotStored)
    assert error.location == "two.toml"
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_unknown_names_keeps_file_and_reports_each(call: Call, tmp_path: Path) -> None:
    error = call("new", "two.toml", *TWO, "--ball", "trou", "--club", "drivr", *SIZES).exception
    assert isinstance(error, ExceptionGroup)
    told = " ".join(map(str, error.exceptions))
    assert "trou" in told
    assert "drivr" in told
    assert (tmp_path / "two.toml").exists()
