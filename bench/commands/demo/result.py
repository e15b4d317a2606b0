"""What every demo shares: its plan, its folder, and what it leaves."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from itertools import islice
from pathlib import Path

from rich.console import Console

from bench.campaign.campaign_record import load_record
from bench.campaign.campaign_report import write_campaign_report
from bench.campaign.findings import findings
from bench.campaign.plan import CampaignPlan
from bench.campaign.plan_file import load_plan
from bench.campaign.runner import RunOutcome
from bench.campaign.swings import require_swings
from bench.commands.demo.screen import print_findings, print_result
from bench.config import Configuration
from bench.errors import BenchError, Refused
from bench.shot.recorded_shot import read_shot
from bench.shot.shot_table import write_shot_table
from bench.store.campaigns import CampaignStore
from bench.store.records import CampaignEntry, CampaignState
from bench.viewer.recording import write_recording


def demo_plan(configuration: Configuration, swings: int, seed: int) -> CampaignPlan:
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
    # A bench of its own, which has no calibrations.
    require_swings(plan, replace(c, bench=replace(c.bench, id="demo")))
    return plan


def new_folder(output: Path | None, configuration: Configuration, begin: datetime) -> Path:
    """Return the folder to write to, which is made.

    Raises:
        Refused: there are files in it.
        BenchError: it cannot be made.
    """
    folder = output or configuration.bench.data_dir / f"demo-{begin:%Y%m%dT%H%M%SZ}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        used = any(folder.iterdir())
    except OSError as error:
        cure = "Name another one with --output."
        raise BenchError(str(folder), error.strerror or str(error), "a folder to write to", cure) from error
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
    """Leave report, recording and table in `folder`, and print the result; after Ctrl-C the table only."""
    record = load_record(store, entry)
    found = findings(record.plan, record.shots)
    report, recording, shots = (folder / name for name in ("report.html", "demo.rrd", "shots.csv"))
    if record.shots:
        write_shot_table(shots, record.shots)
    interrupted = outcome.state is CampaignState.STOPPED
    if record.shots and not interrupted:
        with Console(stderr=True).status("writing report and recording"):
            write_campaign_report(report, record, found)
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
    ending = "Ctrl-C: the robot was brought to rest; no report, no recording"
    ending = ending if interrupted else outcome.reason
    print_result(title, len(design.balls) * design.blocks, record.shots, ending, scatter)
    swings = c.bench.data_dir / "campaigns" / entry.id / "swings"
    print_findings(found, [path for path in (report, recording, shots, swings) if path.exists()])
