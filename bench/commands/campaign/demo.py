"""`golfbench demo`: the shipped test of two balls on a bench that runs for it alone, or in lock-step.

The bench is the daemon with the plant in step (driver "sim"); the campaign swings it over the network as any
campaign does. Everything that is started here ends here, also after Ctrl-C or SIGTERM.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base.address import free_port
from bench.base.atomic_file import NotStored, write_whole
from bench.base.errors import Refused
from bench.base.interrupt import deferred_interrupt
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.report.campaign_record import load_record
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.report.report_format import MPH, YARD
from bench.campaign.report.verdicts import robot_words
from bench.campaign.run.plan_requirements import require_swings
from bench.campaign.run.progress import CampaignProgress
from bench.campaign.run.runner import RunOutcome
from bench.campaign.run.runner_control import bench_facts, new_entry, run_campaign
from bench.commands.campaign.campaign_terminal import ProgressScreen, campaign_bar
from bench.commands.campaign.demo_bench import BenchPlan
from bench.commands.common import plain_table
from bench.config import Configuration, database_url
from bench.network.client import BenchClient
from bench.records.shot.recorded_shot import read_shot
from bench.records.shot.shot import Shot, ShotStatus, shot_table_text
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignEntry, CampaignState
from bench.supervisor.child_process import Child
from bench.viewer.rerun_recording import write_recording


def demo_plan(configuration: Configuration, swings: int, seed: int) -> CampaignPlan:
    """Return the shipped test of two balls, with the configured swing, club and ball and the next ball.

    Raises:
        ExceptionGroup: BenchErrors, the reasons why it cannot be swung here.
    """
    c, plan = configuration, load_plan(Path("two-balls"), configuration)
    first = c.plant.ball.name
    second = islice((name for name in c.balls if name != first), 1)
    balls, club = (first, *second), c.plant.robot.club.name
    plan = replace(
        plan,
        design=replace(
            plan.design,
            balls=balls,
            clubs=(club,),
            swings=(c.swing.profile,),
            blocks=-(-swings // len(balls)),
            seed=seed,
        ),
        balls={name: c.balls[name] for name in balls},
        clubs={club: c.clubs[club]},
    )
    # A separate bench, without calibrations.
    require_swings(plan, replace(c, bench=replace(c.bench, id="demo")))
    return plan


def new_folder(output: Path | None, configuration: Configuration, begin: datetime) -> Path:
    """Return the folder to write to, which is made.

    Raises:
        Refused: there are files in it.
        NotStored: it cannot be made, or another demo has it.
    """
    folder = output or configuration.bench.data_dir / f"demo-{begin:%Y%m%dT%H%M%SZ}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        used = any(folder.iterdir())
        if not used:
            (folder / "bench").mkdir()  # fails for the second of two demos
    except OSError as error:
        action = "Name another one with --output."
        raise NotStored(str(folder), error.strerror or str(error), "a folder to write to", action) from error
    if used:
        raise Refused(str(folder), "files in it", "a new or empty folder", "Name another one with --output.")
    return folder


def write_result(
    title: str,
    store: CampaignStore,
    entry: CampaignEntry,
    outcome: RunOutcome,
    folder: Path,
    c: Configuration,
) -> None:
    """Leave report, recording and table in `folder`, and print the result; after a stop the table only."""
    record = load_record(store, entry)
    found = findings(record.plan, record.shots)
    report, recording, shots = (folder / name for name in ("report.html", "demo.rrd", "shots.csv"))
    if record.shots:
        write_whole(shots, shot_table_text(record.shots))
    interrupted = outcome.state is CampaignState.STOPPED
    if record.shots and not interrupted:
        with Console(stderr=True).status("writing report and recording"):
            write_whole(report, render_campaign_report(record, found))
            if stored := [c.bench.data_dir / one.file for one in store.shots(entry.id) if one.file]:
                swung = [read_shot(path).record for path in stored]
                write_recording(recording, swung, c.plant, folder.name)
    s, design = record.plan.simulation, record.plan.design
    by_itself = "" if entry.real_time else f"supply pressure {100 * s.supply:g} %, "
    scatter = (
        f"drawn from seed {entry.seed}: {by_itself}restitution {100 * s.restitution:g} % from hit to hit, "
        f"{100 * s.sample:g} % from ball to ball, launch monitor {s.ball_speed:g} m/s, {s.spin_rpm:g} rpm "
        f"and {s.carry:g} m of carry (standard deviations)"
    )
    ending = outcome.reason
    if interrupted:
        ending = f"{outcome.reason}: the robot was brought to rest; no report, no recording"
    console, left = Console(highlight=False), len(design.balls) * design.blocks - len(record.shots)
    console.print(_table(title, record.shots))
    if ending:
        console.print(f"{ending}, {left} swings not started.", style="bold red", markup=False, emoji=False)
    elif left > 0:
        console.print(
            f"{left} swings not started: after a stop nothing arms automatically.", style="bold red"
        )
    console.print(f"Everything is simulated. From shot to shot differ, {scatter}.\n")
    for verdict in (verdict for section in found.sections for verdict in section.verdicts):
        console.print(verdict.headline, style="bold")
        console.print(verdict.detail)
    console.print(f"{robot_words(found.repeatability)}\n")
    swings = c.bench.data_dir / "campaigns" / entry.id / "swings"
    for path in (report, recording, shots, swings):
        if path.exists():
            console.print(_way_to_open(path), soft_wrap=True, markup=False, emoji=False)


_FIGURES = (
    ("club", "mph", "club_speed_mps", ".2f", MPH),
    ("", "m/s", "club_speed_mps", ".2f", 1.0),
    ("attack", "°", "attack_angle_deg", "+.2f", 1.0),
    ("strike", "mm", "strike_x_mm", "+.1f", 1.0),
    ("", "mm up", "strike_y_mm", "+.1f", 1.0),
    ("ball", "mph", "ball_speed_mps", ".1f", MPH),
    ("launch", "°", "launch_angle_deg", ".1f", 1.0),
    ("spin", "rpm", "spin_rpm", ".0f", 1.0),
    ("carry", "yd", "carry_m", ".1f", YARD),
    ("", "m", "carry_m", ".1f", 1.0),
)
"""Columns of the table: heading, unit, field of Shot, format, divisor."""


def _table(title: str, shots: Sequence[Shot]) -> Table:
    """Return the shots; below them the reasons of those that are not valid."""
    figures = [f"{head}\n[dim]{unit}[/]" for head, unit, *_ in _FIGURES]
    table = plain_table("shot\n", "ball\n", *figures, right=("shot\n", *figures), title=title, padding=0)
    table.title_justify, table.title_style = "left", "bold"
    for shot in shots:
        cells = [str(shot.shot), shot.ball]
        for _, _, name, form, scale in _FIGURES:
            value = getattr(shot, name)
            cells.append("–" if value is None else format(value / scale, form).replace("-", "−"))
        table.add_row(*cells, style=None if shot.status is ShotStatus.VALID else "red")
    if reasons := [f"shot {shot.shot}, {shot.status}: {shot.reason}" for shot in shots if shot.reason]:
        table.caption = Text("\n".join(reasons), "red", justify="left")
        table.caption_justify = "left"
    return table


def _way_to_open(path: Path) -> str:
    match path.suffix:
        case ".html":
            return f"report     {path}   (opens in any browser)"
        case ".rrd":
            rerun = Path(sys.executable).with_name("rerun")
            shown = os.path.relpath(rerun) if rerun.is_relative_to(Path.cwd()) else rerun
            return f"recording  {path}\n           opens with: {shown} {shlex.quote(str(path))}"
        case ".csv":
            return f"shots      {path}"
        case _:
            return f"swings     {path}{os.sep}   (Parquet, a row a millisecond)"


_START = 400.0
"""Timeout of the bench's start (s): the first one compiles everything."""
_END = 40.0
"""Timeout of bringing the robot to rest (s)."""


def demo_configuration(configuration: Configuration, data_dir: Path, *, live: bool) -> Configuration:
    """Return `configuration` with files below `data_dir`.

    `live`: for a separate simulated bench, which stays armed from swing to swing.
    """
    c = replace(configuration, bench=replace(configuration.bench, data_dir=data_dir, database=""))
    if not live:
        return c
    return replace(
        c,
        bench=replace(c.bench, id=f"demo-{os.getpid()}"),
        driver=replace(c.driver, name="sim"),
        network=replace(c.network, endpoint=f"tcp/127.0.0.1:{free_port()}", beyond="", router=""),
        lifecycle=replace(c.lifecycle, hold_between_swings=True, local_reset=False),
    )


@contextmanager
def own_bench(configuration: Configuration, log: Path) -> Iterator[None]:
    """Run a bench for the time of a block; it has brought its robot to rest when the block ends.

    Raises:
        NotStarted: it does not come up.
    """
    child = Child.start("bench", "bench.commands.campaign.demo_bench", BenchPlan(configuration, log))
    timeout = 2.0  # nothing moves before it is ready
    try:
        child.wait_until_ready(_START)
        timeout = _END
        yield
    finally:
        child.end(timeout)


def run_demo(
    configuration: Configuration, output: Path | None, swings: int, seed: int, *, live: bool
) -> bool:
    """Swing the shipped test of two balls, show and store it; return whether it came to its end.

    `live`: on a bench that is started for it; else in lock-step in this process, where one seed gives the
    same shots. After Ctrl-C or SIGTERM the swing under way is completed; the shots so far and their table
    are there, without report and recording.

    Raises:
        BenchError: the profile is invalid, `output` cannot be used, or the bench does not start.
        ExceptionGroup: BenchErrors, the reasons why the profile cannot be swung here.
        KeyboardInterrupt: Ctrl-C, after the robot was brought to rest and the files were written.
        Terminated: SIGTERM or a closed terminal, likewise.
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
        with deferred_interrupt(terminate=True) as asked:
            facts = None
            if live:
                with BenchClient.connect(c) as client:
                    facts = bench_facts(plan, c, client.status())
            entry = new_entry(plan, c, begin, simulated=True, real_time=facts)
            store.begin(entry)
            with campaign_bar() as bar:
                screen = CampaignProgress(entry, plan, ProgressScreen(bar).follow)
                stop = asked.is_made
                outcome = run_campaign(entry, c, store, screen, stop, cause=lambda: asked.cause)
            with console.status("bringing the robot to rest"):
                running.close()
            write_result(title, store, entry, outcome, folder, c)
    return outcome.state is CampaignState.FINISHED
