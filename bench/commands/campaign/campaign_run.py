"""`golfbench campaign check`, `run`, `resume`, `watch`: before and during a campaign, and its outputs."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer
from rich.console import Console

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError, Refused
from bench.base.interrupt import deferred_interrupt
from bench.commands.campaign.campaign import Id, Units, app, found_campaign, has_store, open_store
from bench.commands.campaign.campaign_new import new
from bench.commands.common import (
    Json,
    Session,
    argument,
    exit_unless,
    flag,
    option,
    require_folder,
    show_json,
    user_name,
)
from bench.store.rows import CampaignEntry, CampaignState, Hit, PromptKind, ShotNote, state_text

if TYPE_CHECKING:
    from bench.base.address import BenchSettings
    from bench.campaign.plan.carry import Measured
    from bench.campaign.plan.plan import CampaignPlan
    from bench.campaign.report.findings import Findings
    from bench.campaign.report.report_format import UnitSystem
    from bench.campaign.run.plan_requirements import Profiles
    from bench.campaign.run.runner import RunOutcome
    from bench.commands.campaign.campaign_baseline import Band, Checked
    from bench.config import Configuration
    from bench.store.campaigns import CampaignStore

app.command()(new)


def _known_plans() -> list[str]:
    from bench.campaign.plan.plan_file import campaign_names

    return campaign_names()


File = Annotated[
    Path, argument("FILE", "Plan, a TOML file, or the name of a shipped plan.", complete=_known_plans)
]
Ask = Annotated[
    bool, flag("--ask", "Also ask for club changes and feeder refills if the bench is simulated.")
]
Junit = Annotated[Path | None, option("Also write the shots as JUnit XML, for CI.", "FILE")]
ReportTo = Annotated[Path | None, option("Also write the report, HTML.", "FILE", names="--report")]
Check = Annotated[
    Path | None, option("Compare figures with the bands in this TOML file.", "BASELINE", names="--check")
]
StartedBy = Annotated[str, option("Person who starts it.", "NAME", shown="user@host", names="--by")]


class Outputs(NamedTuple):
    """Output files of a run in addition to its records."""

    json: bool
    junit: Path | None
    report: Path | None
    baseline: Sequence[Band]
    units: UnitSystem


def _outputs(
    json_: bool, junit: Path | None, report_to: Path | None, check: Path | None, units: Literal["us", "si"]
) -> Outputs:
    from bench.campaign.report.report_format import UnitSystem
    from bench.commands.campaign.campaign_baseline import read_baseline

    require_folder("--junit", junit)
    require_folder("--report", report_to)
    return Outputs(json_, junit, report_to, read_baseline(check) if check else [], UnitSystem(units))


@app.command()
def check(
    context: typer.Context,
    file: File,
    everything: Annotated[bool, flag("--all", "Print every block.")] = False,
    json_: Json = False,
) -> None:
    """Check plan and bench before anything moves; print shot order, load lists and resolution.

    Exits with 2 and lists all mistakes; with 1 if only a calibration blocks arming, or if hardware cannot
    take its shots.
    """
    from bench.calibration.archive import newest_aerodynamics
    from bench.campaign.report.preview import preview_record, show_preview
    from bench.campaign.run.plan_requirements import (
        START_SERIES,
        arming_problems,
        free_space,
        machine_refusals,
        needs,
        needs_series,
        needs_words,
    )

    plan, configuration, profiles = _checked(context, file)
    free, series = free_space(configuration.bench.data_dir), ""
    hits = Counter[Hit]()
    measured: Measured = {}
    if has_store(configuration.bench):  # creates no database
        with open_store(configuration.bench) as store:
            hits = store.hits(configuration.bench.id)
            measured = newest_aerodynamics(store.database, configuration.bench.id, plan.ball_names)
    if needs_series(plan, profiles.values()) and not configuration.lifecycle.hold_between_swings:
        series = f"On a running bench this plan needs the address held between swings. {START_SERIES}"
    warnings = [series] if series else []
    if json_:
        beside = {
            "title": plan.campaign.title,
            "needs": needs(plan)._asdict(),
            "needs_words": needs_words(plan, free),
            "free_bytes": free,
            "warnings": warnings,
            "series_warning": series,
        }
        show_json(preview_record(plan, hits) | beside)
    else:
        console = Console()
        show_preview(plan, hits, console, everything=everything)
        for line in (*needs_words(plan, free), *warnings):
            console.print(line, highlight=False, markup=False)
    problems = arming_problems(plan, configuration, datetime.now(UTC))
    if configuration.driver.name != "sim":
        problems += machine_refusals(plan, measured, monitored=configuration.launch_monitor.enabled)
    if problems:
        raise ExceptionGroup("refused by a running bench", problems)


def _checked(context: typer.Context, file: Path) -> tuple[CampaignPlan, Configuration, Profiles]:
    """Return the plan in `file`, whose swings fit its clubs, the configuration and the plan's profiles."""
    from bench.campaign.plan.plan_file import load_plan
    from bench.campaign.run.plan_requirements import require_swings

    configuration = context.ensure_object(Session).configuration()
    plan = load_plan(file, configuration)
    return plan, configuration, require_swings(plan, configuration)


@app.command()
def run(
    context: typer.Context,
    file: File,
    sim: Annotated[bool, flag("--sim", "Simulate the bench in lock-step, in this process.")] = False,
    json_: Json = False,
    junit: Junit = None,
    report_to: ReportTo = None,
    check_: Check = None,
    units: Units = "si",
    ask: Ask = False,
    by: StartedBy = "",
    expect: Annotated[str, option("Digest of the plan as checked; another plan is refused.", "DIGEST")] = "",
) -> None:
    """Run a campaign on the running bench, or simulated with --sim.

    Exits with 1 if it was not completed or a figure left its band, with 130 after Ctrl-C,
    143 after SIGTERM.
    """
    from bench.calibration.archive import newest_aerodynamics
    from bench.campaign.run.campaign_control import runner_lock
    from bench.campaign.run.runner_control import bench_calibrations, new_entry

    plan, configuration, profiles = _checked(context, file)
    if expect not in ("", plan.digest):
        action = "Run golfbench campaign check on the plan again."
        raise Refused(str(file), f"digest {plan.digest}", f"{expect}, as checked", action)
    outputs = _outputs(json_, junit, report_to, check_, units)
    with open_store(configuration.bench) as store:
        measured = newest_aerodynamics(store.database, configuration.bench.id, plan.ball_names)
        facts = {} if sim else _bench_facts(plan, configuration, measured, store)
        now = datetime.now(UTC)
        calibrations = bench_calibrations(plan, configuration, store, now)
        entry = new_entry(
            plan,
            configuration,
            now,
            simulated=sim or facts["driver"] == "sim",
            real_time=facts,
            measured=measured,
            calibrated=None if sim and not calibrations["in_force"] else calibrations,
            profiles=profiles,
        )
        with runner_lock(configuration.bench.data_dir, entry.id):  # without its file, a run is one elsewhere
            store.begin(entry)
        _run(store, entry, configuration, outputs, facts, ask=ask, by=by)


@app.command()
def resume(
    context: typer.Context,
    campaign: Id,
    file: Annotated[Path | None, argument("FILE", "Plan, to check that it is unchanged.")] = None,
    json_: Json = False,
    junit: Junit = None,
    report_to: ReportTo = None,
    check_: Check = None,
    units: Units = "si",
    ask_: Ask = False,
    by: StartedBy = "",
) -> None:
    """Resume a campaign that was paused, stopped, suspended or cut off.

    Exits with 1 if it was not completed or a figure left its band, with 130 after Ctrl-C,
    143 after SIGTERM.
    """
    from bench.campaign.plan.carry import measured_of
    from bench.campaign.plan.plan_file import plan_from_record
    from bench.campaign.run.campaign_control import ask, is_running
    from bench.campaign.run.runner_control import require_resumable

    configuration = context.ensure_object(Session).configuration()
    plan = _checked(context, file)[0] if file else None
    outputs = _outputs(json_, junit, report_to, check_, units)
    with found_campaign(context, campaign) as (store, entry):
        require_resumable(entry, store.standing(entry.id).state, configuration, plan)
        if is_running(configuration.bench.data_dir, entry.id):
            typer.echo(f"{entry.id} {ask(store, configuration.bench.data_dir, entry.id, '', by)}")
            return
        facts, location = {}, f"campaign {entry.id}"
        if entry.real_time:
            begun, measured = (
                plan_from_record(entry.plan, location),
                measured_of(entry.calibrations, location),
            )
            facts = _bench_facts(begun, configuration, measured, store, simulated=entry.simulated)
        _run(store, entry, configuration, outputs, facts, ask=ask_, by=by)


def _bench_facts(
    plan: CampaignPlan,
    configuration: Configuration,
    measured: Measured,
    store: CampaignStore,
    *,
    simulated: bool | None = None,
) -> dict[str, Any]:
    """Return the facts to record about the running bench; it can swing `plan`."""
    from bench.campaign.run.plan_requirements import calibration_versions
    from bench.campaign.run.progress import read_services
    from bench.campaign.run.runner_control import bench_facts
    from bench.network.client import BenchClient

    if configuration.notifications.file:
        read_services(Path(configuration.notifications.file))
    with BenchClient.connect(configuration) as client:
        facts = bench_facts(plan, configuration, client.status(), measured, simulated=simulated)
    clubs, now = plan.design.clubs, datetime.now(UTC)
    versions = calibration_versions(store.database, configuration, clubs, now)
    return {**facts, "calibrations": versions}


def _run(
    store: CampaignStore,
    entry: CampaignEntry,
    configuration: Configuration,
    outputs: Outputs,
    facts: Mapping[str, Any],
    *,
    ask: bool,
    by: str,
) -> None:
    from bench.campaign.plan.plan_file import plan_from_record
    from bench.campaign.report.campaign_record import load_record, note_look
    from bench.campaign.report.campaign_report import render_campaign_report
    from bench.campaign.report.findings import findings, findings_record
    from bench.commands.campaign.campaign_baseline import check_baseline, junit_xml

    plan = plan_from_record(entry.plan, f"campaign {entry.id}")
    outcome = _take(store, entry, configuration, plan, facts, ask=ask, by=by or user_name())
    record = load_record(store, entry)
    found = findings(plan, record.shots, note_look(store, record, "end of a run"), outputs.units)
    figures = findings_record(found)
    checks = check_baseline(figures, outputs.baseline)
    if outputs.report and record.shots:
        write_whole(outputs.report, render_campaign_report(record, found, outputs.units))
    if outputs.junit:
        write_whole(outputs.junit, junit_xml(entry, outcome, record.shots, checks))
    if outputs.json:
        held = [{"path": c.band.path, "value": c.value, "holds": c.holds} for c in checks]
        show_json({"campaign": entry.id, **outcome._asdict(), "baseline": held, "findings": figures})
    else:
        _tell(entry.id, outcome, found, checks, outputs.units)
    exit_unless(outcome.state is CampaignState.FINISHED and all(check.holds for check in checks))


def _take(
    store: CampaignStore,
    entry: CampaignEntry,
    configuration: Configuration,
    plan: CampaignPlan,
    facts: Mapping[str, Any],
    *,
    ask: bool,
    by: str,
) -> RunOutcome:
    """Take the shots of `entry` with a progress bar; on a running bench, send notifications."""
    from bench.campaign.run.progress import CampaignProgress, notifying
    from bench.campaign.run.runner_control import run_campaign, run_start
    from bench.campaign.run.shot_source import Watcher
    from bench.commands.campaign.campaign_terminal import (
        ProgressScreen,
        TerminalOperator,
        campaign_bar,
        mark_keys,
    )

    typer.echo(f"campaign {entry.id}", err=True)
    with deferred_interrupt(terminate=True) as asked, campaign_bar() as bar:
        asked_for = frozenset(PromptKind) if ask or not entry.simulated else frozenset({PromptKind.BENCH})
        start = run_start(by, configuration, facts)
        progress = CampaignProgress(entry, plan, ProgressScreen(bar).follow)
        file = configuration.notifications.file if entry.real_time else ""
        with (
            notifying(file, entry, progress.say) as notifier,
            mark_keys(bar, user_name(), lambda: progress.message, _marker(store, entry.id)) as keys,
        ):
            watcher = Watcher(progress, notifier)
            operator = TerminalOperator(bar, entry.id, asked_for, keys)
            return run_campaign(
                entry, configuration, store, watcher, asked.is_made, operator, start, lambda: asked.cause
            )


def _marker(store: CampaignStore, campaign: str) -> Callable[[ShotNote], None]:
    """Return a function that stores a mark in a separate store: the runner's may stop waiting for a lock."""
    from bench.store.campaigns import CampaignStore

    own = CampaignStore(store.database)
    return lambda note: own.add_note(campaign, note)


def _tell(
    campaign: str, outcome: RunOutcome, found: Findings, checks: Sequence[Checked], units: UnitSystem
) -> None:
    reached = state_text(outcome.state, outcome.reason)
    typer.echo(f"{reached}; {outcome.shots} shots, {outcome.valid} valid")
    if outcome.state in {CampaignState.STOPPED, CampaignState.SUSPENDED}:
        typer.echo(f"Next: golfbench campaign resume {campaign}")
    for section in found.sections:
        for verdict in section.verdicts:
            typer.echo(f"{verdict.headline}\n  {verdict.detail}")
    for rule in found.rules:
        typer.echo(rule.words_in(units))
    for check in checks:
        typer.echo(f"{'holds' if check.holds else 'OUTSIDE'}  {check}")


@app.command()
def watch(
    context: typer.Context,
    campaign: Annotated[
        str, argument("ID", "Campaign id or its beginning; without it the running one.")
    ] = "",
    json_: Json = False,
) -> None:
    """Show the progress of a running campaign, from any machine that reaches the bench.

    Ctrl-C ends the watching only. On the bench's own computer the key m marks the last shot.
    """
    from bench.commands.campaign.campaign_terminal import ProgressScreen, campaign_bar, mark_keys

    session = context.ensure_object(Session)
    address = session.address()

    def running() -> dict[str, Any] | None:
        found = [one for one in client.campaigns() if str(one.get("campaign")).startswith(campaign)]
        return found[0] if found else None

    with session.connect() as client, campaign_bar() as bar:
        message = running()
        if message is None:
            location = f"campaign {campaign}" if campaign else f"bench {address.bench.id}"
            action = "See golfbench campaign list."
            raise Refused(location, "no runner publishes it", "a running campaign", action)
        if json_:
            return show_json(message)
        screen, last = ProgressScreen(bar), message
        bar.console.print(f"campaign {message['campaign']}", highlight=False, markup=False, soft_wrap=True)
        with ExitStack() as stack:
            if store := _local_store(stack, address.bench, message["campaign"]):
                store_mark = _marker(store, message["campaign"])
                stack.enter_context(mark_keys(bar, user_name(), lambda: last, store_mark))
            while message is not None:
                screen.follow(message)
                last = message
                time.sleep(1.0)
                message = running()
    shots = f"{last['shots']} shots, {last['valid']} valid"
    if last["state"] in {"running", "waiting", "paused"}:
        typer.echo(f"interrupted; {shots}; its runner ended: golfbench campaign resume {last['campaign']}")
    else:
        typer.echo(f"{last['state']}; {shots}; its runner has ended")


def _local_store(stack: ExitStack, settings: BenchSettings, campaign: str) -> CampaignStore | None:
    """Open the database of `campaign` in `stack` if this machine reaches it; None otherwise."""
    if not has_store(settings):
        return None
    try:
        store = stack.enter_context(open_store(settings))
        store.entry(campaign)
    except BenchError:  # watching needs no database
        return None
    return store


def demo(
    context: typer.Context,
    output: Annotated[
        Path | None, option("New or empty folder for the files.", "DIR", shown="DATA_DIR/demo-TIME")
    ] = None,
    seed: Annotated[int, option("Seed of the shot-to-shot scatter.", low=0)] = 1,
    swings: Annotated[int, option("Number of swings.", low=1, high=200)] = 10,
    engine: Annotated[
        Literal["bench", "compiled"],
        option("bench: a running bench in real time; compiled: lock-step in this process, within seconds."),
    ] = "bench",
) -> None:
    """Compare two balls on the simulated robot: table, report and records.

    Exits with 1 if the test was not completed.
    """
    from bench.commands.campaign.demo import run_demo

    configuration = context.ensure_object(Session).configuration()
    exit_unless(run_demo(configuration, output, swings, seed, live=engine == "bench"))
