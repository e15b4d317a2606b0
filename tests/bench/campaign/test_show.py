"""A short campaign in real time with all that disturbs one, to its end: bench, monitor, runner as processes.

`golfbench run` with the plant, `golfbench launch-monitor` and `golfbench campaign run` against it
over the network, as people start them. Meanwhile the monitor does not report a ball, the campaign is
paused, the guard is opened in the middle of a swing (a simulated bench resets and arms itself, on a real one
a person does), and the monitor is ended and started again.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.base.address import free_port
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, State
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import all_trials
from bench.campaign.run.campaign_control import ask
from bench.config import database_url
from bench.records.shot.shot import ShotStatus
from bench.records.shot.shot_matcher import UNREPORTED
from bench.records.telemetry.record_file import read_swing
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignState
from sim.exchange import SurroundingsWriter
from tests.running_bench import BenchProcess, running_bench, write_configuration

PLAN = """
[campaign]
name = "show"
title = "Two balls, in real time, disturbed"
[design]
balls = ["tour", "range"]
blocks = 2
repeats = 3
[warm_up]
at_most = 0
practice = false                  # every swing is a shot on record
[gate]
reference = "planned"
club_speed = 4.0
strike_x = 0.03
strike_y = 0.03
"""
SETTINGS = """
[lifecycle]
hold_between_swings = true
[launch_monitor]
enabled = true
port = {port}
[launch_monitor.window]
latest = 8.0
"""
_STEP = 300.0
"""s that a step of the show may take."""
_HELD = 2.0
"""s that a pause, an open guard and a missing monitor last."""


class Show:
    """The running bench, its campaign, and the disturbances."""

    def __init__(self, bench: BenchProcess, file: Path, store: CampaignStore) -> None:
        self.bench, self.file, self.store = bench, file, store
        self.campaign: subprocess.Popen[str] | None = None

    @property
    def id(self) -> str:
        return self.store.entries()[0][0].id

    def until(self, holds: Callable[[], object]) -> None:
        """Wait until `holds`."""
        begin = time.monotonic()
        while not holds():
            ended = self.campaign is not None and self.campaign.poll() is not None
            if ended or time.monotonic() - begin > _STEP:
                raise TimeoutError(f"{self.store.entries()}; {self.bench.log[-1500:]}")
            time.sleep(0.02)

    def until_shots(self, count: int) -> None:
        self.until(lambda: self.store.entries() and len(self.store.shots(self.id)) >= count)

    def until_state(self, state: CampaignState) -> None:
        self.until(lambda: self.store.standing(self.id).state is state)

    def monitored(self) -> bool:
        link = self.bench.client.status()["launch_monitor"]
        return link is not None and link["present"]

    @contextmanager
    def started(self, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """Run `golfbench ...` for the time of a block."""
        command = [sys.executable, "-m", "bench", "--config", str(self.file), *arguments]
        with self.file.with_suffix(f".{arguments[0]}.log").open("a") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, text=True)
        try:
            yield process
        finally:
            process.terminate()
            process.wait(30.0)

    def pause(self) -> None:
        """Pause the campaign for some time, in which the robot does not swing."""
        data_dir = self.bench.configuration.bench.data_dir
        ask(self.store, data_dir, self.id, "pause")
        self.until_state(CampaignState.PAUSED)
        swings = self.bench.client.status()["swings"]
        time.sleep(_HELD)
        assert self.bench.client.status()["swings"] == swings
        ask(self.store, data_dir, self.id, "")

    def open_guard(self) -> None:
        """Open the guard in a swing, and close it again when the bench has latched."""
        self.until(lambda: self.bench.now()["phase"] == Phase.BACKSWING)
        with SurroundingsWriter(self.bench.folder) as hands:
            hands.change(guard_closed=False)
        self.until(lambda: self.bench.client.status()["state"] in {State.FAULT.name, State.ESTOP.name})
        time.sleep(_HELD)
        with SurroundingsWriter(self.bench.folder) as hands:
            hands.change(guard_closed=True)


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.release
@pytest.mark.timeout(900)  # the first start compiles
def test_campaign_with_disturbances_completes_plan_and_records_faults(tmp_path: Path) -> None:
    plan_file = tmp_path / "plan.toml"
    plan_file.write_text(PLAN)
    file = write_configuration(tmp_path, "show", SETTINGS.format(port=free_port()))
    with running_bench(file) as bench:
        data_dir = bench.configuration.bench.data_dir
        trials = all_trials(load_plan(plan_file, bench.configuration))
        planned = [(trial.block, trial.position, trial.arm.ball, trial.role) for trial in trials]
        with open_database(database_url("", data_dir)) as engine:
            show = Show(bench, file, CampaignStore(engine))
            with show.started("campaign", "run", str(plan_file)) as campaign:
                with show.started("launch-monitor", "--drop", "1"):
                    show.until(show.monitored)
                    show.campaign = campaign
                    show.until_shots(1)
                    show.pause()
                    show.until_shots(2)
                    show.open_guard()
                    show.until_shots(4)
                show.until_state(CampaignState.SUSPENDED)
                time.sleep(_HELD)
                with show.started("launch-monitor"):
                    show.until_state(CampaignState.RUNNING)
                    code = campaign.wait(len(planned) * 60.0)
                    swings = bench.client.status()["swings"]
            stored = show.store.shots(show.id)
            kinds = [event.kind for event in show.store.events(show.id)]
    assert code == 0, file.with_suffix(".campaign.log").read_text()
    shots = [one.shot for one in stored]
    valid = [shot for shot in shots if shot.status is ShotStatus.VALID]
    assert [(shot.block, shot.position, shot.ball, shot.role) for shot in valid] == planned
    assert {shot.launch_source for shot in valid} == {"launch monitor"}
    records = [read_swing(data_dir / one.file)[1] for one in stored if one.file]
    assert len({metadata["shot_id"] for metadata in records}) == len(records) == swings
    # One more is missing where the monitor was ended in the middle of a swing.
    assert 1 <= sum(UNREPORTED in shot.reason for shot in shots) <= 2
    assert sum(CAUSE_TEXT[Cause.GUARD] in shot.reason for shot in shots) == 1
    assert kinds.count("reset") >= 2
    assert "suspended" in kinds
    # Two different balls lay on the simulated tee: the monitor saw what the plant struck.
    assert {metadata["varied"]["struck_in_the_plant"] for metadata in records} == {"tour", "range"}
    assert all(metadata["launch"]["device"] for metadata in records if "launch" in metadata)
