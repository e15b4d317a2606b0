"""`golfbench campaign ...`: stored campaigns, their reports, marks and requests to a running one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console

from bench.base.address import BenchSettings, database_url
from bench.base.atomic_file import atomic_file
from bench.base.errors import BenchError, Refused
from bench.base.from_toml import read_text
from bench.commands.common import (
    Json,
    Session,
    argument,
    exit_unless,
    flag,
    option,
    progress_of,
    show_json,
    user_name,
    write_text,
)
from bench.records.shot.shot import shot_table_text
from bench.store.rows import MAX_COMMENT_LENGTH, AirReading, CampaignEntry, ShotNote, amendment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from bench.store.campaigns import CampaignStore, StoredShot

app = typer.Typer(help="Campaigns (test series): plan, run, evaluate and store them.", no_args_is_help=True)


def _known_campaigns(ctx: typer.Context) -> list[str]:
    """Return the ids of the stored campaigns, the newest first."""
    settings = ctx.ensure_object(Session).address().bench
    if not has_store(settings):
        return []
    with open_store(settings) as store:
        return [entry.id for entry, _, _ in store.entries()]


Id = Annotated[str, argument("ID", "Campaign id, or its unambiguous beginning.", complete=_known_campaigns)]
Units = Annotated[
    Literal["us", "si"], option("Units of the report: yd and mph, or m and m/s.", names="--units")
]


@contextmanager
def open_store(settings: BenchSettings) -> Iterator[CampaignStore]:
    """Open the campaigns of the bench."""
    from bench.store.campaigns import CampaignStore
    from bench.store.database import open_database

    with open_database(database_url(settings.database, settings.data_dir)) as engine:
        yield CampaignStore(engine)


def has_store(settings: BenchSettings) -> bool:
    """Return whether the bench may have campaigns; creates no database."""
    from bench.store.database import is_there

    return is_there(database_url(settings.database, settings.data_dir))


@contextmanager
def found_campaign(context: typer.Context, campaign: str) -> Iterator[tuple[CampaignStore, CampaignEntry]]:
    """Open the campaigns of the configured bench; yield them with the entry of `campaign`."""
    from bench.campaign.run.campaign_control import find_campaign

    settings = context.ensure_object(Session).address().bench
    if not has_store(settings):
        found = f"no such campaign, and no database in {settings.data_dir}"
        action = "Change to the bench's folder, or put its --config before campaign."
        raise BenchError(f"campaign {campaign}", found, "the database of its bench", action)
    with open_store(settings) as store:
        yield store, find_campaign(store, campaign)


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
    wear: Annotated[bool, flag("--wear", "Add a chart of the robot's worn parts, from the records.")] = False,
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

    if issue and json_:
        action = "Issue the report, then print its figures without --issue."
        raise BenchError("campaign report", "--issue and --json", "one of the two", action)
    data_dir = context.ensure_object(Session).address().bench.data_dir
    with found_campaign(context, campaign) as (store, entry):
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
        worn = _worn_parts(store.shots(entry.id), data_dir) if wear else None
        page = render_campaign_report(record, found, UnitSystem(units), worn).encode()
        # Each issue keeps its page. It is stored once its pages are written, and before they are renamed.
        issued = path.parent / f"{path.stem}{record.number.removeprefix(entry.id)}{path.suffix}"
        with ExitStack() as pages:
            for file in (path, issued) if issue else (path,):
                stream = pages.enter_context(atomic_file(file))
                stream.write(page)
                stream.flush()
            if issue:
                store.note_issue(entry.id, record.issues[-1], len(record.issues))
    typer.echo(str(path))
    if issue:
        typer.echo(f"issued as {record.number}: {issued}")


def _worn_parts(stored: Sequence[StoredShot], data_dir: Path) -> Figure:
    from bench.commissioning.swings.wear import MAX_FITTED, fitted_parts, wear_plot

    files = [data_dir / one.file for one in stored if one.file]
    if not files:
        raise BenchError("--wear", "no records of swings", "records", "Write the report without --wear.")
    with progress_of("fitting parts", min(len(files), MAX_FITTED)) as show:
        return wear_plot(*fitted_parts(files, show))


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
    with found_campaign(context, campaign) as (store, entry):
        record = load_record(store, entry)
        missing = missing_records(store.shots(record.entry.id), data_dir)
    path = page or data_dir / "campaigns" / record.entry.id / "report.html"
    text = read_text(path, "a report", f"Write it: golfbench campaign report {record.entry.id}.")
    result = verify_page(record, text, str(path))
    for line in (*missing, *result.differences):
        typer.echo(line)
    typer.echo(f"digest of plan and data {result.digest}")
    other = "; the page itself, written by another version of golfbench, is not compared"
    page_words = ", the page compared" if result.page else other
    held = not (missing or result.differences)
    verdict = "verified" if held else "NOT VERIFIED"
    typer.echo(f"{verdict}: {result.figures} figures computed again{page_words}")
    exit_unless(held)


def _request(context: typer.Context, campaign: str, request: str) -> None:
    from bench.campaign.run.campaign_control import ask

    data_dir = context.ensure_object(Session).address().bench.data_dir
    with found_campaign(context, campaign) as (store, entry):
        typer.echo(f"{entry.id} {ask(store, data_dir, entry.id, request, user_name())}")


@app.command()
def mark(
    context: typer.Context,
    campaign: Id,
    comment: Annotated[str, argument("COMMENT", "Observation, up to 200 characters.")] = "",
    shot: Annotated[int | None, option("Shot number.", "NUMBER", shown="the last one")] = None,
    by: Annotated[str, option("Person who saw it.", "NAME", shown="user@host")] = "",
) -> None:
    """Mark a shot, with a comment; it still counts. The report shows marks and comments."""
    if len(comment) > MAX_COMMENT_LENGTH:
        found, expected = f"a comment of {len(comment)} characters", f"up to {MAX_COMMENT_LENGTH}"
        raise Refused(f"campaign {campaign}", found, expected, "Write the comment in short.")
    with found_campaign(context, campaign) as (store, entry):
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

    with found_campaign(context, campaign) as (store, entry):
        exclude_shot(store, entry.id, shot, reason, by or user_name(), datetime.now(UTC), undo=undo)
        is_issued = any(event.kind == ISSUE for event in store.events(entry.id))
    typer.echo(f"shot {shot} {'counts again' if undo else 'excluded'}: {reason.strip()}")
    if is_issued:
        typer.echo(f"The issued report needs an amendment: {amendment(entry.id)}")


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
    with found_campaign(context, campaign) as (store, entry):
        text, goes_on = answer(store, data_dir, entry.id, by or user_name(), now, balls)
    after = "continues" if goes_on else f"has no runner: golfbench campaign resume {entry.id}"
    typer.echo(f"done: {text}\n{entry.id} {after}")


@app.command()
def pause(context: typer.Context, campaign: Id) -> None:
    """Pause a running campaign after the current shot; its runner waits, without the lease."""
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
    with found_campaign(context, campaign) as (store, entry):
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


_AIR = {
    "--temperature": (-40.0, 60.0, "deg C"),
    "--pressure": (200.0, 1200.0, "hPa"),
    "--humidity": (1.0, 100.0, "%"),
}
"""Bounds of a reading of the air, those of `sim.ball.Air`; a humidity below 1 is a share, not per cent."""


@app.command()
def air(
    context: typer.Context,
    temperature: Annotated[float | None, option("Temperature, deg C.", "C")] = None,
    pressure: Annotated[float | None, option("Station pressure, not reduced to sea level.", "HPA")] = None,
    humidity: Annotated[float | None, option("Relative humidity.", "PERCENT")] = None,
    by: Annotated[str, option("Person or instrument that read it.", "NAME", shown="user@host")] = "",
) -> None:
    """Enter a reading of the air at the bench, or show the newest one.

    Shots on hardware use it for one hour.
    """
    from sim.ball import Air

    address = context.ensure_object(Session).address()
    bench = address.bench.id
    given = {"--temperature": temperature, "--pressure": pressure, "--humidity": humidity}
    missing = ", ".join(name for name, value in given.items() if value is None)
    if missing and missing != ", ".join(given):
        raise BenchError("air", f"no {missing}", "all three values", f"Add the options {missing}.")
    for name, value in given.items():
        low, high, unit = _AIR[name]
        if value is not None and not low <= value <= high:
            expected = f"{low:g} to {high:g} {unit}"
            raise BenchError(f"air {name}", f"{value:g}", expected, f"Enter the reading in {unit}.")
    with open_store(address.bench) as store:
        if temperature is not None and pressure is not None and humidity is not None:
            read = Air(round(temperature + 273.15, 6), 100.0 * pressure, humidity / 100.0)
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
def list_campaigns(context: typer.Context, json_: Json = False) -> None:
    """Show the campaigns in the database, the newest first.

    Excluded: hit outside the delivery's bounds, or excluded by hand.
    """
    from bench.campaign.run.campaign_control import standing_now
    from bench.commands.campaign.campaign_terminal import listing, listing_record

    address = context.ensure_object(Session).address()
    found = []
    if has_store(address.bench):
        with open_store(address.bench) as store:
            found = [
                (entry, standing_now(address.bench.data_dir, entry.id, standing), counts)
                for entry, standing, counts in store.entries()
            ]
    if json_:
        show_json(listing_record(found))
    elif found:
        console = Console()
        console.print(listing(found, console), crop=False)
    else:
        typer.echo("No campaigns yet.")


@app.command()
def export(
    context: typer.Context,
    campaign: Id,
    format_: Annotated[Literal["csv"], option("Output format.", names="--format")] = "csv",
    output: Annotated[Path | None, option("File to write.", "FILE", shown="standard output")] = None,
) -> None:
    """Export a campaign's shots, one row each."""
    from bench.campaign.report.campaign_record import with_exclusions

    with found_campaign(context, campaign) as (store, entry):
        taken = [stored.shot for stored in store.shots(entry.id)]
        shots = with_exclusions(taken, store.exclusions(entry.id))
    write_text(shot_table_text(shots), output)
