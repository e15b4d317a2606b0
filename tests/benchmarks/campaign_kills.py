"""Kill -9 the runner of a simulated campaign at random instants, resume, compare with one run through.

After each kill the database must hold shots 1 to n, n never less than before, each with its file whole; at
the end its table must be that of the uninterrupted campaign, byte for byte. Options: `--kills N`,
`--batch N` shots of a
transaction, `--blocks N` of five shots each.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.run._simulated_shots import BEGIN, SimulatedShots
from bench.campaign.run.campaign_control import runner_lock
from bench.campaign.run.plan_requirements import require_swings
from bench.campaign.run.runner import Runner
from bench.campaign.run.runner_control import course_of, new_entry
from bench.campaign.run.shot_source import Watcher
from bench.config import Configuration, database_url, load_configuration
from bench.records.shot.shot import shot_table_text
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import CampaignEntry, CampaignState
from tests.bench.campaign.as_designed import AsDesigned, arm_all
from tests.benchmarks.row import Row, numbers

SEED = 20261121
LONGEST_LIFE = 1.2
"""s, of a runner."""


def run_once(plan: CampaignPlan, configuration: Configuration, entry: CampaignEntry, batch: int) -> None:
    """Run or resume `entry` in this process."""
    profiles = require_swings(plan, configuration)
    data_dir = configuration.bench.data_dir
    with (
        SimulatedShots(plan, configuration, AsDesigned(profiles), never) as source,
        open_database(database_url("", data_dir)) as engine,
        runner_lock(data_dir, entry.id),
    ):
        runner = Runner(entry, plan, CampaignStore(engine), data_dir, source, Watcher(), batch)
        runner.run(course_of(plan, profiles, configuration.plant.robot.lie), never)


def begin(plan: CampaignPlan, shipped: Configuration, folder: Path) -> tuple[Configuration, CampaignEntry]:
    """Begin a campaign with its records in `folder`."""
    configuration = replace(shipped, bench=replace(shipped.bench, data_dir=folder))
    entry = new_entry(plan, configuration, BEGIN, simulated=True)
    with open_database(database_url("", folder)) as engine:
        CampaignStore(engine).begin(entry)
    return configuration, entry


def table(folder: Path, entry: CampaignEntry) -> tuple[str, CampaignState, int]:
    """Return the campaign's table, where it stands and its hits; check that every shot has its file."""
    with open_database(database_url("", folder)) as engine:
        store = CampaignStore(engine)
        stored, standing, hits = store.shots(entry.id), store.standing(entry.id), store.hits(entry.hit_scope)
    numbers = [one.shot.shot for one in stored]
    if numbers != list(range(1, len(numbers) + 1)):
        raise RuntimeError(f"shots {numbers}")
    for one in stored:
        if one.file and (folder / one.file).stat().st_size != one.bytes:
            raise RuntimeError(f"{one.file} is not the file that was stored")
    for one in stored[-10:]:
        if one.file:
            content = (folder / one.file).read_bytes()
            if not (content.startswith(b"PAR1") and content.endswith(b"PAR1")):
                raise RuntimeError(f"{one.file} is no whole Parquet file")
    struck = sum(number for hit, number in hits.items() if hit.kind == "ball")
    if struck != sum(one.shot.club_speed_mps is not None for one in stored):
        raise RuntimeError(f"{struck} hits of {len(stored)} shots")
    return shot_table_text([one.shot for one in stored]), standing.state, len(stored)


def kill_and_resume(
    plan: CampaignPlan, kills: int, batch: int, folder: Path, seed: int = SEED
) -> tuple[int, int, bool]:
    """Return how many kills hit a running campaign, its shots, and whether it came out as if run through."""
    through, broken = folder / "through", folder / "broken"
    shipped = load_configuration(Path("shipped"))
    random = np.random.default_rng(seed)
    context = multiprocessing.get_context("fork")
    # This process loads the model but starts no thread of its own, so that it may be forked.
    configuration, entry = begin(plan, shipped, broken)
    shots = SimulatedShots(plan, configuration, AsDesigned(require_swings(plan, configuration)), never)
    arm_all(shots, plan)
    killed, before = 0, 0
    while killed < kills:
        child = context.Process(target=run_once, args=(plan, configuration, entry, batch))
        child.start()
        time.sleep(float(random.uniform(0.0, LONGEST_LIFE)))
        if child.pid is not None and child.is_alive():
            os.kill(child.pid, signal.SIGKILL)
        child.join()
        code = child.exitcode
        child.close()
        if code == 0:
            break
        if code != -signal.SIGKILL:
            raise RuntimeError(f"a runner ended with {code}")
        killed += 1
        _, _, count = table(broken, entry)
        if count < before:
            raise RuntimeError(f"{before} shots, then {count}")
        before = count
    last = context.Process(target=run_once, args=(plan, configuration, entry, batch))
    last.start()
    last.join()
    last.close()
    other, twin = begin(plan, shipped, through)
    whole = context.Process(target=run_once, args=(plan, other, twin, 50))
    whole.start()
    whole.join()
    whole.close()
    text, state, count = table(broken, entry)
    expected, _, _ = table(through, twin)
    return killed, count, text == expected and state is CampaignState.FINISHED


def plan_of(blocks: int) -> CampaignPlan:
    """Return two balls with a control ball, a few shots that go wrong among them."""
    plan = load_plan(Path("symmetry"), load_configuration(Path("shipped")))
    return replace(
        plan,
        design=replace(plan.design, blocks=blocks),
        stop=replace(plan.stop, rule="fixed"),
        ball_handling=replace(plan.ball_handling, samples=1000),
        simulation=replace(
            plan.simulation, missing_launch=(7, 30), missed_ball=(9,), feeder_jam=(12,), guard_opened=(15,)
        ),
    )


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Kill and resume; takes some minutes."""
    given = numbers("campaign_kills", arguments, kills=200, batch=5, blocks=400)
    with tempfile.TemporaryDirectory() as folder:
        begun = time.perf_counter()
        killed, shots, same = kill_and_resume(plan_of(given.blocks), given.kills, given.batch, Path(folder))
        took = time.perf_counter() - begun
    title = "campaign kills"
    return [
        Row(title, "runners killed", killed, "", f"{took:.0f} s in all", at_least=given.kills),
        Row(title, "shots", shots, ""),
        Row(title, "table as if run through", float(same), "", "1: byte for byte", at_least=1.0),
    ]
