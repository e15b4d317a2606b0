"""The live view of a publish-only bench, into a file that is read back."""

from __future__ import annotations

import gc
import json
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr

from bench.base.lifecycle import Cause, Phase, State
from bench.network.zenoh_session import open_client
from bench.records.shot.recorded_shot import FlightConditions, flight_of, shot_of_cycles, shot_to_json
from bench.records.shot.shot import ShotRecord
from bench.records.telemetry.cycle_record import CYCLE
from bench.records.telemetry.record_file import read_swing, write_swing
from bench.viewer.feed import Feed
from bench.viewer.viewer import LiveView, ViewClock, event_text, loop_rows
from sim.ball import Ball
from sim.plant import PlantParameters, Site
from sim.robot import RobotParameters
from tests.bench.records.telemetry.fake_bench import BENCH, FakeBench, fake_bench, loopback
from tests.bench.records.telemetry.read_recording import Recording


def cycles(first_tick: int, count: int, start: float) -> np.ndarray:
    made = np.zeros(count, CYCLE)
    made["tick"] = first_tick + np.arange(count)
    made["time"] = start + np.arange(count) / 1024
    return made


def test_view_clock_starts_at_zero_and_keeps_exact_steps() -> None:
    clock = ViewClock()
    first = clock.location(cycles(500, 20, 1000.0), 5000.0)
    assert not first.hole
    assert np.array_equal(first.time, np.arange(20) / 1024)
    following = clock.location(cycles(520, 20, 1000.0 + 20 / 1024), 5123.0)  # the calendar does not matter
    assert not following.hole
    assert np.array_equal(following.time, np.arange(20, 40) / 1024)
    assert clock.now == 39 / 1024
    assert clock.of_loop(1001.0) == 1.0
    assert clock.utc(first.time)[[0, -1]] == pytest.approx([5000.0 - 19 / 1024, 5000.0])


def test_view_clock_missing_cycles_leave_hole() -> None:
    clock = ViewClock()
    clock.location(cycles(1, 20, 0.0), 5000.0)
    later = clock.location(cycles(1025, 20, 1.0), 5001.0)
    assert later.hole
    assert later.time[0] == 1.0


def test_view_clock_new_loop_continues_after_calendar_gap() -> None:
    clock = ViewClock()
    clock.location(cycles(9000, 20, 300.0), 5000.0)
    anew = clock.location(cycles(1, 20, 0.0), 5008.0)
    assert anew.hole
    assert anew.time[-1] == pytest.approx(8.0 + 19 / 1024)
    assert np.allclose(np.diff(anew.time), 1 / 1024)


def test_view_clock_earlier_calendar_never_runs_backwards() -> None:
    clock = ViewClock()
    end = clock.location(cycles(9000, 20, 300.0), 5000.0).time[-1]
    anew = clock.location(cycles(1, 20, 0.0), 4000.0)
    assert anew.time[0] > end


Cycles = np.ndarray[Any, Any]
HURRY = 15.0


@pytest.fixture(scope="module")
def plant(robot: RobotParameters) -> PlantParameters:
    site = Site(ball_x=0.2315, ball_y=-1.514, ground=-1.57)
    return replace(PlantParameters(), robot=robot, site=site, ball=Ball(name="tour"))


class Watched:
    """A bench, a view of it, and the file it goes to."""

    def __init__(self, bench: FakeBench, view: LiveView, file: Path, stream: rr.RecordingStream) -> None:
        self.bench, self.view, self._file, self._stream, self.cycles = bench, view, file, stream, 0

    def until(self, enough: Callable[[], bool], nudge: Callable[[], None] = lambda: None) -> None:
        deadline = time.monotonic() + HURRY
        while not enough():
            assert time.monotonic() < deadline, "nothing came"
            nudge()
            self.cycles += self.view.turn(0.05)

    def subscribed(self) -> None:
        self.until(
            lambda: self.view._status is not None,
            lambda: self.bench.tell("state", state="READY", phase="STANDING", cause=None, lease=None),
        )

    def send(self, cycles: Cycles) -> None:
        before = self.cycles
        self.bench.send(cycles)
        self.until(lambda: self.cycles >= before + len(cycles))

    def swing(self, cycles: Cycles, plant: PlantParameters) -> None:
        """Send a swing, then its shot as the recorder publishes it."""
        now, around = datetime.now(UTC), FlightConditions()
        shot = shot_of_cycles(cycles, plant, around, number=1, time_utc=now).shot  # compiles for long
        self.send(cycles)
        shown = len(self.view.shots.records)
        self.bench.tell("shot", version=1, shot=shot_to_json(shot))
        self.until(lambda: len(self.view.shots.records) > shown)

    def recording(self) -> Recording:
        self._stream.disconnect()
        return Recording(self._file)


def at_rest_after(cycles: Cycles, count: int) -> Cycles:
    """Return `count` cycles after `cycles` in which nothing moves."""
    rest, after = np.tile(cycles[-1:], count), np.arange(1, count + 1)
    rest["tick"] += after
    rest["time"] += after * 1e-3
    return rest


@pytest.fixture
def watched(tmp_path: Path, plant: PlantParameters) -> Iterator[Watched]:
    network, file = loopback(), tmp_path / "live.rrd"
    with fake_bench(network) as bench, Feed(open_client(network, BENCH), BENCH) as feed:
        stream = rr.RecordingStream("golfbench")
        stream.set_sinks(rr.FileSink(file, write_footer=False))
        view = LiveView(stream, feed, BENCH, plant, FlightConditions())
        made = Watched(bench, view, file, stream)
        made.subscribed()
        yield made
        stream.disconnect()


def test_live_view_shows_values_of_record(
    watched: Watched, make_swing: Callable[[int], Cycles], tmp_path: Path
) -> None:
    write_swing(tmp_path / "1.parquet", make_swing(1), {})
    cycles, _ = read_swing(tmp_path / "1.parquet")
    for part in np.split(cycles, [500, 1000, 1500]):
        watched.send(part)
    recording = watched.recording()
    time_axis, angles = recording.read("/signals/angle_deg/actual", "Scalars:scalars")
    assert np.array_equal(angles, np.degrees(cycles["angle"]))
    assert np.allclose(time_axis, cycles["time"] - cycles["time"][0], atol=1e-9)
    _, pressures = recording.read("/signals/pressure_bar", "Scalars:scalars")
    assert np.array_equal(np.array(pressures)[:, :6], cycles["chamber_pressure"] / 1e5)
    _, ticks = recording.read("/signals/tick_us", "Scalars:scalars")
    assert np.array_equal(np.array(ticks)[:, 1], cycles["work_time"] / 1e-6)
    changes, phases = recording.read("/signals/phase", "StateChange:state")
    known = np.concatenate([[0], np.flatnonzero(np.diff(cycles["phase"].astype(int))) + 1])
    assert [phase[0] for phase in phases] == [
        Phase(int(code)).name.lower().replace("_", " ") for code in cycles["phase"][known]
    ]
    assert np.allclose(changes, cycles["time"][known] - cycles["time"][0], atol=1e-9)


def test_live_view_clock_set_back_still_renews_status(
    watched: Watched, make_swing: Callable[[int], Cycles], monkeypatch: pytest.MonkeyPatch
) -> None:
    cycles, now = make_swing(1), time.time
    watched.send(cycles[:500])
    watched.until(lambda: np.isfinite(watched.view._shown))
    monkeypatch.setattr(time, "time", lambda: now() - 3600.0)
    shown = watched.view._shown
    watched.send(cycles[500:1000])
    watched.until(lambda: watched.view._shown > shown)
    assert "SILENT: no telemetry for 30 s" in watched.view._text(watched.view._heard + 30.0)


def test_live_view_swing_shows_figures_and_flight(
    watched: Watched, make_swing: Callable[[int], Cycles], plant: PlantParameters
) -> None:
    watched.swing(make_swing(1), plant)
    (record,) = watched.view.shots.records
    assert record.shot.delivery_source == "encoders+model"
    assert record.shot.carry_source == "model"
    assert record.flight is not None
    recording = watched.recording()
    _, texts = recording.read("/shots", "TextDocument:text")
    assert "tour" in texts[-1][0]
    flown, _ = recording.read("/range/ball", "Points3D:positions")
    assert flown[0] == pytest.approx(1.186, abs=0.01)
    assert "/scene/trace" in recording.entities
    # Rerun follows the newest time there is: nothing may lie in the future.
    assert max(recording.last(entity) for entity in recording.entities - recording.static) < 2.11


def test_live_view_ball_follows_flight_in_time(
    watched: Watched, make_swing: Callable[[int], Cycles], plant: PlantParameters
) -> None:
    cycles = make_swing(1)
    watched.swing(cycles, plant)
    for part in np.split(at_rest_after(cycles, 12_000), 12):
        watched.send(part)
    recording = watched.recording()
    flown, places = recording.read("/range/ball", "Points3D:positions")
    (record,) = watched.view.shots.records
    flight = flight_of(record.shot, plant, FlightConditions())
    assert flight is not None
    assert np.allclose(np.array(places)[:, 0], flight.path[:, 1:], atol=1e-4)
    assert np.all(np.diff(flown) > 0)
    _, speeds = recording.read("/signals/ball_speed_mps", "Scalars:scalars")
    assert np.isnan(speeds[-1][0])


@pytest.mark.release
def test_live_view_shot_memory_excludes_cycles(
    watched: Watched, make_swing: Callable[[int], Cycles], plant: PlantParameters
) -> None:
    swing = make_swing(1)

    def send(shots: int) -> None:
        for _ in range(shots):
            watched.swing(swing, plant)
            swing["tick"] += len(swing)
            swing["time"] += len(swing) * 1e-3

    send(2)
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        send(8)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(watched.view.shots.records) == 10
    assert (after - before) / 8 < swing.nbytes / 10  # 25 kB; with the cycles all of them


def test_live_view_measures_age_to_subscriber_and_rerun(
    watched: Watched, make_day: Callable[..., Cycles]
) -> None:
    watched.send(make_day([(State.READY, 200)]))
    assert 0 <= max(watched.view.to_subscriber) < HURRY
    assert 0 < min(watched.view.to_rerun) < HURRY


def test_live_view_panel_shows_state_losses_and_timing(
    watched: Watched, make_day: Callable[..., Cycles]
) -> None:
    day = make_day([(State.READY, 60)])
    watched.send(day[:20])
    watched.bench.sequence += 4
    watched.bench.lost = 9
    cause = {"name": "GUARD", "text": "guard open"}
    watched.bench.tell("state", state="FAULT", phase="HOLD", cause=cause, lease={"holder": "Ann"})
    segments = {"wake_up": {"p50_us": 5.0, "p99_us": 40.0}, "tick": {"p50_us": None, "p99_us": None}}
    watched.bench.tell("loop", ticks=1000, seconds=1.0, skipped=2, late=3, segments=segments)
    watched.send(day[20:])
    text = watched.view._text(time.monotonic())
    shown = "FAULT", "guard open", "Ann", "1000 Hz, skipped 2, late 3", "p50 5 µs", "4 of ", "9 cycles"
    assert [words for words in shown if words not in text] == []
    assert "SILENT" not in text
    assert "SILENT: no telemetry for 30 s" in watched.view._text(time.monotonic() + 30.0)


def test_live_view_shows_events_and_shots(
    watched: Watched, make_records: Callable[[int], list[ShotRecord]], make_day: Callable[..., Cycles]
) -> None:
    watched.send(make_day([(State.READY, 40)]))
    for record in make_records(4):
        watched.bench.tell("shot", version=1, shot=shot_to_json(record.shot))
    watched.bench.tell("shot", version=1, shot={"shot": "x"})
    watched.bench.tell("event", event="change", state="FAULT", phase="HOLD", reaction="BRAKE", cause="GUARD")
    watched.bench.tell("event", event="loop died", text="it froze", loop_time=1000.02)
    view = watched.view
    watched.until(lambda: len(view.shots.records) == 4 and view._feed.account.invalid == 1)
    watched.until(lambda: not view._feed._others)
    recording = watched.recording()
    _, lines = recording.read("/events", "TextLog:text")
    wanted = ["FAULT, phase HOLD, reaction BRAKE, cause GUARD", "loop died: it froze"]
    assert [line[0] for line in lines] == wanted
    _, levels = recording.read("/events", "TextLog:level")
    assert [level[0] for level in levels] == ["WARN", "CRITICAL"]
    assert {"/dispersion/Pro_V/shots", "/dispersion/Range/shots"} <= recording.entities
    _, texts = recording.read("/shots", "TextDocument:text")
    assert "no ball seen on the tee" in texts[-1][0]


def test_live_view_launch_monitor_shot_is_shown_at_impact(
    watched: Watched, make_swing: Callable[[int], Cycles], make_records: Callable[[int], list[ShotRecord]]
) -> None:
    bench, view = watched.bench, watched.view
    cycles = make_swing(1)
    watched.send(cycles)
    watched.send(at_rest_after(cycles, 1000))
    assert view.shots.records == []  # nothing is made up while its word is awaited
    told = make_records(1)[0].shot
    bench.tell("shot", version=1, shot=None, record="/x.parquet")
    bench.tell("shot", version=1, shot=shot_to_json(told), outcome="matched", shot_id="r-1")
    bench.tell("shot", version=1, shot=None, outcome="launch without a swing", launch={"device": "other"})
    watched.until(lambda: len(view.shots.records) == 1 and not view._feed._others)
    assert view.shots.records[0].shot == told
    recording = watched.recording()
    flown, _ = recording.read("/range/ball", "Points3D:positions")
    assert flown[0] == pytest.approx(1.186, abs=0.01)  # the impact, not the message two seconds later
    _, lines = recording.read("/events", "TextLog:text")
    assert [line[0] for line in lines] == ["launch monitor: other: launch without a swing"]


def test_live_view_new_loop_breaks_lines_and_continues(
    watched: Watched, make_day: Callable[..., Cycles]
) -> None:
    watched.send(make_day([(State.READY, 40)], first_tick=9000, start=400.0))
    watched.bench.sequence, watched.bench.lost = 0, 0
    watched.send(make_day([(State.ESTOP, 40)], first_tick=1, start=0.0, cause=(1, Cause.RESTART)))
    recording = watched.recording()
    at, angles = recording.read("/signals/angle_deg/actual", "Scalars:scalars")
    assert np.all(np.diff(at) > 0)
    assert np.flatnonzero(np.isnan(angles).all(axis=1)).tolist() == [40]
    _, states = recording.read("/signals/state", "StateChange:state")
    assert [state[0] for state in states] == ["ready", "estop"]
    assert watched.view._feed.account.restarts == 1


def test_event_text_and_loop_rows_format_messages() -> None:
    assert event_text({"event": "change", "state": "READY", "cause": "NONE", "phase": "STANDING"}) == (
        "READY, phase STANDING"
    )
    assert event_text({"event": "note"}) == "note"
    assert loop_rows({"ticks": 1}) == [("loop", "invalid")]
    assert json.dumps(loop_rows({"ticks": 5, "seconds": 0, "skipped": 0}))
