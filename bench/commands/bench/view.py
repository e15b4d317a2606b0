"""`golfbench view` at the command line: a running bench, a swing, a series, on the screen or into a file."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError
from bench.base.interrupt import stop_on_signals
from bench.commands.common import Session, flag, option, progress_bar

if TYPE_CHECKING:
    import rerun as rr

    from bench.golfer.golfer_file import GolferSwing
    from bench.records.shot.shot import ShotRecord
    from bench.viewer.rerun_recording import Layout
    from sim.plant import PlantParameters

_TURN = 0.2
"""Period of checking that the window is open (s)."""


def view(
    context: typer.Context,
    shot: Annotated[Path | None, option("Show a swing's record, .parquet.", "RECORD")] = None,
    campaign: Annotated[
        list[Path] | None, option("Show a series: a folder of records, or a record; repeatable.", "PATH")
    ] = None,
    golfer: Annotated[
        Path | None,
        option("Show a measured golfer, NAME.golfer.toml, next to the recorded swings.", "GOLFER"),
    ] = None,
    save: Annotated[Path | None, option("Write a Rerun file, .rrd; no window unless --web.", "FILE")] = None,
    web: Annotated[bool, flag("--web", "Show it in a browser on this machine.")] = False,
) -> None:
    """Show a running bench, a past swing or a series in Rerun, on this machine only.

    A live view ends with Ctrl-C or when its window is closed; it reconnects if the bench restarts.
    """
    if shot is not None and campaign:
        raise BenchError(
            "--shot and --campaign", "both options", "one of the two", "Leave out --shot or --campaign."
        )
    if golfer is not None and shot is None and not campaign:
        found, expected = "without --shot or --campaign", "a recorded swing next to it"
        raise BenchError("--golfer", found, expected, "Add --shot RECORD.parquet or --campaign NAME.")
    if save is not None and save.suffix != ".rrd":
        raise BenchError("--save", str(save), "a name that ends in .rrd", "Name it so, or golfbench export.")
    with ExitStack() as stack:
        if shot is not None or campaign:
            _view_records(stack, shot, campaign or [], golfer, save, web)
        else:
            _view_bench(stack, context.ensure_object(Session), save, web)


# Records ---------------------------------------------------------------------------------------------


def _view_records(
    stack: ExitStack,
    shot: Path | None,
    campaign: Sequence[Path],
    golfer: Path | None,
    save: Path | None,
    web: bool,
) -> None:
    import rerun as rr

    from bench.viewer.rerun_recording import layout_for, log_shots, write_recording
    from bench.viewer.window import RerunWindow

    with progress_bar() as progress:
        records, plant, name = _read(shot, campaign, progress)
        swing = None if golfer is None else _golfer(golfer, records, plant)
        if save is not None:
            write_recording(save, records, plant, name, swing)
            typer.echo(f"written: {save}")
            if not web:
                return
        window = stack.enter_context(RerunWindow(web=web))
        recording = _recording(stack, name, [rr.GrpcSink(window.url)], layout_for(records))
        task = progress.add_task("showing", total=len(records))
        log_shots(recording, records, plant, lambda: progress.advance(task), swing)
        recording.flush(timeout_sec=60.0)
    if window.page is not None:
        typer.echo(window.page)
    with stop_on_signals() as wish:
        while window.alive and not wish.wait(_TURN):
            pass


def _read(
    shot: Path | None, campaign: Sequence[Path], progress: Any
) -> tuple[list[ShotRecord], PlantParameters, str]:
    """Return the shots, the plant of the first, and a name for them."""
    from bench.records.shot.recorded_shot import read_shot
    from bench.records.telemetry.record_file import record_files

    files = [shot] if shot is not None else record_files(campaign)
    task = progress.add_task("reading", total=len(files))
    read = []
    for number, file in enumerate(files, start=1):
        read.append(read_shot(file, number))
        progress.advance(task)
    name = str(shot) if shot is not None else ", ".join(map(str, campaign))
    return [recorded.record for recorded in read], read[0].plant, name


def _golfer(path: Path, records: Sequence[ShotRecord], plant: PlantParameters) -> GolferSwing:
    """Return the golfer in `path`, who is aligned at the ball with at least one of `records`."""
    from bench.golfer.comparison import require_club
    from bench.golfer.golfer_file import load_golfer
    from bench.viewer.rerun_recording import impact_time

    golfer = load_golfer(path)
    require_club(golfer)
    if all(impact_time(record, plant) is None for record in records):
        found, expected = "no recorded swing reaches the ball", "a swing through the ball's position"
        raise BenchError("--golfer", found, expected, "Choose another record, or leave --golfer out.")
    return golfer


# A running bench -------------------------------------------------------------------------------------


def _view_bench(stack: ExitStack, options: Session, save: Path | None, web: bool) -> None:
    import rerun as rr

    from bench.network.zenoh_session import close_session, open_client
    from bench.records.shot.recorded_shot import FlightConditions
    from bench.viewer.blueprint import live_blueprint
    from bench.viewer.feed import Feed
    from bench.viewer.rerun_recording import Layout
    from bench.viewer.viewer import FILE_PERIOD, PERIOD, LiveView, age_words, warm_up
    from bench.viewer.window import RerunWindow

    c = options.configuration()
    session = open_client(c.network, c.bench.id)  # first: without a bench it fails at once
    stack.callback(close_session, session)
    around = FlightConditions(c.air, c.wind, c.turf)
    warm_up(c.plant, around)
    feed = stack.enter_context(Feed(session, c.bench.id))
    wish = stack.enter_context(stop_on_signals())
    window = stack.enter_context(RerunWindow(web=web)) if web or save is None else None
    sinks: list[Any] = [] if window is None else [rr.GrpcSink(window.url)]
    if save is not None:
        # No table of contents at its end: that would be kept in memory, and a file cut short is readable so.
        sinks.append(rr.FileSink(_writable(save), write_footer=False))
    layout = Layout("golfbench_live", live_blueprint())
    recording = _recording(stack, f"bench {c.bench.id}", sinks, layout)
    live = LiveView(recording, feed, c.bench.id, c.plant, around)
    if window is not None and window.page is not None:
        typer.echo(window.page)
    typer.echo(f"showing bench {c.bench.id}; Ctrl-C ends it", err=True)
    period = FILE_PERIOD if window is None else PERIOD
    while not wish.is_made() and (window is None or window.alive):
        began = time.monotonic()
        live.turn(period)
        wish.wait(max(0.0, period - (time.monotonic() - began)))
    live.turn(0.0)
    recording.flush(timeout_sec=2.0)
    a = feed.account
    typer.echo(
        f"{a.batches} batches, {a.lost_batches} lost, {a.lost_cycles} cycles lost in the ring; age at the "
        f"subscriber {age_words(live.to_subscriber)}, in Rerun {age_words(live.to_rerun)} (the last minute)",
        err=True,
    )


def _writable(path: Path) -> Path:
    """Return `path` after checking that it can be written: Rerun does not report it."""
    try:
        with path.open("wb"):
            return path
    except OSError as error:
        raise NotStored(
            str(path), error.strerror or str(error), "a file that can be written", "Give --save another path."
        ) from None


def _recording(stack: ExitStack, name: str, sinks: Sequence[Any], layout: Layout) -> rr.RecordingStream:
    import rerun as rr

    recording = rr.RecordingStream(layout.application)
    stack.callback(recording.disconnect)
    recording.set_sinks(*sinks, default_blueprint=layout.blueprint)
    recording.send_recording_name(name)
    return recording
