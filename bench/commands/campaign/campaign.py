"""`golfbench campaign ...`: plan, run, evaluate and store test series."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import typer
from rich.console import Console

from bench.base.errors import BenchError, Refused
from bench.base.interrupt import deferred_interrupt
from bench.commands.campaign.campaign_new import new
from bench.commands.common.options import Json, argument, flag, option
from bench.commands.common.session import Session, exit_unless, show_json, user_name

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
    from bench.store.records import CampaignEntry, Hit, ShotNote

app = typer.Typer(help="Campaigns (test series): plan, run, evaluate and store them.", no_args_is_help=True)
app.command()(new)


def _known_plans() -> list[str]:
    """Return the names of the shipped plans."""
    from bench.campaign.plan.plan_file import campaign_names

    return campaign_names()


def _known_campaigns(ctx: typer.Context) -> list[str]:
    """Return the ids of the stored campaigns, the newest first."""
    settings = ctx.ensure_object(Session).address().bench
    if not _has_store(settings):
        return []
    with _store(settings) as store:
        return [entry.id for entry, _, _ in store.entries()]


File = Annotated[
    Path, argument("FILE", "Plan, a TOML file, or the name of a shipped plan.", complete=_known_plans)
]
Id = Annotated[str, argument("ID", "Campaign id, or its unambiguous beginning.", complete=_known_campaigns)]
Ask = Annotated[
    bool, flag("--ask", "Also ask for club changes and feeder refills if the bench is simulated.")
]
Junit = Annotated[Path | None, option("Also write the shots as JUnit XML, for CI.", "FILE")]
ReportTo = Annotated[Path | None, option("Also write the report, HTML.", "FILE", names="--report")]
Check = Annotated[
    Path | None, option("Compare figures with the bands in this TOML file.", "BASELINE", names="--check")
]
StartedBy = Annotated[str, option("Person who starts it.", "NAME", shown="user@host", names="--by")]
Units = Annotated[
    Literal["us", "si"], option("Units of the report: yd and mph, or m and m/s.", names="--units")
]


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

    return Outputs(json_, junit, report_to, read_baseline(check) if check else [], UnitSystem(units))


@app.command()
def check(
    context: typer.Context,
    file: File,
    everything: Annotated[bool, flag("--all", "Print every block.")] = False,
    json_: Json = False,
) -> None:
    """Check plan and bench before anything moves; print shot order, load lists and resolution.

    Exits with 2 and lists all mistakes; with 1 if a calibration blocks arming.
    """
    from bench.campaign.report.preview import preview_record, show_preview
    from bench.campaign.run.plan_requirements import (
        START_SERIES,
        arming_problems,
        free_space,
        needs,
        needs_series,
        needs_words,
    )

    plan, configuration, profiles = _checked(context, file)
    free, series = free_space(configuration.bench.data_dir), ""
    hits = _hits_before(configuration)
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
    if problems := arming_problems(plan, configuration, datetime.now(UTC)):
        raise ExceptionGroup("arming blocked", problems)


def _checked(context: typer.Context, file: Path) -> tuple[CampaignPlan, Configuration, Profiles]:
    """Return the plan in `file`, whose swings fit its clubs, the configuration and the plan's profiles."""
    from bench.campaign.plan.plan_file import load_plan
    from bench.campaign.run.plan_requirements import require_swings

    configuration = context.ensure_object(Session).configuration()
    plan = load_plan(file, configuration)
    return plan, configuration, require_swings(plan, configuration)


@contextmanager
def _store(settings: BenchSettings) -> Iterator[CampaignStore]:
    """Open the campaigns of the bench."""
    from bench.base.address import database_url
    from bench.store.campaigns import CampaignStore
    from bench.store.database import open_database

    with open_database(database_url(settings.database, settings.data_dir)) as engine:
        yield CampaignStore(engine)


def _has_store(settings: BenchSettings) -> bool:
    """Return whether the bench may have campaigns; creates no database."""
    from bench.base.address import database_url
    from bench.store.database import is_there

    return is_there(database_url(settings.database, settings.data_dir))


@contextmanager
def _found(context: typer.Context, campaign: str) -> Iterator[tuple[CampaignStore, CampaignEntry]]:
    """Open the campaigns of the configured bench; yield them with the entry of `campaign`."""
    from bench.campaign.run.campaign_control import find_campaign

    settings = context.ensure_object(Session).address().bench
    if not _has_store(settings):
        found = f"no such campaign, and no database in {settings.data_dir}"
        action = "Change to the bench's folder, or put its --config before campaign."
        raise BenchError(f"campaign {campaign}", found, "the database of its bench", action)
    with _store(settings) as store:
        yield store, find_campaign(store, campaign)


def _hits_before(configuration: Configuration) -> Counter[Hit]:
    """Return the hits that the balls of the configured bench have taken; creates no database."""
    if not _has_store(configuration.bench):
        return Counter()
    with _store(configuration.bench) as store:
        return store.hits(configuration.bench.id)


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
    from bench.campaign.run.runner_control import new_entry

    plan, configuration, profiles = _checked(context, file)
    if expect not in ("", plan.digest):
        raise Refused(
            str(file),
            f"digest {plan.digest}",
            f"{expect}, as checked",
            "Run golfbench campaign check on the plan again.",
        )
    outputs = _outputs(json_, junit, report_to, check_, units)
    with _store(configuration.bench) as store:
        measured = newest_aerodynamics(store.database, configuration.bench.id, plan.ball_names)
        facts = {} if sim else _bench_facts(plan, configuration, measured, store)
        now = datetime.now(UTC)
        entry = new_entry(
            plan,
            configuration,
            now,
            simulated=sim or facts["driver"] == "sim",
            real_time=facts,
            measured=measured,
            calibrated=_calibrations(plan, configuration, store, now, sim=sim),
            profiles=profiles,
        )
        store.begin(entry)
        _run(store, entry, configuration, outputs, facts, ask=ask, by=by)


def _calibrations(
    plan: CampaignPlan, configuration: Configuration, store: CampaignStore, now: datetime, *, sim: bool
) -> dict[str, Any] | None:
    """Return the bench's calibrations in force `now`; None for a simulation without any."""
    from bench.campaign.run.runner_control import bench_calibrations

    found = bench_calibrations(plan, configuration, store, now)
    return None if sim and not found["in_force"] else found


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
    with _found(context, campaign) as (store, entry):
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
            facts = _bench_facts(begun, configuration, measured, store)
        _run(store, entry, configuration, outputs, facts, ask=ask_, by=by)


def _bench_facts(
    plan: CampaignPlan, configuration: Configuration, measured: Measured, store: CampaignStore
) -> dict[str, Any]:
    """Return the facts to record about the running bench; it can swing `plan`."""
    from bench.campaign.run.plan_requirements import calibration_versions
    from bench.campaign.run.progress import read_services
    from bench.campaign.run.runner_control import bench_facts
    from bench.network.client import BenchClient

    if configuration.notifications.file:
        read_services(Path(configuration.notifications.file))
    with BenchClient.connect(configuration) as client:
        facts = bench_facts(plan, configuration, client.status(), measured)
    bench, clubs = configuration.bench.id, plan.design.clubs
    versions = calibration_versions(store.database, bench, clubs, datetime.now(UTC))
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
    """Run `entry` and print the outcome."""
    from bench.campaign.plan.plan_file import plan_from_record
    from bench.campaign.report.campaign_record import load_record, note_look
    from bench.campaign.report.campaign_report import write_campaign_report
    from bench.campaign.report.findings import findings, findings_record
    from bench.commands.campaign.campaign_baseline import check_baseline, junit_xml
    from bench.records.telemetry.atomic_file import atomic_file
    from bench.store.records import CampaignState

    plan = plan_from_record(entry.plan, f"campaign {entry.id}")
    outcome = _take(store, entry, configuration, plan, facts, ask=ask, by=by or user_name())
    record = load_record(store, entry)
    found = findings(plan, record.shots, note_look(store, record, "end of a run"), outputs.units)
    figures = findings_record(found)
    checks = check_baseline(figures, outputs.baseline)
    if outputs.report and record.shots:
        write_campaign_report(outputs.report, record, found, outputs.units)
    if outputs.junit:
        with atomic_file(outputs.junit) as stream:
            stream.write(junit_xml(entry, outcome, record.shots, checks))
    if outputs.json:
        held = [{"path": c.band.path, "value": c.value, "holds": c.holds} for c in checks]
        show_json({"campaign": entry.id, **outcome._asdict(), "baseline": held, "findings": figures})
    else:
        _tell(outcome, found, checks, outputs.units)
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
    from bench.campaign.plan.prompts import PromptKind
    from bench.campaign.run.progress import notifying
    from bench.campaign.run.runner_control import run_campaign, run_start
    from bench.campaign.run.shot_source import Watcher
    from bench.commands.campaign.campaign_runner_screen import CampaignScreen
    from bench.commands.campaign.campaign_screen import campaign_bar
    from bench.commands.campaign.campaign_terminal import TerminalOperator, mark_keys

    typer.echo(f"campaign {entry.id}", err=True)
    with deferred_interrupt(terminate=True) as asked, campaign_bar() as bar:
        asked_for = frozenset(PromptKind) if ask or not entry.simulated else frozenset({PromptKind.BENCH})
        start = run_start(by, configuration, facts)
        screen, file = CampaignScreen(entry, plan, bar), configuration.notifications.file
        with (
            notifying(file if entry.real_time else "", entry, screen.say) as notifier,
            mark_keys(bar, user_name(), lambda: screen.message, _marker(store, entry.id)) as keys,
        ):
            watcher, operator = Watcher(screen, notifier), TerminalOperator(bar, entry.id, asked_for, keys)
            return run_campaign(
                entry, configuration, store, watcher, asked.is_made, operator, start, lambda: asked.cause
            )


def _marker(store: CampaignStore, campaign: str) -> Callable[[ShotNote], None]:
    """Return a function that stores a mark in a separate store: the runner's may stop waiting for a lock."""
    from bench.store.campaigns import CampaignStore

    own = CampaignStore(store.database)
    return lambda note: own.add_note(campaign, note)


def _tell(outcome: RunOutcome, found: Findings, checks: Sequence[Checked], units: UnitSystem) -> None:
    """Print the end of a run and its findings."""
    reason = f": {outcome.reason}" if outcome.reason else ""
    typer.echo(f"{outcome.state}{reason}; {outcome.shots} shots, {outcome.valid} valid")
    for verdicts in found.verdicts:
        for verdict in verdicts:
            typer.echo(f"{verdict.headline}\n  {verdict.detail}")
    for rule in found.rules:
        typer.echo(rule.words_in(units))
    for check in checks:
        typer.echo(f"{'holds' if check.holds else 'OUTSIDE'}  {check}")


@app.command()
def report(
    context: typer.Context,
    campaign: Id,
    output: Annotated[
        Path | None, option("File to write.", "FILE", shown="report.html next to the campaign's records")
    ] = None,
    units: Units = "si",
    issue: Annotated[bool, flag("--issue", "Issue the report: number, date and name are stored.")] = False,
    by: Annotated[str, option("Person who issues the report.", "NAME", shown="user@host")] = "",
    reason: Annotated[str, option("Reason of an amended report.", "TEXT")] = "",
    json_: Annotated[
        bool, flag("--json", "Print the same figures as JSON instead of writing the page.")
    ] = False,
) -> None:
    """Write the report of a campaign: one HTML file, verdict first.

    With --issue the report of a finished campaign gets a number, also each amendment; it is stored next to
    the report as report-R1.html.
    """
    from bench.campaign.report.campaign_record import load_record, note_look
    from bench.campaign.report.campaign_report import render_campaign_report
    from bench.campaign.report.findings import findings, findings_record
    from bench.campaign.report.report_format import UnitSystem
    from bench.campaign.report.report_tables import issue_report
    from bench.campaign.run.campaign_control import standing_now
    from bench.records.telemetry.atomic_file import atomic_file

    if issue and json_:
        action = "Issue the report, then print its figures without --issue."
        raise BenchError("campaign report", "--issue and --json", "one of the two", action)
    data_dir = context.ensure_object(Session).address().bench.data_dir
    with _found(context, campaign) as (store, entry):
        record = load_record(store, entry)
        if not record.shots:
            raise Refused(f"campaign {entry.id}", "no shots yet", "at least one", "Run or resume it.")
        if issue:
            issue_event = issue_report(record, by or user_name(), reason, datetime.now(UTC))
            record = replace(record, events=[*record.events, issue_event])
        looks = note_look(store, record, "report")
        found = findings(record.plan, record.shots, looks, UnitSystem(units))
        if json_:
            return show_json({"campaign": entry.id, "findings": findings_record(found)})
        record = replace(record, standing=standing_now(data_dir, entry.id, record.standing))
        path = output or data_dir / "campaigns" / entry.id / "report.html"
        page = render_campaign_report(record, found, UnitSystem(units)).encode()
        # Each issue keeps its page. It is stored once its pages are written, and before they are renamed.
        issued = path.with_name(f"{path.stem}{record.number.removeprefix(entry.id)}{path.suffix}")
        with ExitStack() as pages:
            for file in (path, issued) if issue else (path,):
                stream = pages.enter_context(atomic_file(file))
                stream.write(page)
                stream.flush()
            if issue:
                store.note_event(entry.id, record.issues[-1])
    typer.echo(str(path))
    if issue:
        typer.echo(f"issued as {record.number}: {issued}")


@app.command()
def verify(
    context: typer.Context,
    campaign: Id,
    page: Annotated[
        Path | None,
        option("Page to verify.", "FILE", shown="report.html next to the records", names="--report"),
    ] = None,
) -> None:
    """Verify a report: compute its digest and every figure again from the records.

    Exits with 1 and names what differs.
    """
    from bench.campaign.report.campaign_record import load_record
    from bench.campaign.report.verification import missing_records, verify_page

    data_dir = context.ensure_object(Session).address().bench.data_dir
    with _found(context, campaign) as (store, entry):
        record = load_record(store, entry)
        missing = missing_records(store.shots(record.entry.id), data_dir)
    path = page or data_dir / "campaigns" / record.entry.id / "report.html"
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        action = f"Write it: golfbench campaign report {record.entry.id}."
        raise BenchError(str(path), error.strerror or "not readable", "a report", action) from error
    except UnicodeDecodeError as error:
        raise BenchError(
            str(path), "no text", "a report (HTML)", "Give the path of the HTML file."
        ) from error
    result = verify_page(record, text, str(path))
    for line in (*missing, *result.differences):
        typer.echo(line)
    typer.echo(f"digest of plan and data {result.digest}")
    page_words = (
        ", the page compared"
        if result.page
        else "; the page itself, written by another version of golfbench, is not compared"
    )
    held = not (missing or result.differences)
    typer.echo(
        f"{'verified' if held else 'NOT VERIFIED'}: {result.figures} figures computed again{page_words}"
    )
    exit_unless(held)


def _request(context: typer.Context, campaign: str, request: str) -> None:
    from bench.campaign.run.campaign_control import ask

    data_dir = context.ensure_object(Session).address().bench.data_dir
    with _found(context, campaign) as (store, entry):
        typer.echo(f"{entry.id} {ask(store, data_dir, entry.id, request, user_name())}")


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
    from bench.commands.campaign.campaign_screen import ProgressScreen, campaign_bar
    from bench.commands.campaign.campaign_terminal import mark_keys

    session = context.ensure_object(Session)
    address = session.address()

    def running() -> dict[str, Any] | None:
        found = [one for one in client.campaigns() if str(one.get("campaign")).startswith(campaign)]
        return found[0] if found else None

    with session.connect() as client, campaign_bar() as bar:
        message = running()
        if message is None:
            location = f"campaign {campaign}" if campaign else f"bench {address.bench.id}"
            raise Refused(
                location, "no runner publishes it", "a running campaign", "See golfbench campaign list."
            )
        if json_:
            return show_json(message)
        screen, event, stood, last = ProgressScreen(bar), None, None, message
        bar.console.print(f"campaign {message['campaign']}", highlight=False, markup=False, soft_wrap=True)
        with ExitStack() as stack:
            if store := _local_store(stack, address.bench, message["campaign"]):
                store_mark = _marker(store, message["campaign"])
                stack.enter_context(mark_keys(bar, user_name(), lambda: last, store_mark))
            while message is not None:
                screen.show(message)
                if message["event"] != event and (event := message["event"]):
                    screen.say(event["text"])
                if (message["state"], message["reason"]) != stood and message["reason"]:
                    screen.say(f"{message['state']}: {message['reason']}")
                last, stood = message, (message["state"], message["reason"])
                time.sleep(1.0)
                message = running()
    shots = f"{last['shots']} shots, {last['valid']} valid"
    if last["state"] in {"running", "waiting", "paused"}:
        typer.echo(f"interrupted; {shots}; its runner ended: golfbench campaign resume {last['campaign']}")
    else:
        typer.echo(f"{last['state']}; {shots}; its runner has ended")


def _local_store(stack: ExitStack, settings: BenchSettings, campaign: str) -> CampaignStore | None:
    """Open the database of `campaign` in `stack` if this machine reaches it; None otherwise."""
    if not _has_store(settings):
        return None
    try:
        store = stack.enter_context(_store(settings))
        store.entry(campaign)
    except BenchError:  # watching needs no database
        return None
    return store


@app.command()
def mark(
    context: typer.Context,
    campaign: Id,
    comment: Annotated[str, argument("COMMENT", "Observation.")] = "",
    shot: Annotated[int | None, option("Shot number.", "NUMBER", shown="the last one")] = None,
    by: Annotated[str, option("Person who saw it.", "NAME", shown="user@host")] = "",
) -> None:
    """Mark a shot, with a comment; it still counts. The report shows marks and comments."""
    from bench.store.records import ShotNote

    with _found(context, campaign) as (store, entry):
        number = store.last_shot(entry.id) if shot is None else shot
        store.add_note(entry.id, ShotNote(number, datetime.now(UTC), by or user_name(), comment))
    typer.echo(f"shot {number} marked{f': {comment}' if comment else ''}")


@app.command()
def exclude(
    context: typer.Context,
    campaign: Id,
    shot: Annotated[int, argument("SHOT", "Number of the shot.")],
    reason: Annotated[str, option("Reason.", "TEXT")],
    by: Annotated[str, option("Person responsible.", "NAME", shown="user@host")] = "",
    undo: Annotated[bool, flag("--undo", "Let an excluded shot count again.")] = False,
) -> None:
    """Exclude a shot from the results, with the reason. Nothing is deleted; the report lists it.

    A running campaign does not repeat it.
    """
    from bench.campaign.report.campaign_record import ISSUE, exclude_shot

    with _found(context, campaign) as (store, entry):
        exclude_shot(store, entry.id, shot, reason, by or user_name(), datetime.now(UTC), undo=undo)
        is_issued = any(event.kind == ISSUE for event in store.events(entry.id))
    typer.echo(f"shot {shot} {'counts again' if undo else 'excluded'}: {reason.strip()}")
    if is_issued:
        typer.echo(
            "The issued report needs an amendment: golfbench campaign report ID --issue --reason TEXT."
        )


@app.command()
def answer(
    context: typer.Context,
    campaign: Id,
    by: Annotated[str, option("Person who did it.", "NAME", shown="user@host")] = "",
    balls: Annotated[
        int | None, option("Number of balls loaded, compared with the load list.", "COUNT", low=0)
    ] = None,
) -> None:
    """Confirm a campaign's prompt: the club is mounted, the feeder is filled."""
    from bench.campaign.run.campaign_control import answer

    data_dir, now = context.ensure_object(Session).address().bench.data_dir, datetime.now(UTC)
    with _found(context, campaign) as (store, entry):
        text, goes_on = answer(store, data_dir, entry.id, by or user_name(), now, balls)
    after = "continues" if goes_on else f"has no runner: golfbench campaign resume {entry.id}"
    typer.echo(f"done: {text}\n{entry.id} {after}")


@app.command()
def pause(context: typer.Context, campaign: Id) -> None:
    """Pause a running campaign after the current shot; its runner keeps the bench."""
    _request(context, campaign, "pause")


@app.command()
def stop(context: typer.Context, campaign: Id) -> None:
    """Stop a running campaign after the current shot; it can be resumed."""
    _request(context, campaign, "stop")


@app.command()
def abort(
    context: typer.Context,
    campaign: Id,
    yes: Annotated[bool, option("Do not ask for confirmation.", names=("--yes", "-y"))] = False,
) -> None:
    """Abort a campaign at once, after a confirmation. It cannot be resumed."""
    with _found(context, campaign) as (store, entry):
        state, shots = store.standing(entry.id).state, len(store.shots(entry.id))
    if not yes:
        question = f"Abort campaign {entry.id} ({state}, {shots} shots)? It cannot be resumed."
        try:
            confirmed = typer.confirm(question, err=True)
        except typer.Abort:  # end of input
            confirmed = False
        if not confirmed:
            action = f"golfbench campaign abort --yes {entry.id}"
            raise Refused(f"campaign {entry.id}", "not aborted", "a confirmation", action)
    _request(context, entry.id, "abort")


@app.command()
def air(
    context: typer.Context,
    temperature: Annotated[float | None, option("Temperature, deg C.", "C")] = None,
    pressure: Annotated[float | None, option("Station pressure, not reduced to sea level.", "HPA")] = None,
    humidity: Annotated[float | None, option("Relative humidity.", "PERCENT")] = None,
    by: Annotated[str, option("Person or instrument that read it.", "NAME", shown="user@host")] = "",
) -> None:
    """Enter a reading of the air at the bench, or show the newest one.

    Shots on hardware use it from then on, for as long as the plan allows ([air] valid_for).
    """
    from bench.store.records import AirReading
    from sim.aerodynamics import Air

    address = context.ensure_object(Session).address()
    bench = address.bench.id
    given = {"--temperature": temperature, "--pressure": pressure, "--humidity": humidity}
    if missing := [name for name, value in given.items() if value is None]:
        if len(missing) < len(given):
            raise BenchError(
                "air",
                f"no {', '.join(missing)}",
                "all three values",
                f"Add the options {', '.join(missing)}.",
            )
    with _store(address.bench) as store:
        if temperature is not None and pressure is not None and humidity is not None:
            try:
                read = Air(temperature + 273.15, 100.0 * pressure, humidity / 100.0)
            except ValueError as error:
                raise BenchError(
                    "air",
                    f"{temperature} deg C, {pressure} hPa, {humidity} %",
                    str(error),
                    "Correct the value of this reading.",
                ) from None
            figures = read.temperature, read.pressure, read.relative_humidity
            reading = AirReading(bench, datetime.now(UTC), *figures, by or user_name())
            store.add_air(reading)
        elif not (found := store.newest_air(bench, datetime(1970, 1, 1, tzinfo=UTC))):
            typer.echo("No reading of the air yet.")
            return
        else:
            reading = found
    now = reading.air
    typer.echo(
        f"{now.temperature - 273.15:.1f} deg C, {now.pressure / 100:.1f} hPa, "
        f"{100 * now.relative_humidity:.0f} %; read {reading.date:%Y-%m-%d %H:%M} UTC by {reading.by}"
    )


@app.command("list")
def list_campaigns(
    context: typer.Context,
    bench: Annotated[
        str | None, option("Campaigns of this bench only.", "ID", shown="all in the database")
    ] = None,
    json_: Json = False,
) -> None:
    """Show the campaigns in the database, the newest first.

    Excluded: hit outside the delivery's bounds, or excluded by hand.
    """
    from bench.campaign.run.campaign_control import standing_now
    from bench.commands.campaign.campaign_list import listing, listing_record

    address = context.ensure_object(Session).address()
    found = []
    if _has_store(address.bench):
        with _store(address.bench) as store:
            found = [
                (entry, standing_now(address.bench.data_dir, entry.id, standing), counts)
                for entry, standing, counts in store.entries()
                if bench in (None, entry.bench)
            ]
    if json_:
        show_json(listing_record(found))
    elif found:
        console = Console()
        console.print(listing(found, console), crop=False)
    else:
        typer.echo("No campaigns yet." if bench is None else f"No campaigns of bench {bench} yet.")


@app.command()
def export(
    context: typer.Context,
    campaign: Id,
    format_: Annotated[Literal["csv"], option("Output format.", names="--format")] = "csv",
    output: Annotated[Path | None, option("File to write.", "FILE", shown="standard output")] = None,
) -> None:
    """Export a campaign's shots, one row each."""
    from bench.campaign.report.campaign_record import with_exclusions
    from bench.records.shot.shot import shot_table_text, write_shot_table

    with _found(context, campaign) as (store, entry):
        taken = [stored.shot for stored in store.shots(entry.id)]
        shots = with_exclusions(taken, store.exclusions(entry.id))
    if output is None:
        typer.echo(shot_table_text(shots), nl=False)
    else:
        write_shot_table(output, shots)
