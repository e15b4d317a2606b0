"""Runs every campaign that comes with golfbench in full, simulated, and tells its time and first verdict."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.campaign.campaign_record import load_record
from bench.campaign.campaign_report import write_campaign_report
from bench.campaign.findings import findings
from bench.campaign.operate import new_entry, run_simulated
from bench.campaign.plan_file import campaign_names, load_plan
from bench.campaign.runner import Watcher
from bench.campaign.simulated import BEGIN
from bench.config import database_url, load_configuration
from bench.simulation.swing_operator import never
from bench.store.campaigns import CampaignState, CampaignStore
from bench.store.database import open_database
from tests.benchmarks.row import Row

TITLE = "campaign examples"


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Run those named in `arguments`, by default all; about a minute."""
    return [_run(name) for name in arguments or campaign_names()]


def _run(name: str) -> Row:
    shipped = load_configuration(Path("bag" if name in {"bag", "wedge"} else "shipped"))
    with tempfile.TemporaryDirectory() as folder:
        configuration = replace(shipped, bench=replace(shipped.bench, data_dir=Path(folder)))
        plan = load_plan(Path(name), configuration)
        entry = new_entry(plan, configuration, BEGIN, simulated=True)
        with open_database(database_url("", Path(folder))) as engine:
            store = CampaignStore(engine)
            store.begin(entry)
            begun = time.perf_counter()
            outcome = run_simulated(entry, configuration, store, Watcher(), never)
            took = time.perf_counter() - begun
            record = load_record(store, entry)
        found = findings(plan, record.shots)
        write_campaign_report(Path(folder) / "report.html", record, found)
    if outcome.state is not CampaignState.FINISHED:
        raise RuntimeError(f"{name}: {outcome}")
    return Row(TITLE, name, took, "s", f"{outcome.shots} shots; {found.verdicts[0][0].headline}")
