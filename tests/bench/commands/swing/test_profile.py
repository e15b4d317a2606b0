"""The commands on configuration and profiles, as a user types them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError, ExitCode
from bench.commands.swing import learn
from bench.config import load_configuration
from bench.design.designer import DesignFailed
from bench.golfer.comparison import compare_motions, golfer_motion, robot_motion
from bench.swing import library
from bench.swing.library import find_profile, profile_names
from bench.swing.profile import Profile, as_written, load_profile, save_profile
from tests.bench.golfer.synthetic import golfer_swing
from tests.conftest import Run

SHIPPED = load_profile(find_profile("driver-85mph"))
IRON = find_profile("iron7-78mph")


@pytest.fixture(autouse=True)
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, slow_swing: Profile) -> None:
    """Run golfbench in a folder with `slow.toml`, which is also its library."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(library, "PROFILES", tmp_path / "profiles")
    (tmp_path / "profiles").mkdir()
    save_profile(tmp_path / "profiles" / "slow.toml", slow_swing)
    save_profile(tmp_path / "wrong.toml", replace(slow_swing, club="putter", limits={}))
    (tmp_path / "mine.toml").write_text(
        'base = "shipped"\n[swing]\nprofile = "slow"\n[bench]\ndata_dir = "here"\n'
        # Deeper ground: this swing's address hangs lower than a real one's.
        "[plant.site]\nground = -1.8\n"
    )
    (tmp_path / "bad.toml").write_text('base = "shipped"\n[plant]\nwrist_levr = 0.06\n[air]\nhumid = 1\n')


def test_check_command_lists_checked_items(run: Run) -> None:
    answer = run("--config", "mine.toml", "check")
    assert (answer.code, answer.err) == (ExitCode.OK, "")
    for text in ("mine.toml over", "every key known", "slow.toml", "end stops", "air", "Everything holds"):
        assert text in answer.out


def test_check_command_invalid_profile_reports_each_error(run: Run) -> None:
    answer = run("check", "wrong.toml")
    assert answer.code == ExitCode.BAD_INPUT
    assert "wrong.toml: club" in answer.err
    assert "wrong.toml: limits.supply_pressure_pa" in answer.err
    assert "Everything holds" not in answer.out


@pytest.mark.parametrize(
    "command", [["check"], ["profile", "show", "slow"], ["profile", "simulate", "slow"], ["doctor"]]
)
def test_commands_invalid_configuration_are_refused_without_output(command: list[str], run: Run) -> None:
    answer = run("--config", "bad.toml", *command)
    assert answer.code == ExitCode.BAD_INPUT
    assert "bad.toml: plant.wrist_levr" in answer.err
    assert "Did you mean wrist_lever?" in answer.err
    assert "bad.toml: air.humid" in answer.err
    assert answer.out == ""


@pytest.mark.parametrize("command", [["profile", "check"], ["faults", "run"], ["tune"]])
def test_commands_without_profile_name_use_configured_profile(
    run: Run, tmp_path: Path, command: list[str]
) -> None:
    """A matrix of `high_speed` was one of `default` on its robot, with limits that were not made for it."""
    (tmp_path / "other.toml").write_text('base = "mine.toml"\n[swing]\nprofile = "not-there"\n')
    answer = run("--config", "other.toml", *command)
    assert answer.code == ExitCode.BAD_INPUT
    assert "error: profile not-there" in answer.err


@pytest.mark.parametrize("command", ["check", "limits", "simulate"])
def test_profile_commands_other_club_are_refused_without_output(
    command: str, run: Run, tmp_path: Path
) -> None:
    options = ("--output", "out") if command != "check" else ()
    answer = run("profile", command, "wrong.toml", *options)
    assert (answer.code, answer.out) == (ExitCode.BAD_INPUT, "")
    assert '"putter"' in answer.err
    assert '"driver", the mounted one' in answer.err
    assert not (tmp_path / "out").exists()


def test_profile_simulate_club_option_mounts_club(run: Run) -> None:
    path = str(IRON)
    assert run("--config", "bag", "profile", "simulate", path, "--output", "one").code == ExitCode.BAD_INPUT
    answer = run(
        "--config", "bag", "profile", "simulate", path, "--club", "iron7", "--output", "two", "--json"
    )
    assert answer.code == ExitCode.OK, answer.err
    answer = run("--config", "bag", "profile", "check", path, "--club", "putter")
    assert (answer.code, "one of driver" in answer.err) == (ExitCode.BAD_INPUT, True)


@pytest.mark.release
def test_learn_sim_club_option_mounts_club(run: Run) -> None:
    one = ("--config", "bag", "learn", str(IRON), "--sim", "--swings", "1", "--json")
    answer = run(*one)
    assert (answer.code, '"driver", the mounted one' in answer.err) == (ExitCode.BAD_INPUT, True)
    answer = run(*one, "--club", "iron7", "--draw", "1")
    assert json.loads(answer.out)["content"]["target"]["head_speed_mps"] == pytest.approx(34.9, rel=0.01)


def test_learn_running_bench_club_option_is_refused(run: Run) -> None:
    answer = run("--config", "bag", "learn", str(IRON), "--club", "iron7")
    assert (answer.code, "--club" in answer.err, "with --sim only" in answer.err) == (
        ExitCode.BAD_INPUT,
        True,
        True,
    )


@pytest.mark.parametrize(
    "command",
    [
        "learn slow --sim --output no/x.toml",
        "profile design no/x.toml",
        "compare slow slow --plot no/x.png",
    ],
)
def test_commands_missing_output_folder_is_refused_before_work(
    command: str, run: Run, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    answer = run("--config", "mine.toml", *command.split())
    assert (answer.code, "a file in a folder that exists, not no" in answer.err) == (ExitCode.FILE, True)
    assert (answer.out, sorted(tmp_path.rglob("*"))) == ("", before)


def test_learn_unusable_database_is_refused_before_swings(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learn, "_learn_in_lock_step", lambda *_: pytest.fail("it swung"))
    Path("here").write_text("a file in place of the data folder")
    answer = run("--config", "mine.toml", "learn", "slow", "--sim")
    assert (answer.code, "error: here\n" in answer.err) == (ExitCode.FILE, True)


def test_commands_unknown_name_is_refused_with_suggestion(run: Run) -> None:
    answer = run("check", "slwo")
    assert (answer.code, "Did you mean slow?" in answer.err) == (ExitCode.BAD_INPUT, True)
    answer = run("profile", "simulate", "slow", "--ball", "hard")
    assert (answer.code, "one of tour, range" in answer.err) == (ExitCode.BAD_INPUT, True)
    answer = run("--config", "smal_plant", "check")
    assert (answer.code, "small_plant" in answer.err) == (ExitCode.BAD_INPUT, True)


def test_profile_list_shows_one_line_per_profile(run: Run) -> None:
    lines = run("profile", "list").out.splitlines()
    (row,) = [line.split() for line in lines if line.split()[:1] == ["slow"]]
    assert row[1] == "driver"
    (found,) = json.loads(run("profile", "list", "--json").out)
    assert (found["name"], found["club"], found["duration"]) == ("slow", "driver", 2.0)


def test_profile_show_prints_phases_and_delivery(run: Run) -> None:
    answer = run("profile", "show", "slow")
    assert answer.code == ExitCode.OK
    for text in ("Phases", "follow through", "head speed", "m/s"):
        assert text in answer.out


def test_profile_show_table_prints_loadable_profile(run: Run, tmp_path: Path) -> None:
    answer = run("profile", "show", "slow", "--table")
    assert (answer.code, "angle_rad = [" in answer.out) == (ExitCode.OK, True)
    (tmp_path / "edited.toml").write_text(answer.out.replace('golfer = "nobody"', 'golfer = "left-hander"'))
    assert "left-hander" in run("profile", "show", "edited.toml").out


def test_profile_simulate_writes_record_and_exit_code_follows_shot(run: Run, tmp_path: Path) -> None:
    answer = run("--config", "mine.toml", "profile", "simulate", "slow", "--json")
    found = json.loads(answer.out)
    assert answer.code == (ExitCode.REFUSED if found["shot"]["reason"] else ExitCode.OK)
    folder = tmp_path / "here" / "simulations" / "slow"
    assert sorted(path.name for path in folder.iterdir()) == ["swing.parquet"]
    assert found["shot"]["ball"] == "tour"
    assert set(found["stop_energy_j"]) == {"shoulder vane", "right arm", "wrist cylinder"}


def test_find_profile_resolves_name_or_path(run: Run, tmp_path: Path) -> None:
    assert profile_names() == ["slow"]
    assert find_profile("slow") == tmp_path / "profiles" / "slow.toml"
    assert find_profile("wrong.toml") == Path("wrong.toml")
    with pytest.raises(BenchError):
        find_profile("none.toml")


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["profile", "design", "new.toml", "--golfer", "senor"], "Did you mean senior?"),
        (["golfer", "compare", "model:senior", "slow", "--plot", "beside.txt"], ".png"),
        (["golfer", "compare", "model:senor", "slow"], "Did you mean senior?"),
        (["golfer", "compare", "model:senior"], "at least one other"),
        (["golfer", "compare", "slow", "model:senior"], "Put the golfer first"),
        (["golfer", "compare", "anna.golfer.toml", "slow"], "golfbench golfer import"),
    ],
)
def test_golfer_commands_invalid_argument_is_refused(arguments: list[str], told: str, run: Run) -> None:
    answer = run(*arguments)
    assert answer.code == ExitCode.BAD_INPUT
    assert told in answer.err


def test_profile_design_saves_profile_and_prints_delivery(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def made(*arguments: Any, progress: Callable[[str, float], None], **named: Any) -> Any:
        asked.append((arguments, named))
        progress("plan", 0.5)
        return SHIPPED

    monkeypatch.setattr("bench.design.designer.design_swing", made)
    path = tmp_path / "fast.toml"
    options = "--golfer tour-female --margin 20 --from nothing --downswing 0.24"
    answer = run("--config", "mine.toml", "profile", "design", path, *options.split())
    assert answer.code == 0, answer.err
    ((_, demand, name), named) = asked[0]
    assert demand.downswing_time == pytest.approx((0.236, 0.244))
    assert (name, named["golfer"], named["start"], demand.margin) == ("fast", "tour-female", None, 0.2)
    assert "in closed loop" in answer.out
    assert "Max absorber load" in answer.out
    assert f"golfbench profile check {path}" in "".join(answer.out.split("\n"))
    assert load_profile(path).delivery == SHIPPED.delivery


def test_profile_design_golfer_stores_followed_swing_and_deviation(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bench.design.designer.design_swing", lambda *_, **__: SHIPPED)
    monkeypatch.setattr("bench.golfer.comparison.golfer_named", lambda _: golfer_swing())
    answer = run("--config", "mine.toml", "profile", "design", "anna.toml", "--golfer", "anna.golfer.toml")
    assert answer.code == 0, answer.err
    followed = load_profile(tmp_path / "anna.toml").followed
    assert followed is not None
    assert (followed["sha256"], followed["follow"], followed["head_speed_mps"]) == ("5e1f", "body", 43.8)
    plant = load_configuration(Path("mine.toml")).plant
    row = compare_motions(golfer_motion(plant, golfer_swing()), robot_motion(plant, SHIPPED))
    assert followed["deviation"] == pytest.approx(row.share, abs=1e-5)
    assert [*followed["rms_rad"], followed["rms_head_m"]] == pytest.approx(row.error, abs=1e-5)
    shown = " ".join(run("profile", "show", "anna.toml").out.split())
    for text in ("Deviation from the golfer's body", f"{100 * row.share[1]:.1f} %", "5e1f", "aligned at"):
        assert text in shown


def test_profile_design_highest_prints_speed_or_failure(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = SimpleNamespace(speed=47.3, binding={"supply pressure": 0.12})

    def found(study: Any, *_: Any) -> Any:
        assert study.start is not None
        return SimpleNamespace(plan=plan, limit="the wrist's valve limits it")

    monkeypatch.setattr("bench.design.highest_speed.highest_speed", found)
    answer = run("--config", "mine.toml", "profile", "design", "--highest")
    assert answer.code == 0, answer.err
    assert "At most 47.3 m/s at the ball, 15 % of each valve" in answer.out
    assert "one per cent more of supply pressure: +0.120 m/s" in answer.out

    def failed(*_: Any, **__: Any) -> Any:
        raise DesignFailed("no way")

    monkeypatch.setattr("bench.design.highest_speed.highest_speed", failed)
    answer = run("--config", "mine.toml", "profile", "design", "--highest")
    assert answer.code == ExitCode.BAD_INPUT
    assert "no way" in answer.err


def test_profile_address_writes_planned_pressures(run: Run, tmp_path: Path, slow_swing: Profile) -> None:
    answer = run("profile", "address", "slow", "--output", "planned.toml")
    assert answer.code == 0
    assert "chambers at" in answer.out
    planned = load_profile(tmp_path / "planned.toml")
    assert planned.air_supply == 8e5
    assert np.all((np.array(planned.air) > 4e5) & (np.array(planned.air) < 7.5e5))
    assert planned.angle.tobytes() == as_written(slow_swing).angle.tobytes()


def test_profile_address_unholdable_load_is_refused(run: Run, tmp_path: Path) -> None:
    (tmp_path / "heavy.toml").write_text(
        'base = "shipped"\n[clubs.driver]\nlike = "driver"\nhead_mass = 300.0\n'
    )
    answer = run("--config", "heavy.toml", "profile", "address", "slow", "--output", "planned.toml")
    assert answer.code != 0
    assert not (tmp_path / "planned.toml").exists()
