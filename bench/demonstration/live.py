"""`golfbench demo`: the shipped test of two balls on a bench that runs for it alone, in real time.

The bench is the daemon with the plant in step (`paced`); the campaign swings it over the network as any
campaign does. Everything that is started here ends here, also after Ctrl-C.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from bench.campaign.campaign_report import load_record, write_campaign_report
from bench.campaign.findings import findings
from bench.campaign.operate import bench_facts, new_entry, run_live
from bench.campaign.plan import Plan
from bench.campaign.plan_file import load_plan
from bench.campaign.runner import Outcome, Watcher
from bench.campaign.shot_table import write_shot_table
from bench.campaign.swings import require_swings
from bench.config import Configuration
from bench.demonstration.bench_process import BenchPlan
from bench.demonstration.lock_step import Files, new_folder
from bench.demonstration.screen import Screen
from bench.interrupt import deferred_interrupt
from bench.network.client import BenchClient
from bench.network.free_port import free_port
from bench.processes.child import Child
from bench.shot.recorded_shot import read_shot
from bench.shot.shot import Shot
from bench.store.campaigns import CampaignEntry, CampaignState, CampaignStore
from bench.store.database import database_url, open_database
from bench.viewer.recording import write_recording

_START = 400.0
"""s that the bench may take to start: the first time everything is compiled."""
_END = 40.0
"""s in which it must have brought the robot to rest."""


class _ScreenWatcher(Watcher):
    """Shows the shots as they come."""

    def __init__(self, screen: Screen) -> None:
        self._screen = screen

    def shot(self, shot: Shot) -> None:
        """Add its row."""
        self._screen.say("swinging")
        self._screen.add(shot)


def demo_configuration(configuration: Configuration, data_dir: Path) -> Configuration:
    """Return the configuration of a simulated bench of its own, which stays armed from swing to swing."""
    c = configuration
    return replace(
        c,
        bench=replace(c.bench, id=f"demo-{os.getpid()}", data_dir=data_dir, database=""),
        driver=replace(c.driver, name="sim", time="paced"),
        network=replace(c.network, endpoint=f"tcp/127.0.0.1:{free_port()}", beyond="", router=""),
        lifecycle=replace(c.lifecycle, series=True, local_reset=False),
    )


def demo_plan(configuration: Configuration, swings: int, seed: int) -> Plan:
    """Return the shipped test of two balls, with the configured swing, club and ball and the next ball.

    Raises:
        ExceptionGroup: of BenchErrors; it cannot be swung here.
    """
    c, plan = configuration, load_plan(Path("two-balls"), configuration)
    first = c.plant.ball.name
    second = islice((name for name in c.balls if name != first), 1)
    balls, club = (first, *second), c.plant.robot.club.name
    plan = replace(
        plan,
        design=replace(
            plan.design, balls=balls, clubs=(club,), swings=(c.swing.profile,),
            blocks=-(-swings // len(balls)), seed=seed,
        ),
        balls={name: c.balls[name] for name in balls},
        clubs={club: c.clubs[club]},
    )  # fmt: skip
    require_swings(plan, c)
    return plan


@contextmanager
def own_bench(configuration: Configuration, log: Path) -> Iterator[None]:
    """Run a bench for the time of a block; it has brought its robot to rest when the block ends.

    Raises:
        NotStarted: it does not come up.
    """
    child = Child.start("bench", "bench.demonstration.bench_process", BenchPlan(configuration, log))
    patience = 2.0  # nothing moves before it is ready
    try:
        child.wait_until_ready(_START)
        patience = _END
        yield
    finally:
        child.end(patience)


def run_live_demo(configuration: Configuration, output: Path | None, swings: int, seed: int) -> bool:
    """Start the bench, run the campaign, show and store; return whether it came to its end.

    After Ctrl-C the swing under way is completed; the shots so far and their table are there, without report
    and recording.

    Raises:
        BenchError: the profile does not hold, `output` cannot be used, or the bench does not start.
        ExceptionGroup: of BenchErrors, the reasons why the profile cannot be swung here.
        KeyboardInterrupt: Ctrl-C, after the robot was brought to rest and the files were written.
    """
    begin = datetime.now(UTC)
    demo_plan(configuration, swings, seed)  # refused before anything is written
    folder = new_folder(output, configuration, begin)
    c = demo_configuration(configuration, folder / "bench")
    plan = demo_plan(c, swings, seed)
    d = plan.design
    title = f"{d.clubs[0]}, profile {d.swings[0]}, balls {' and '.join(d.balls)}"
    shots = len(plan.design.balls) * plan.design.blocks
    with ExitStack() as stack:
        screen = stack.enter_context(Screen(f"{shots} swings in real time: {title}", shots))
        store = CampaignStore(stack.enter_context(open_database(database_url("", c.bench.data_dir))))
        screen.say("starting the bench (the first time it is compiled: half a minute)")
        running = stack.enter_context(ExitStack())
        running.enter_context(own_bench(c, folder / "bench.log"))
        with deferred_interrupt() as asked:
            with BenchClient.connect(c) as client:
                facts = bench_facts(plan, c, client.status())
            entry = new_entry(plan, c, begin, simulated=True, real_time=facts)
            store.begin(entry)
            screen.say("arming")
            outcome = run_live(entry, c, store, _ScreenWatcher(screen), asked.is_set)
            screen.say("bringing the robot to rest")
            running.close()
            _write(screen, store, entry, outcome, Files.within(folder), c)
    return outcome.state is CampaignState.FINISHED


def _write(
    screen: Screen,
    store: CampaignStore,
    entry: CampaignEntry,
    outcome: Outcome,
    files: Files,
    c: Configuration,
) -> None:
    """Leave report, recording and table, and show what came of it."""
    record = load_record(store, entry)
    found = findings(record.plan, record.shots)
    files = files._replace(swings=c.bench.data_dir / "campaigns" / entry.id / "swings")
    if record.shots:
        write_shot_table(files.shots, record.shots)
    interrupted = outcome.state is CampaignState.STOPPED
    stopped = "Ctrl-C: the swing was completed, the robot brought to rest; no report, no recording"
    if record.shots and not interrupted:
        screen.say("writing the report")
        write_campaign_report(files.report, record, found)
        screen.step()
        screen.say("writing the recording")
        stored = [c.bench.data_dir / one.file for one in store.shots(entry.id) if one.file]
        if stored:
            write_recording(
                files.recording,
                [read_shot(path).record for path in stored],
                c.plant,
                files.recording.parent.name,
            )
        screen.step()
    s = record.plan.simulation
    scatter = (
        f"restitution {100 * s.restitution:g} % from hit to hit, {100 * s.sample:g} % from ball to "
        f"ball, launch monitor {s.ball_speed:g} m/s and {s.spin_rpm:g} rpm (standard deviations)"
    )
    written = [path for path in files if path.exists()]
    screen.finish(
        scatter,
        entry.seed,
        written,
        stopped if interrupted else outcome.reason,
        [verdict for section in found.verdicts for verdict in section],
    )
