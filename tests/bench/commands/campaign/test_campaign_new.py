"""golfbench campaign new: a commented plan that the bench takes, or all that is missing."""

from __future__ import annotations

import errno
import json
import os
import tomllib
from functools import partial
from io import StringIO
from pathlib import Path

import pytest

from bench.base.errors import ExitCode
from tests.conftest import Run
from tests.sampling import release_except

TWO = ("--compare", "ball", "--ball", "tour", "--ball", "range", "--club", "driver")
SIZES = ("--difference", "2", "--sd", "1")


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> Run:
    monkeypatch.chdir(tmp_path)
    return partial(run, "campaign")


def test_campaign_new_writes_commented_plan_with_computed_blocks(call: Run, tmp_path: Path) -> None:
    done = call("new", "two-balls.toml", *TWO, *SIZES)
    assert done.code == 0, done.err
    text = (tmp_path / "two-balls.toml").read_text()
    plan = tomllib.loads(text)
    assert plan["campaign"] == {"name": "two-balls", "title": "Two balls"}
    assert plan["design"]["blocks"] == 7
    assert "# worth finding, same unit" in text
    assert "14 shots, about 11 min" in done.out
    assert call("check", "two-balls.toml").code == 0


@pytest.mark.usefixtures("call")
@pytest.mark.parametrize("monitored", [False, True])
def test_campaign_new_on_machine_reports_refusals(run: Run, tmp_path: Path, monitored: bool) -> None:
    bench = tmp_path / "bench.toml"
    monitor = "[launch_monitor]\nenabled = true\n" * monitored
    bench.write_text(f'base = "shipped"\n[driver]\nname = "mock"\n{monitor}')
    done = run("--config", bench, "campaign", "new", "a.toml", *TWO, *SIZES)
    assert done.code == 0, done.err
    assert ("[launch_monitor] enabled = true" in done.err) is not monitored
    assert "magazine of at least 1" in done.err


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), ("--control", "range")], ids=" ".join)
@pytest.mark.parametrize("difference", release_except({"1.5"}, ["1", "1.5", "2.74"]))
def test_campaign_new_computed_blocks_are_fewest_for_power(
    call: Run, tmp_path: Path, options: tuple[str, ...], difference: str
) -> None:
    asked = (*TWO, *options, "--difference", difference, "--sd", "1")
    assert call("new", "a.toml", *asked).code == 0
    blocks = int(tomllib.loads((tmp_path / "a.toml").read_text())["design"]["blocks"])
    chances = []
    for number in (blocks - 1, blocks):
        assert call("new", f"{number}.toml", *asked, "--blocks", number).code == 0
        found = json.loads(call("check", f"{number}.toml", "--json").out)["outlook"]["power"]
        chances.append(found or 0.0)
    assert chances[0] < 0.8 <= chances[1]


def test_campaign_new_control_shots_reduce_reported_ball_count(call: Run) -> None:
    blocks = ("--blocks", "10")
    assert "judged by its balls: 10 of each" in call("new", "a.toml", *TWO, *SIZES, *blocks).out
    controlled = call("new", "b.toml", *TWO, *SIZES, *blocks, "--control", "range")
    assert "judged by its balls: 6 of each" in controlled.out


@pytest.mark.usefixtures("call")
def test_campaign_new_clubs_writes_swing_of_each_club(run: Run, tmp_path: Path) -> None:
    bag = ("--config", "bag", "campaign", "new", "bag.toml", "--compare", "club", "--ball", "tour", *SIZES)
    clubs = [f"--club={club}" for club in ("driver", "iron7", "wedge56")]
    done = run(*bag, *clubs)
    assert done.code == 0, done.err
    plan = tomllib.loads((tmp_path / "bag.toml").read_text())
    assert plan["swings"] == {"default": {"iron7": "iron7-78mph", "wedge56": "wedge56-55yd"}}
    assert run("--config", "bag", "campaign", "check", "bag.toml").code == 0


def test_campaign_new_club_without_swing_keeps_file_and_reports_club(call: Run, tmp_path: Path) -> None:
    assert "expected: one for 'thesis'" in call("new", "old.toml", *TWO, "--club", "thesis", *SIZES).err
    assert (tmp_path / "old.toml").exists()


def test_campaign_new_without_terminal_lists_missing_options(call: Run, tmp_path: Path) -> None:
    missing = "found:    no --compare, --ball, --difference, --sd\n"
    assert missing in call("new", "two.toml", "--club", "driver").err
    options = ("--compare", "swing", "--ball", "tour", "--club", "driver", "--sd", "1", "--difference", "1")
    assert "found:    no --swing\n" in call("new", "two.toml", *options).err
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_zero_difference_reports_key(call: Run) -> None:
    error = call("new", "two.toml", *TWO, "--difference", "0", "--sd", "1").err
    assert "two.toml: analysis.target_difference\n  found:    0.0\n" in error


def test_campaign_new_wrong_answer_repeats_question(
    call: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.commands.campaign.campaign_new.at_terminal", lambda: True)
    monkeypatch.setattr("sys.stdin", StringIO("bal\nball\ntour, range\ndriver\nx\n0,5\n2\n"))
    done = call("new", "two.toml")
    assert done.code == 0, done.err
    plan = tomllib.loads((tmp_path / "two.toml").read_text())
    assert plan["design"]["balls"] == ["tour", "range"]
    assert plan["analysis"]["expected_sd"] == 0.5
    assert "found 'bal', expected one of ball, club, swing" in done.err


@pytest.mark.parametrize("name", ["Two.toml", "two", "two balls.toml", f"{'a' * 42}.toml"])
def test_campaign_new_invalid_file_name_is_refused(call: Run, tmp_path: Path, name: str) -> None:
    assert "action:   Name the file such as two-balls.toml." in call("new", name, *TWO, *SIZES).err
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_existing_file_is_refused_unchanged(call: Run, tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text("kept")
    assert call("new", "two.toml", *TWO, *SIZES).code == ExitCode.BAD_INPUT
    assert (tmp_path / "two.toml").read_text() == "kept"


def test_campaign_new_full_disk_leaves_no_file(
    call: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    code, _, err = call("new", "two.toml", *TWO, *SIZES)
    assert (code, err.startswith("error: two.toml\n")) == (ExitCode.FILE, True)
    assert list(tmp_path.iterdir()) == []


def test_campaign_new_unknown_names_keeps_file_and_reports_each(call: Run, tmp_path: Path) -> None:
    told = call("new", "two.toml", *TWO, "--ball", "trou", "--club", "drivr", *SIZES).err
    assert "trou" in told
    assert "drivr" in told
    assert (tmp_path / "two.toml").exists()
