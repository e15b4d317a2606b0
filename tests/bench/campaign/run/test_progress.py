"""Progress of a campaign: time left, last shot, next work by hand; as lines and as a message."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import timedelta
from itertools import pairwise

import pytest

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.shot_sequence import PlannedShot, all_trials
from bench.campaign.run.progress import CampaignProgress
from bench.campaign.run.runner_control import new_entry
from bench.commands.campaign.campaign_terminal import ProgressScreen, campaign_bar, progress_lines, shot_line
from bench.records.shot.shot import Shot, ShotStatus
from bench.store.rows import CampaignState
from tests.bench.campaign.plans import NOW, SHIPPED, row_of, shipped_plan


@pytest.fixture(scope="module")
def plan() -> CampaignPlan:
    return shipped_plan("clubs")


def _progress(plan: CampaignPlan) -> CampaignProgress:
    facts = {"driver": "canopen"}
    return CampaignProgress(new_entry(plan, SHIPPED, NOW, simulated=False, real_time=facts), plan)


def _shot(trial: PlannedShot, number: int, seconds: float, status: ShotStatus = ShotStatus.VALID) -> Shot:
    reason = "" if status is ShotStatus.VALID else "no ball struck"
    shot = row_of(trial, number, 3, status=status, reason=reason, club_speed_mps=42.613, carry_m=181.04)
    return replace(shot, time_utc=NOW + timedelta(seconds=seconds))


def test_campaign_progress_time_left_ignores_overnight_gap(plan: CampaignPlan) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    for n in range(8):
        progress.shot(_shot(trials[n], n + 1, 10.0 * n + (40_000.0 if n > 5 else 0.0)))
    progress.standing(CampaignState.RUNNING, "")
    clubs = [trial.arm.club for trial in trials[7:]]
    changes = sum(one != two for one, two in pairwise(clubs))
    assert progress.message["seconds_left"] == 10.0 * (36 - 8) + 180.0 * changes
    assert progress.message["done"] == 8


def test_campaign_progress_time_left_ignores_clock_change(
    plan: CampaignPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    progress.standing(CampaignState.RUNNING, "")
    for n, set_ahead in enumerate((0.0, 3600.0)):
        monkeypatch.setattr("bench.campaign.run.progress.time.monotonic", lambda n=n: 1e3 + 10.0 * n)
        progress.shot(_shot(trials[n], n + 1, 10.0 * n + set_ahead))
    clubs = [trial.arm.club for trial in trials[1:]]
    changes = sum(one != two for one, two in pairwise(clubs))
    assert progress.message["seconds_left"] == 10.0 * (36 - 2) + 180.0 * changes


def test_campaign_progress_next_work_reports_club_and_time(plan: CampaignPlan) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    for n in range(2):
        progress.shot(_shot(trials[n], n + 1, 10.0 * n))
    wanted = next(n for n, trial in enumerate(trials[2:]) if trial.arm.club != trials[1].arm.club)
    assert progress.message["next_work"] == {
        "shots": wanted,
        "text": f"mount club {trials[2 + wanted].arm.club}",
        "seconds": 10.0 * wanted,
    }
    progress.feeder(0)
    assert progress.message["next_work"]["shots"] == 0


def test_campaign_progress_set_aside_reopens_block(plan: CampaignPlan) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    for n in range(5):  # one block of three, two of the next
        progress.shot(_shot(trials[n], n + 1, 10.0 * n))
    progress.set_aside(trials[4].block)
    assert (progress.message["done"], progress.message["valid"]) == (3, 3)
    assert progress.message["balls"]["tour"] == {"valid": 3, "planned": 36}


def test_progress_lines_show_last_shot_and_counts(plan: CampaignPlan) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    progress.shot(_shot(trials[0], 1, 0.0))
    progress.shot(_shot(trials[0], 2, 10.0, ShotStatus.FAILED))
    lines = progress_lines(progress.message)
    assert lines[1] == "last: shot 2, tour 3, failed no ball struck: club 42.61 m/s, carry 181.0 m"
    assert lines[2] == "valid: tour 1/36; 1 invalid"
    assert lines[3].startswith("next by hand: mount club ")
    assert all(len(line) <= 80 for line in lines)


def test_progress_screen_piped_prints_plain_lines(
    plan: CampaignPlan, capsys: pytest.CaptureFixture[str]
) -> None:
    progress, trials = _progress(plan), all_trials(plan)
    with campaign_bar() as bar:
        screen = ProgressScreen(bar)
        for n in range(3):
            status = ShotStatus.FAILED if n == 2 else ShotStatus.VALID
            progress.shot(_shot(trials[n], n + 1, 10.0 * n, status))
            screen.show(progress.message)
            screen.show(progress.message)
    told = capsys.readouterr().err.splitlines()
    assert [line.split(",")[0] for line in told] == [
        "2026-11-21T12:00:00Z 1/36 shot 1",
        "2026-11-21T12:00:20Z 2/36 shot 3",
    ]
    assert "\x1b" not in "".join(told)
    assert "left, until " in told[0]


def test_progress_sends_json_with_each_change(plan: CampaignPlan) -> None:
    sent: list[str] = []
    entry = new_entry(plan, SHIPPED, NOW, simulated=True, real_time={"driver": "sim"})
    told = CampaignProgress(entry, plan, lambda message: sent.append(json.dumps(message)))
    told.shot(_shot(all_trials(plan)[0], 1, 0.0))
    assert not sent, "shots of earlier runs are not sent"
    told.standing(CampaignState.RUNNING, "")
    told.shot(_shot(all_trials(plan)[1], 2, 10.0))
    told.say("a word")
    told.standing(CampaignState.PAUSED, "paused by request of ann")
    last = json.loads(sent[-1])
    assert len(sent) == 4
    assert (last["state"], last["event"]["text"]) == ("paused", "a word")
    assert last["next_work"] is None, "a simulated bench does it automatically"
    assert shot_line(last["last_shot"]).startswith("shot 2, ")


def test_shot_line_unmeasured_shot_shows_not_measured(plan: CampaignPlan) -> None:
    progress = _progress(plan)
    shot = replace(_shot(all_trials(plan)[0], 1, 0.0), club_speed_mps=None, carry_m=None)
    progress.shot(shot)
    assert shot_line(progress.message["last_shot"]).endswith(": not measured")
