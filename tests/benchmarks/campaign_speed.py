"""How long a thousand simulated shots take with everything stored, and the report of ten thousand.

The thousand run in lock-step, cycles written and synced; the greatest memory after a fifth of them and
at the end shows whether it grows. The ten thousand of the report are sampled, not simulated; its memory is
that of `golfbench campaign report` as a separate process. Options: `--shots N` (0: none), `--report N`.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.base.atomic_file import write_whole
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.report.campaign_record import load_record
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import findings
from bench.campaign.run._simulated_shots import BEGIN, SimulatedShots
from bench.campaign.run.plan_requirements import require_swings
from bench.campaign.run.runner_control import new_entry, run_campaign
from bench.campaign.run.shot_source import Watcher
from bench.config import database_url, load_configuration
from bench.records.shot.shot import Shot
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore, StoredShot
from bench.store.database import open_database
from bench.store.rows import CampaignState
from tests.bench.campaign.as_designed import AsDesigned, arm_all
from tests.benchmarks.campaign_statistics import Truth, campaign_shots
from tests.benchmarks.row import Row, numbers

TITLE = "campaign speed"


class Clock(Watcher):
    """Notes time and greatest memory at each shot."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.memory: list[int] = []

    def shot(self, shot: Shot) -> None:
        """Note a shot."""
        self.times.append(time.perf_counter())
        self.memory.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def plan_of(shots: int) -> CampaignPlan:
    """Return two balls with a control ball in blocks of five."""
    plan = load_plan(Path("symmetry"), load_configuration(Path("shipped")))
    return replace(
        plan,
        design=replace(plan.design, blocks=shots // 5),
        stop=replace(plan.stop, rule="fixed"),
        ball_handling=replace(plan.ball_handling, samples=1000),
    )


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Swing, store and report."""
    given = numbers("campaign_speed", arguments, shots=1000, report=10_000)
    with tempfile.TemporaryDirectory() as folder:
        return [
            *(_swung(Path(folder) / "swung", given.shots) if given.shots else ()),
            *_reported(Path(folder) / "drawn", given.report),
        ]


def _swung(folder: Path, shots: int) -> list[Row]:
    configuration = load_configuration(Path("shipped"))
    configuration = replace(configuration, bench=replace(configuration.bench, data_dir=folder))
    plan, clock = plan_of(shots), Clock()
    entry = new_entry(plan, configuration, BEGIN, simulated=True)
    # The first arming after a change of the model translates it to machine code, once.
    armed = SimulatedShots(plan, configuration, AsDesigned(require_swings(plan, configuration)), never)
    arm_all(armed, plan)
    with open_database(database_url("", folder)) as engine:
        store = CampaignStore(engine)
        store.begin(entry)
        begun, cpu = time.perf_counter(), time.process_time()
        outcome = run_campaign(entry, configuration, store, clock, never)
        took, busy = time.perf_counter() - begun, time.process_time() - cpu
        stored = store.shots(entry.id)
    if outcome.state is not CampaignState.FINISHED or len(stored) != len(clock.times):
        raise RuntimeError(f"{outcome}")
    size = sum(one.bytes for one in stored) / len(stored)
    grown = (clock.memory[-1] - clock.memory[len(clock.memory) // 5]) / 1024
    note = f"of {len(stored)} shots; {busy:.1f} s of processor time; {size / 1e6:.2f} MB a swing"
    return [
        Row(
            TITLE, "simulated and stored", took * 1000 / len(stored), "s a thousand shots", note, at_most=60.0
        ),
        Row(TITLE, "memory gained after the first fifth", grown, "MB", at_most=20.0),
    ]


def _reported(folder: Path, shots: int) -> list[Row]:
    configuration = load_configuration(Path("shipped"))
    plan = plan_of(shots)
    entry = new_entry(plan, configuration, BEGIN, simulated=True)
    with open_database(database_url("", folder)) as engine:
        store = CampaignStore(engine)
        store.begin(entry)
        drawn = [
            replace(
                shot,
                club_speed_mps=42.9,
                attack_angle_deg=0.5,
                dynamic_loft_deg=11.1,
                strike_x_mm=0.1,
                ball_speed_mps=62.0,
                carry_side_m=-2.0 + shot.shot % 7 / 7,
                total_m=190.0,
            )
            for shot in campaign_shots(plan, Truth(), 1)
        ]
        store.add(entry, [StoredShot(shot) for shot in drawn])
        begun = time.perf_counter()
        record = load_record(store, entry)
        write_whole(
            folder / "report.html", render_campaign_report(record, findings(record.plan, record.shots))
        )
        took = time.perf_counter() - begun
    size = (folder / "report.html").stat().st_size / 1e6
    note = f"of {len(drawn)} shots, {size:.1f} MB"
    return [
        Row(TITLE, "report", took, "s", note, at_most=10.0),
        Row(TITLE, "memory of the report", _memory(folder, entry.id), "MB", note, at_most=366.0),
    ]


def _memory(folder: Path, campaign: str) -> float:
    """Return the greatest memory of the command that writes the report, MB.

    By the process itself: what `wait` reports begins with the memory of the process that started it.
    """
    file = folder / "bench.toml"
    file.write_text(f'base = "shipped"\n[bench]\ndata_dir = "{folder}"\n')
    arguments = ["--config", str(file), "campaign", "report", campaign]
    command = [sys.executable, "-c", _MEASURED, *arguments, "--output", str(folder / "again.html")]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return int(done.stderr.split()[-2]) / 1024


_MEASURED = """
import atexit, sys
from bench.commands.cli import main

def report():
    with open("/proc/self/status") as status:
        print(next(line for line in status if line.startswith("VmHWM")), file=sys.stderr)

atexit.register(report)
main(sys.argv[1:])
"""
