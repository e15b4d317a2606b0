"""A campaign in real time with all that disturbs one, to its end: bench, launch monitor, runner as processes.

    python -m tests.benchmarks campaign_show --shots 20

`golfbench run` with the plant, `golfbench launch-monitor` beside it and `golfbench campaign run` against it
over the network, as people start them. On the way the monitor does not tell of two balls, the campaign is
paused, the guard is opened in the middle of a swing (a simulated bench resets and arms itself, on a real one
a person does), and the monitor is ended and started again. What was planned must be there in the end, each
shot once, every ball told by the monitor; what went wrong must stand in the records.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bench.campaign.campaign_control import ask
from bench.campaign.plan_file import load_plan
from bench.campaign.randomization import all_trials
from bench.config import Configuration, database_url, load_configuration
from bench.lifecycle import CAUSE_TEXT, Cause, Phase, State
from bench.network.free_port import free_port
from bench.shot.shot import Shot, ShotStatus
from bench.shot.shot_matcher import NOT_TOLD
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.records import CampaignEntry, CampaignState
from bench.telemetry.recorder import read_swing
from sim.live.surroundings import SurroundingsWriter
from tests.benchmarks.row import Row
from tests.running_bench import BenchProcess, running_bench, write_configuration

PLAN = """
[campaign]
name = "show"
title = "Two balls, in real time, disturbed"
[design]
balls = ["tour", "range"]
blocks = {blocks}
repeats = 3
[warm_up]
at_most = 0
practice = false                  # every swing is a shot on record
[gate]
centre = "planned"
club_speed = 4.0
strike_x = 0.03
strike_y = 0.03
"""
SETTINGS = """
[lifecycle]
series = true
[launch_monitor]
enabled = true
port = {port}
[launch_monitor.window]
latest = {latest}
"""
_STEP = 300.0
"""s that a step of the show may take."""
_HELD = 2.0
"""s that a pause, an open guard and a missing monitor last."""


@dataclass
class Result:
    """What the show came to."""

    code: int = 1
    output: str = ""
    planned: list[tuple[Any, ...]] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)
    metadata: list[dict[str, Any]] = field(default_factory=list)
    events: list[tuple[str, str]] = field(default_factory=list)
    swings: int = 0
    """Of the bench."""
    outcomes: dict[str, int] = field(default_factory=dict)
    swings_while_paused: int = 0
    latched_after: float = 0.0
    """s from the opened guard to the latched state, as the bench tells it over the network."""
    suspended_after: float = 0.0
    """s from the monitor's end to the campaign's suspending itself."""
    on_after: float = 0.0
    """s from the monitor's new start to the campaign's going on."""
    duration: float = 0.0
    """s of the campaign."""

    @property
    def valid(self) -> list[Shot]:
        """The shots that count."""
        return [shot for shot in self.shots if shot.status is ShotStatus.VALID]

    def with_reason(self, reason: str) -> list[Shot]:
        """Return the shots that do not count for `reason`."""
        return [shot for shot in self.shots if reason in shot.reason]


class Show:
    """The processes and what is done to them."""

    def __init__(self, bench: BenchProcess, file: Path, store: CampaignStore, drops: Sequence[int]) -> None:
        self.bench, self.file, self.store, self.drops = bench, file, store, drops
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

    def until(self, holds: Callable[[], object], what: str) -> float:
        """Wait until `holds`; return the seconds it took."""
        begin = time.monotonic()
        while not holds():
            ended = self.campaign is not None and self.campaign.poll() is not None
            if ended or time.monotonic() - begin > _STEP:
                raise TimeoutError(f"{what}: {self.store.entries()}; {self.bench.log[-1500:]}")
            time.sleep(0.02)
        return time.monotonic() - begin

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

    def run(self, plan: Path, pause_after: int, door_after: int, away_after: int) -> Result:
        """Play it; the three numbers are of stored shots, ascending."""
        r, data_dir = self.result, self.bench.configuration.bench.data_dir
        drops = [word for n in self.drops for word in ("--drop", str(n))]
        begin = time.monotonic()
        with self.started("campaign", "run", str(plan)) as campaign:
            with self.started("launch-monitor", *drops):
                self.until_monitored()
                self.campaign = campaign
                self.until_shots(pause_after)
                self._pause(data_dir)
                self.until_shots(door_after)
                self._open_the_guard()
                self.until_shots(away_after)
            r.suspended_after = self.until(lambda: self.state is CampaignState.SUSPENDED, "suspended")
            time.sleep(_HELD)
            with self.started("launch-monitor"):
                r.on_after = self.until(lambda: self.state is CampaignState.RUNNING, "going on")
                r.code = campaign.wait(len(r.planned or range(100)) * 60.0)
                status = self.bench.client.status()
        r.duration, r.output = time.monotonic() - begin, self.file.with_suffix(".campaign.log").read_text()
        r.swings, link = status["swings"], status["launch_monitor"]
        r.outcomes = {} if link is None else link["outcomes"]
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
        after = self.until(lambda: self.bench.client.status()["state"] in latched, "latched")
        self.result.latched_after = after
        time.sleep(_HELD)
        with SurroundingsWriter(self.bench.folder) as hands:
            hands.change(guard_closed=True)


def show(
    folder: Path, shots: int, drops: Sequence[int], when: tuple[int, int, int], latest: float, clock: Any
) -> Result:
    """Play the show in `folder` with so many valid shots; `when`: after how many stored ones what happens.

    That is the pause, the opened guard, and the monitor's end. `latest` (s) is the window of a launch.
    """
    plan_file = folder / "plan.toml"
    plan_file.write_text(PLAN.format(blocks=shots // 2))
    file = write_configuration(folder, "show", SETTINGS.format(port=free_port(), latest=latest))
    configuration: Configuration = load_configuration(file)
    plan = load_plan(plan_file, configuration)
    with (
        running_bench(file, clock=clock) as bench,
        open_database(database_url("", configuration.bench.data_dir)) as engine,
    ):
        played = Show(bench, file, CampaignStore(engine), drops)
        played.result.planned = [
            (trial.block, trial.position, trial.arm.ball, str(trial.role)) for trial in all_trials(plan)
        ]
        return played.run(plan_file, *when)


def rows_of(result: Result, title: str, drops: int) -> list[Row]:
    """Return the figures of `result`."""
    r, valid = result, result.valid
    in_order = [(shot.block, shot.position, shot.ball, shot.role) for shot in valid]
    ids = {metadata["shot_id"] for metadata in r.metadata}
    unseen, stopped = r.with_reason(NOT_TOLD), r.with_reason(CAUSE_TEXT[Cause.GUARD])
    sources = {shot.launch_source for shot in valid}
    resets = [text for kind, text in r.events if kind == "reset"]
    waits = [text for kind, text in r.events if kind == "suspended"]
    speeds = {
        ball: [shot.ball_speed_mps or 0.0 for shot in valid if shot.ball == ball]
        for ball in ("tour", "range")
    }
    mean = {ball: sum(values) / max(1, len(values)) for ball, values in speeds.items()}
    each = r.duration / max(1, len(r.shots))
    told = ", ".join(f"{outcome} {count}" for outcome, count in r.outcomes.items() if count)
    return [
        Row(title, "exit code of the campaign", r.code, "", "", 0, 0),
        Row(title, "planned shots without a valid one", len(r.planned) - len(valid), "", "", 0, 0),
        Row(title, "valid shots out of the plan's order", float(in_order != r.planned), "", "", 0, 0),
        Row(title, "balls not of the launch monitor", float(sources != {"launch monitor"}), "", "", 0, 0),
        Row(title, "shots without an id of their own", len(r.metadata) - len(ids), "", "", 0, 0),
        # One more where the monitor was ended in the middle of a swing.
        Row(title, "dropped launches, invalid and repeated", len(unseen), "", NOT_TOLD, drops, drops + 1),
        Row(title, "shots stopped by the guard", len(stopped), "", CAUSE_TEXT[Cause.GUARD], 1, 1),
        Row(title, "resets of the simulated bench", len(resets), "", resets[-1] if resets else "", 2),
        Row(title, "suspended by itself and gone on", len(waits), "", waits[-1] if waits else "", 1),
        Row(title, "swings while paused", r.swings_while_paused, "", "", 0, 0),
        Row(title, "swings of the bench beside those on record", r.swings - len(r.metadata), "", told, 0, 0),
        Row(title, "guard opened to latched", r.latched_after, "s", "as told over the network"),
        Row(title, "monitor ended to suspended", r.suspended_after, "s", "at the end of the shot under way"),
        Row(title, "monitor started to going on", r.on_after, "s", "of which 3 s it must stay"),
        Row(title, "ball speed, tour less range", mean["tour"] - mean["range"], "m/s", "means of the valid"),
        Row(title, "campaign", r.duration, "s", f"{len(r.shots)} shots, {each:.1f} s each"),
    ]


def run(arguments: Sequence[str]) -> list[Row]:
    """Play the show and tell."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks campaign_show", description=__doc__)
    parser.add_argument("--shots", type=int, default=20, help="valid ones, even, at least 12")
    parser.add_argument("--clock", choices=("paced", "wall"), default="paced")
    parser.add_argument(
        "--latest", type=float, default=4.0, help="s after the impact in which a launch counts"
    )
    chosen = parser.parse_args(arguments)
    if chosen.shots < 12 or chosen.shots % 2:
        parser.error("--shots: an even number from 12 on")
    drops = (3, chosen.shots // 2 - 2)
    half = chosen.shots // 2
    with tempfile.TemporaryDirectory(prefix="golfbench-show-") as folder:
        result = show(Path(folder), chosen.shots, drops, (5, half, half + 3), chosen.latest, chosen.clock)
    return rows_of(result, f"Campaign of {chosen.shots} shots in real time ({chosen.clock})", len(drops))
