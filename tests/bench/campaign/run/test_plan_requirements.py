"""Needs of a plan on a running bench, and what in its configuration does not suit the plan."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib import resources
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.base.errors import ExitCode, Refused
from bench.campaign.run.plan_requirements import (
    START_SERIES,
    free_space,
    needs,
    needs_series,
    needs_words,
    swings_of_other_clubs,
)
from bench.commands.cli import app
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile, save_profile
from tests.bench.campaign.plans import SHIPPED, shipped_plan


def test_needs_reports_disk_space_and_hand_work(tmp_path: Path) -> None:
    plan = shipped_plan("clubs", ball_handling={"magazine": 10})
    found = needs(plan)
    assert found.bytes == 36 * 1_400_000
    fills = 3 + 4  # one for the warm-up of each club, then 36 shots
    assert (found.feeder_fills, found.hand_work) == (fills, 180.0 * found.club_changes + 120.0 * fills)
    assert found.club_changes > 20
    assert "Not enough" in needs_words(plan, 1_000_000)[0]
    assert "Not enough" not in needs_words(plan, 10**9)[0]
    assert free_space(tmp_path / "not" / "there") > 0


def test_needs_series_narrow_gate_without_planned_air_requires_series() -> None:
    planned = load_profile(find_profile("default"))
    free = replace(planned, air=(), air_supply=0.0)

    def needed(gate: float, *profiles: Profile) -> bool:
        return needs_series(shipped_plan("two-balls", gate={"club_speed": gate}), profiles)

    assert (needed(1.0, free), needed(2.5, free), needed(0.0, free)) == (True, False, False)
    assert (needed(1.0, planned), needed(1.0, planned, free)) == (False, True)


@pytest.mark.parametrize(
    ("base", "magazine", "refused"),
    [
        ("local_can", 0, ["analysis.quantity", "ball_handling"]),
        ("local_can", 6, ["analysis.quantity"]),
        ("shipped", 0, []),
    ],
)
def test_campaign_check_lists_plan_keys_that_hardware_refuses(
    tmp_path: Path, base: str, magazine: int, refused: list[str]
) -> None:
    file, plan = tmp_path / "bench.toml", tmp_path / "plan.toml"
    file.write_text(f'base = "{base}"\n[bench]\ndata_dir = "{tmp_path / "data"}"\n')
    shipped = (resources.files("bench") / "campaigns" / "two-balls.toml").read_text()
    plan.write_text(f"{shipped}\n[ball_handling]\nmagazine = {magazine}\n")
    done = CliRunner().invoke(app, ["--config", str(file), "campaign", "check", str(plan)])
    errors = done.exception.exceptions if isinstance(done.exception, ExceptionGroup) else ()
    assert [error.location.rpartition(" ")[2] for error in errors if isinstance(error, Refused)] == refused
    assert done.exit_code == (ExitCode.REFUSED if refused else ExitCode.OK)


def test_swings_of_other_clubs_action_is_complete_command() -> None:
    plan = shipped_plan("two-balls", design={"clubs": ("mine",)})
    longer = replace(plan.clubs["driver"], name="mine", length_to_face=1.2)
    mine = replace(plan, clubs=plan.clubs | {"mine": longer})
    (misfit,) = swings_of_other_clubs(mine, SHIPPED).values()
    assert "golfbench profile design mine.toml --club mine." in misfit.action
    assert '] mine = "mine.toml".' in misfit.action


@pytest.mark.parametrize(
    ("series", "profile", "warned"),
    [(False, "free.toml", True), (True, "free.toml", False), (False, "default", False)],
)
def test_campaign_check_warns_of_missing_series_option(
    tmp_path: Path, series: bool, profile: str, warned: bool
) -> None:
    file = tmp_path / "bench.toml"
    file.write_text(f'base = "shipped"\n[lifecycle]\nhold_between_swings = {str(series).lower()}\n')
    shipped = (resources.files("bench") / "campaigns" / "two-balls.toml").read_text()
    free = replace(load_profile(find_profile("default")), name="free", air=(), air_supply=0.0)
    save_profile(tmp_path / "free.toml", free)
    swing = tmp_path / profile if profile.endswith(".toml") else profile
    plan = tmp_path / "plan.toml"
    plan.write_text(shipped.replace("[design]", f'[design]\nswings = ["{swing}"]'))
    arguments = ["--config", str(file), "campaign", "check", str(plan), "--json"]
    said = json.loads(CliRunner().invoke(app, arguments).stdout)
    assert [START_SERIES in text for text in said["warnings"]] == [True] * warned
    assert said["warnings"] == ([said["series_warning"]] if warned else [])
    assert bool(said["series_warning"]) is warned
    assert "golfbench run --series" in START_SERIES
