"""Reported status of a campaign whose runner has died."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.campaign.run.campaign_control import standing_now
from bench.store.rows import CampaignState, Standing, state_text
from bench.supervisor.ownership import try_lock

NAME = "2026-11-26-two-balls-1"


@pytest.fixture
def lock(tmp_path: Path) -> Path:
    """Return the lock file that a runner leaves."""
    path = tmp_path / "campaigns" / NAME / "runner"
    path.parent.mkdir(parents=True)
    path.write_text(f"4711 {NAME}")
    return path


@pytest.mark.parametrize("state", [CampaignState.RUNNING, CampaignState.WAITING, CampaignState.PAUSED])
def test_standing_now_killed_runner_is_interrupted(lock: Path, tmp_path: Path, state: CampaignState) -> None:
    standing = standing_now(tmp_path, NAME, Standing(state, "", ""))
    assert standing.state is CampaignState.INTERRUPTED
    assert f"golfbench campaign resume {NAME}" in standing.reason


def test_standing_now_living_runner_is_unchanged(lock: Path, tmp_path: Path) -> None:
    stored = Standing(CampaignState.RUNNING, "", "")
    with lock.open("rb") as file:
        assert try_lock(file.fileno())
        assert standing_now(tmp_path, NAME, stored) == stored


def test_standing_now_runner_on_other_machine_is_unchanged(tmp_path: Path) -> None:
    stored = Standing(CampaignState.RUNNING, "", "")
    assert standing_now(tmp_path, NAME, stored) == stored


@pytest.mark.parametrize("state", [CampaignState.FINISHED, CampaignState.ABORTED, CampaignState.SUSPENDED])
def test_standing_now_closed_campaign_is_unchanged(lock: Path, tmp_path: Path, state: CampaignState) -> None:
    stored = Standing(state, "its reason", "")
    assert standing_now(tmp_path, NAME, stored) == stored


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        ("paused by request of Ann", "paused by request of Ann"),
        ("disk full", "paused: disk full"),
        ("", "paused"),
    ],
)
def test_state_text_names_state_once(reason: str, text: str) -> None:
    assert state_text("paused", reason) == text
