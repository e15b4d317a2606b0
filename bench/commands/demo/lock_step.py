"""`golfbench demo --engine compiled`: the demo as a simulated campaign, in lock-step in this process.

It takes seconds, and the same seed gives the same shots.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from bench.campaign.operate import new_entry, run_simulated
from bench.commands.demo.result import Files, ScreenWatcher, demo_plan, new_folder, write_result
from bench.commands.demo.screen import Screen
from bench.config import Configuration, database_url
from bench.interrupt import deferred_interrupt
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.records import CampaignState


def run_lock_step_demo(configuration: Configuration, output: Path | None, swings: int, seed: int) -> bool:
    """Check, swing, show and store; return whether the campaign came to its end.

    Raises:
        BenchError: the profile is invalid, or `output` cannot be used.
        ExceptionGroup: of BenchErrors, the reasons why the profile cannot be swung here.
        KeyboardInterrupt: Ctrl-C, after the robot was brought to rest and the files were written.
    """
    begin, plan = datetime.now(UTC), demo_plan(configuration, swings, seed)
    folder = new_folder(output, configuration, begin)
    c = replace(configuration, bench=replace(configuration.bench, data_dir=folder / "bench", database=""))
    d = plan.design
    title = f"{d.clubs[0]}, profile {d.swings[0]}, balls {' and '.join(d.balls)}"
    shots = len(d.balls) * d.blocks
    with (
        Screen(f"{shots} simulated swings: {title}", shots) as screen,
        open_database(database_url("", c.bench.data_dir)) as engine,
        deferred_interrupt() as asked,
    ):
        store, entry = CampaignStore(engine), new_entry(plan, c, begin, simulated=True)
        store.begin(entry)
        screen.say("swinging")
        outcome = run_simulated(entry, c, store, ScreenWatcher(screen), asked.is_made)
        write_result(screen, store, entry, outcome, Files.within(folder), c)
    return outcome.state is CampaignState.FINISHED
