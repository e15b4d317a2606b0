"""The live view: a Rerun recording of a running bench.

One turn takes the received messages, logs them in columns and flushes; only the data for the next turn is
kept. The time axis is in seconds since the first cycle shown, continuous over loop restarts.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.records.shot.recorded_shot import (
    FlightConditions,
    flight_of,
    shot_from_json,
    warm_up_shots,
)
from bench.records.shot.shot import ShotRecord
from bench.records.shot.strike import SWINGING
from bench.records.telemetry.cycle_record import CYCLE
from bench.viewer._scene import TIMELINE, Array, Cycles, Scene, bench_time, signals_of
from bench.viewer._shots import ShotSeries
from bench.viewer.feed import Arrived, Feed
from sim.plant import PlantParameters

_BEHIND = 0.001
"""Min gap in time that separates two runs of the control loop (s)."""
_HOLE = 0.010
"""Time without a cycle that is drawn as a gap, s."""


class Placed(NamedTuple):
    """A batch's place on the time axis."""

    time: Array
    """Time of each cycle, s."""
    hole: bool
    """Whether cycles are missing before it, or another loop starts."""


class ViewClock:
    """Maps cycles to the time axis: by loop time within one run of the loop, by UTC between runs."""

    def __init__(self) -> None:
        self._shift = 0.0
        self._utc_zero: float | None = None
        self._tick, self._time = 0, 0.0

    def location(self, cycles: Cycles, utc: float) -> Placed:
        """Return the times of `cycles`, whose newest is at `utc` (s since 1970)."""
        first, last = float(cycles["time"][0]), float(cycles["time"][-1])
        tick = int(cycles["tick"][0])
        if self._utc_zero is None:
            self._utc_zero, self._shift = utc - (last - first), -first
            hole = False
        elif tick <= self._tick or first + self._shift <= self._time:
            by_calendar = utc - (last - first) - self._utc_zero
            self._shift = max(by_calendar, self._time + _BEHIND) - first
            hole = True
        else:
            hole = first + self._shift - self._time > _HOLE
        time = cycles["time"] + self._shift
        self._tick, self._time = int(cycles["tick"][-1]), float(time[-1])
        return Placed(time, hole)

    def of_loop(self, loop_time: float) -> float:
        """Return the time of an instant in loop time (s)."""
        return loop_time + self._shift

    @property
    def now(self) -> float:
        """Time of the newest cycle, s."""
        return self._time

    def utc(self, time: Array) -> Array:
        """Return UTC (s since 1970) of times on the time axis."""
        return np.asarray(time, dtype=float) + (self._utc_zero or 0.0)


PERIOD = 0.05
"""Period of the turns with an open viewer, s: the frame period."""
FILE_PERIOD = 1.0
"""Period of the turns when only writing a file, s: long columns are three times smaller than short ones."""
UTC_TIMELINE = "utc"

_SHOWN = 0.5
"""Period of the status text, s."""
_LIMITS = 1.0
"""Period of the points of the limit lines, s."""
_SILENT = 1.0
"""Time without telemetry after which the bench counts as silent, s."""
_EVERY = 20
"""Ticks between two poses while the robot is slow."""
_AGES = 1500
"""Number of ages for the percentiles: a minute of turns."""
_BINS, _BIN = 50, 5.0
"""Number and width (us) of the bars of the latency histogram."""
_LEVELS = {"loop died": "CRITICAL", "exception": "ERROR"}


def age_words(ages: Collection[float]) -> str:
    """Return median and 99th percentile of `ages` (s) as text."""
    if not ages:
        return "–"
    p50, p99 = 1e3 * np.quantile(list(ages), [0.5, 0.99])
    return f"p50 {p50:.1f} ms, p99 {p99:.1f} ms"


def warm_up(plant: PlantParameters, around: FlightConditions) -> None:
    """Compile all functions: compiling later would block zenoh's threads."""
    cycles = np.zeros(10, CYCLE)
    cycles["time"], cycles["angle"] = np.arange(10) * 1e-3, [0.571, 4.141, 2 * np.pi]
    cycles["phase"] = Phase.DOWNSWING
    Scene(rr.RecordingStream("golfbench_warm_up"), plant).log_cycles(cycles["time"], cycles, _EVERY)
    warm_up_shots(plant, around)


class LiveView:
    """Live view of a bench, drawn into `recording`."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        feed: Feed,
        bench: str,
        plant: PlantParameters,
        around: FlightConditions,
    ) -> None:
        """Log the static scene."""
        self._recording, self._feed, self._bench = recording, feed, bench
        self._plant, self._around = plant, around
        self.axis = ViewClock()
        self._scene = Scene(recording, plant, self._times)
        self.to_subscriber: deque[float] = deque(maxlen=_AGES)
        """Ages from a tick to its arrival here, s."""
        self.to_rerun: deque[float] = deque(maxlen=_AGES)
        """Ages from a tick to its acceptance by Rerun, s."""
        self.shots = ShotSeries(self._scene)
        self._status: Mapping[str, Any] | None = None
        self._loop: Mapping[str, Any] | None = None
        self._latency = np.zeros(_BINS, dtype=np.int64)
        self._swinging, self._swing_start = False, 0.0
        self._struck: float | None = None
        """Time of the impact in the last swing; None before, and once its shot is shown."""
        self._heard = -np.inf
        self._shown = self._counted = self._limited = -np.inf

    def turn(self, timeout: float) -> int:
        """Wait up to `timeout` s for messages and log them; return the number of cycles."""
        news = self._feed.take(timeout)
        now = time.monotonic()
        cycles = self._show_batches(news.batches)
        for topic, message in news.messages:
            self._show_message(topic, message)
        self.shots.advance(self.axis.now)
        if now - self._shown >= _SHOWN and (cycles or np.isfinite(self._heard)):
            self._shown = now
            self.shots.document("bench", self._at(now), self._text(now))
        if cycles:
            self._recording.flush(timeout_sec=2.0)
            self.to_rerun.append(time.time() - news.batches[-1].batch.time)
        return cycles

    # Messages ------------------------------------------------------------------------------------

    def _show_batches(self, batches: list[Arrived]) -> int:
        """Log all batches at once, but those of different loops separately."""
        group: list[tuple[Cycles, Array]] = []
        total = 0
        for arrived in batches:
            self.to_subscriber.append(arrived.age)
            self._heard = time.monotonic()
            cycles = arrived.batch.cycles
            placed = self.axis.location(cycles, arrived.batch.time)
            if placed.hole:
                self._show(group)
                group = []
                self._show_hole(placed.time[0])
            group.append((cycles, placed.time))
            total += len(cycles)
        self._show(group)
        return total

    def _show(self, group: list[tuple[Cycles, Array]]) -> None:
        if not group:
            return
        # As bytes, since numpy joins records field by field.
        cycles = np.concatenate([part.view(np.uint8) for part, _ in group]).view(group[0][0].dtype)
        at = np.concatenate([location for _, location in group])
        self._scene.log_cycles(at, cycles, _EVERY)
        if at[-1] - self._limited >= _LIMITS:
            self._limited = float(at[-1])
            self._scene.log_limits(at[-1:])
        self._count_latency(cycles, float(at[-1]))
        self._follow_swing(cycles, at)

    def _show_hole(self, at: float) -> None:
        self._scene.interrupt()
        self._limited, self._swinging = -np.inf, False
        location = self._times(np.array([at - 1e-4]))
        for name, values in signals_of(np.zeros(1, CYCLE), self._plant).items():
            self._scene.scalars(f"signals/{name}", location, np.full_like(values, np.nan))

    def _count_latency(self, cycles: Cycles, at: float) -> None:
        """Count wake-up latencies; show the histogram once a second."""
        bins = np.clip(cycles["wake_latency"] / 1e-6 / _BIN, 0, _BINS - 1).astype(int)
        self._latency += np.bincount(bins, minlength=_BINS)
        if at - self._counted >= 1.0:
            self._counted = at
            middle = (np.arange(_BINS) + 0.5) * _BIN
            bars = rr.BarChart(np.log10(1.0 + self._latency), abscissa=middle, color=(86, 180, 233))
            self._recording.set_time(TIMELINE, duration=at)
            self._recording.log("loop/wake_up_latency", bars)
            self._recording.reset_time()

    def _follow_swing(self, cycles: Cycles, at: Array) -> None:
        """Put the ball on the tee when a swing starts; keep the time of its impact."""
        swinging = np.isin(cycles["phase"], SWINGING)
        if swinging.any() and not self._swinging:
            self._swing_start, self._struck = float(at[int(np.argmax(swinging))]), None
            self._scene.log_ball(np.array([self._swing_start]), self._scene.rest[None])
        self._swinging = bool(swinging[-1])
        if self._struck is None and len(gone := np.flatnonzero(cycles["phase"] == Phase.IMPACT)):
            self._struck = float(at[gone[0]])

    def _show_shot(self, record: ShotRecord) -> None:
        """Show a shot, whose trajectory proceeds from the impact of the last swing, or from now on."""
        now = self.axis.now
        start = min(self._swing_start or now, now)
        struck = None if record.flight is None else min(self._struck or now, now)
        self._struck = None
        self.shots.log_shot(record, start, struck, latest=now)

    def _show_message(self, topic: str, message: dict[str, Any]) -> None:
        match topic:
            case "state":
                self._status = message
            case "loop":
                self._loop = message
            case "event":
                self._show_event(message)
            case "shot" if (given := message.get("shot", message)) is not None:
                try:
                    shot = shot_from_json(given, "shot message")
                except BenchError as error:
                    self._feed.count_invalid(str(error))
                    return
                flight = flight_of(shot, self._plant, self._around)
                self._show_shot(ShotRecord(shot, np.zeros(0, CYCLE), flight))
            case "shot" if (outcome := message.get("outcome")) is not None:  # of a launch, not of a swing
                launch = message.get("launch")
                device = launch.get("device", "") if isinstance(launch, Mapping) else ""
                self._show_event({"event": "launch monitor", "text": f"{device}: {outcome}".strip(": ")})

    def _show_event(self, message: Mapping[str, Any]) -> None:
        """Log an event as a line, at its loop time if given."""
        tick = message.get("loop_time")
        if isinstance(tick, int | float):
            location = self.axis.of_loop(float(tick))
        else:
            location = self._at(time.monotonic())
        latched = message.get("state") in ("ESTOP", "FAULT")
        level = _LEVELS.get(str(message.get("event")), "WARN" if latched else "INFO")
        self._recording.send_columns(
            "events", self._times(location), rr.TextLog.columns(text=[event_text(message)], level=[level])
        )

    # Status text ---------------------------------------------------------------------------------

    def _at(self, now: float) -> float:
        """Return `now` (s, CLOCK_MONOTONIC) on the timeline: the newest cycle's, later if it is silent."""
        silent = max(0.0, now - self._heard) if np.isfinite(self._heard) else 0.0
        return self.axis.now + (silent if silent > _SILENT else 0.0)

    def _times(self, at: Array | float) -> list[rr.TimeColumn]:
        at = np.atleast_1d(np.asarray(at, dtype=float))
        utc = np.round(self.axis.utc(at) * 1e9).astype("datetime64[ns]")
        return [*bench_time(at), rr.TimeColumn(UTC_TIMELINE, timestamp=utc)]

    def _text(self, now: float) -> str:
        """Return the status panel of the bench at `now` (s, CLOCK_MONOTONIC) as Markdown."""
        silent = now - self._heard
        rows: list[tuple[str, str]] = []
        head = f"**Bench {self._bench}**"
        if silent > _SILENT:
            head += f" **is SILENT: no telemetry for {silent:.0f} s.** Before:"
        if (status := self._status) is not None:
            head += (
                f" **{status.get('state', '?')}**, phase {status.get('phase')}, "
                f"reaction {status.get('reaction')}, swing {status.get('swings')} "
                f"of {status.get('profile')}, driver {status.get('driver')}"
            )
            cause, lease = status.get("cause"), status.get("lease")
            if isinstance(cause, Mapping):
                head += f"\n\n{cause.get('name')}: {cause.get('text')}"
            rows.append(("lease", str(lease.get("holder")) if isinstance(lease, Mapping) else "not held"))
        if (loop := self._loop) is not None:
            rows += loop_rows(loop)
        a = self._feed.account
        sent = a.batches + a.lost_batches
        rows += [
            ("age at subscriber", age_words(self.to_subscriber)),
            ("age in Rerun", age_words(self.to_rerun)),
            ("lost", f"{a.lost_batches} of {sent} batches, {a.lost_cycles} cycles in the ring"),
        ]
        if a.invalid:
            rows.append(("invalid messages", f"{a.invalid}, last: {self._feed.fault[:80]}"))
        if a.restarts:
            rows.append(("publisher restarts", str(a.restarts)))
        cells = [f"| {name} | {text.replace('|', '/')} |" for name, text in rows]
        return "\n".join([head, "", cells[0], "|:--|:--|", *cells[1:], ""])


def event_text(message: Mapping[str, Any]) -> str:
    """Return an event as one line of text."""
    name = str(message.get("event", "?"))
    if name == "change":
        parts = [str(message.get("state", "?"))]
        parts += [
            f"{key} {message[key]}"
            for key in ("phase", "reaction", "cause")
            if message.get(key, "NONE") != "NONE"
        ]
        return ", ".join(parts)
    return f"{name}: {message.get('text', '')}".strip(": ")


def loop_rows(loop: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the loop timing of the last second as rows of text."""
    try:
        rate = loop["ticks"] / loop["seconds"]
        rows = [("loop", f"{rate:.0f} Hz, skipped {loop['skipped']}, late {loop['late']}")]
        for name, segment in (("woken late by", "wake_up"), ("tick takes", "tick")):
            figures = loop["segments"][segment]
            if figures["p50_us"] is not None:
                rows.append((name, f"p50 {figures['p50_us']:.0f} µs, p99 {figures['p99_us']:.0f} µs"))
        return rows
    except (KeyError, TypeError, ZeroDivisionError):
        return [("loop", "invalid")]
