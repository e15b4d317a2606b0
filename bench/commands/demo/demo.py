"""`golfbench demo`: the shipped test of two balls on a bench that runs for it alone, or in lock-step.

The bench is the daemon with the plant in step (`paced`); the campaign swings it over the network as any
campaign does. Everything that is started here ends here, also after Ctrl-C.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from bench.campaign.runner_control import bench_facts, new_entry, run_campaign
from bench.commands.campaign_runner_screen import CampaignScreen
from bench.commands.campaign_screen import campaign_bar
from bench.commands.demo.bench_process import BenchPlan
from bench.commands.demo.result import demo_plan, new_folder, write_result
from bench.config import Configuration, database_url
from bench.interrupt import deferred_interrupt
from bench.network.client import BenchClient
from bench.network.free_port import free_port
from bench.processes.child import Child
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.records import CampaignState

_START = 400.0
"""s that the bench may take to start: the first time everything is compiled."""
_END = 40.0
"""s in which it must have brought the robot to rest."""


def demo_configuration(configuration: Configuration, data_dir: Path, *, live: bool) -> Configuration:
    """Return `configuration` with files below `data_dir`.

    `live`: of a simulated bench of its own, which stays armed from swing to swing.
    """
    c = replace(configuration, bench=replace(configuration.bench, data_dir=data_dir, database=""))
    if not live:
        return c
    return replace(
        c,
        bench=replace(c.bench, id=f"demo-{os.getpid()}"),
        driver=replace(c.driver, name="sim", time="paced"),
        network=replace(c.network, endpoint=f"tcp/127.0.0.1:{free_port()}", beyond="", router=""),
        lifecycle=replace(c.lifecycle, series=True, local_reset=False),
    )


@contextmanager
def own_bench(configuration: Configuration, log: Path) -> Iterator[None]:
    """Run a bench for the time of a block; it has brought its robot to rest when the block ends.

    Raises:
        NotStarted: it does not come up.
    """
    child = Child.start("bench", "bench.commands.demo.bench_process", BenchPlan(configuration, log))
    patience = 2.0  # nothing moves before it is ready
    try:
        child.wait_until_ready(_START)
        patience = _END
        yield
    finally:
        child.end(patience)


def run_demo(
    configuration: Configuration, output: Path | None, swings: int, seed: int, *, live: bool
) -> bool:
    """Swing the shipped test of two balls, show and store it; return whether it came to its end.

    `live`: on a bench that is started for it; else in lock-step in this process, where one seed gives the
    same shots. After Ctrl-C the swing under way is completed; the shots so far and their table are there,
    without report and recording.

    Raises:
        BenchError: the profile is invalid, `output` cannot be used, or the bench does not start.
        ExceptionGroup: of BenchErrors, the reasons why the profile cannot be swung here.
        KeyboardInterrupt: Ctrl-C, after the robot was brought to rest and the files were written.
    """
    begin = datetime.now(UTC)
    demo_plan(configuration, swings, seed)  # refused before anything is written
    folder = new_folder(output, configuration, begin)
    c = demo_configuration(configuration, folder / "bench", live=live)
    plan = demo_plan(c, swings, seed)
    d = plan.design
    shots = len(d.balls) * d.blocks
    title = f"{shots} {'swings in real time' if live else 'simulated swings'}: {d.clubs[0]}"
    title += f", profile {d.swings[0]}, balls {' and '.join(d.balls)}"
    console = Console(stderr=True)
    with ExitStack() as stack:
        store = CampaignStore(stack.enter_context(open_database(database_url("", c.bench.data_dir))))
        running = stack.enter_context(ExitStack())
        if live:
            with console.status("starting the bench"):
                running.enter_context(own_bench(c, folder / "bench.log"))
        with deferred_interrupt() as asked:
            facts = None
            if live:
                with BenchClient.connect(c) as client:
                    facts = bench_facts(plan, c, client.status())
            entry = new_entry(plan, c, begin, simulated=True, real_time=facts)
            store.begin(entry)
            with campaign_bar() as bar:
                outcome = run_campaign(entry, c, store, CampaignScreen(entry, plan, bar), asked.is_made)
            with console.status("bringing the robot to rest"):
                running.close()
            write_result(title, store, entry, outcome, folder, c)
    return outcome.state is CampaignState.FINISHED
