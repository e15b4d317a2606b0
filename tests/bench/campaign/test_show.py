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
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from bench.base.address import free_port
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, State
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.plan.shot_sequence import all_trials
from bench.campaign.run.campaign_control import ask
from bench.config import database_url, load_configuration
from bench.records.shot.shot import Shot, ShotStatus
from bench.records.shot.shot_matcher import UNREPORTED
from bench.records.telemetry.record_file import read_swing
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignEntry, CampaignState
from sim.exchange import SurroundingsWriter
from tests.running_bench import BenchProcess, running_bench, write_configuration

pytestmark = [pytest.mark.live, pytest.mark.paced, pytest.mark.release]

DROPPED = 1
"""Ball that the monitor does not report."""
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


@dataclass
class Result:
    """Result of the show."""

    code: int = 1
    output: str = ""
    planned: list[tuple[Any, ...]] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)
    metadata: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[str, str]] = field(default_factory=list)
    swings: int = 0
    """Swings of the bench."""
    swings_while_paused: int = 0


class Show:
    """The processes and the disturbances."""

    def __init__(self, bench: BenchProcess, file: Path, store: CampaignStore) -> None:
        self.bench, self.file, self.store = bench, file, store
        self.result = Result()
        self.campaign: subprocess.Popen[str] | None = None

    @property
    def entry(self) -> CampaignEntry:
        """The campaign."""
        return self.store.entries()[0][0]

    @property
    def state(self) -> CampaignState:
        """Where it stands."""
        return self.store.standing(self.entry.id).state

    def until(self, holds: Callable[[], object], what: str) -> None:
        """Wait until `holds`."""
        begin = time.monotonic()
        while not holds():
            ended = self.campaign is not None and self.campaign.poll() is not None
            if ended or time.monotonic() - begin > _STEP:
                raise TimeoutError(f"{what}: {self.store.entries()}; {self.bench.log[-1500:]}")
            time.sleep(0.02)

    def until_shots(self, count: int) -> None:
        """Wait until so many shots are stored."""
        self.until(lambda: self.store.entries() and len(self.store.shots(self.entry.id)) >= count, "shots")

    def until_monitored(self) -> None:
        """Wait until the launch monitor is connected."""

        def present() -> bool:
            link = self.bench.client.status()["launch_monitor"]
            return link is not None and link["present"]

        self.until(present, "launch monitor")

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

    def run(self, plan: Path) -> Result:
        """Play it: after so many stored shots the pause, the opened guard, the monitor's end."""
        r, data_dir = self.result, self.bench.configuration.bench.data_dir
        with self.started("campaign", "run", str(plan)) as campaign:
            with self.started("launch-monitor", "--drop", str(DROPPED)):
                self.until_monitored()
                self.campaign = campaign
                self.until_shots(1)
                self._pause(data_dir)
                self.until_shots(2)
                self._open_the_guard()
                self.until_shots(4)
            self.until(lambda: self.state is CampaignState.SUSPENDED, "suspended")
            time.sleep(_HELD)
            with self.started("launch-monitor"):
                self.until(lambda: self.state is CampaignState.RUNNING, "continuing")
                r.code = campaign.wait(len(r.planned) * 60.0)
                r.swings = self.bench.client.status()["swings"]
        r.output = self.file.with_suffix(".campaign.log").read_text()
        stored = self.store.shots(self.entry.id)
        r.shots = [one.shot for one in stored]
        r.metadata = [read_swing(data_dir / one.file)[1] for one in stored if one.file]
        r.events = [(event.kind, event.text) for event in self.store.events(self.entry.id)]
        return r

    def _pause(self, data_dir: Path) -> None:
        ask(self.store, data_dir, self.entry.id, "pause")
        self.until(lambda: self.state is CampaignState.PAUSED, "paused")
        swings = self.bench.client.status()["swings"]
        time.sleep(_HELD)
        self.result.swings_while_paused = self.bench.client.status()["swings"] - swings
        ask(self.store, data_dir, self.entry.id, "")

    def _open_the_guard(self) -> None:
        """Open it in a swing, and close it again when the bench has latched."""
        self.until(lambda: self.bench.now()["phase"] == Phase.BACKSWING, "a swing")
        with SurroundingsWriter(self.bench.folder) as hands:
            hands.change(guard_closed=False)
        latched = {State.FAULT.name, State.ESTOP.name}
        self.until(lambda: self.bench.client.status()["state"] in latched, "latched")
        time.sleep(_HELD)
        with SurroundingsWriter(self.bench.folder) as hands:
            hands.change(guard_closed=True)


def show(folder: Path) -> Result:
    """Play the show in `folder` with four valid shots."""
    plan_file = folder / "plan.toml"
    plan_file.write_text(PLAN)
    file = write_configuration(folder, "show", SETTINGS.format(port=free_port()))
    configuration = load_configuration(file)
    plan = load_plan(plan_file, configuration)
    with (
        running_bench(file) as bench,
        open_database(database_url("", configuration.bench.data_dir)) as engine,
    ):
        played = Show(bench, file, CampaignStore(engine))
        played.result.planned = [
            (trial.block, trial.position, trial.arm.ball, str(trial.role)) for trial in all_trials(plan)
        ]
        return played.run(plan_file)


@pytest.mark.timeout(900)  # the first start compiles
def test_campaign_with_disturbances_completes_plan_and_records_faults(tmp_path: Path) -> None:
    r = show(tmp_path)
    assert r.code == 0, r.output
    valid = [shot for shot in r.shots if shot.status is ShotStatus.VALID]
    assert [(shot.block, shot.position, shot.ball, shot.role) for shot in valid] == r.planned
    assert {shot.launch_source for shot in valid} == {"launch monitor"}
    assert len({metadata["shot_id"] for metadata in r.metadata}) == len(r.metadata) == r.swings
    # One more is missing where the monitor was ended in the middle of a swing.
    assert 1 <= sum(UNREPORTED in shot.reason for shot in r.shots) <= 2
    assert sum(CAUSE_TEXT[Cause.GUARD] in shot.reason for shot in r.shots) == 1
    kinds = [kind for kind, _ in r.events]
    assert kinds.count("reset") >= 2
    assert "suspended" in kinds
    assert r.swings_while_paused == 0
    # Two different balls lay on the simulated tee: the monitor saw what the plant struck.
    varied = [metadata["varied"] for metadata in r.metadata]
    assert {one["struck_in_the_plant"] for one in varied} == {"tour", "range"}
    assert all(metadata["launch"]["device"] for metadata in r.metadata if "launch" in metadata)
