"""The recorder: reads the ring and writes one Parquet file a swing. `python -m bench.supervisor.recorder`.

Plan: a pickled RecorderPlan on stdin. Output on stdout, one JSON line each:

`ready`      the ring is open and the folder is writable
`stored`     `path`, `kind`, `number`, `lost_records`, `complete`, `replayable`, `shot_id`, `cause`,
             `warnings`: what drifts from swing to swing, see `bench.records.shot.strike`;
             `tick`: at which the swing began; `shot`: its row of the shot table if the plan asks for it
`fault`    `text`, `waiting`: records cannot be stored; they wait in memory and are retried
`recovered`   records can be stored again
`dropped`    `count`: records lost so far because memory was full
`failed`     `location`, `found`, `expected`, `action`, `exit_code`: it cannot work at all
`ended`      `waiting`: records that could not be stored

It ends on SIGTERM or when its supervisor is gone, after the current swing. Exit codes: 0; DEVICE, the ring or
another shared file is unusable; FILE, records were lost.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyarrow.parquet  # noqa: F401 - now, not at the first record of a running bench

from bench.base.errors import ExitCode
from bench.base.lifecycle import Cause, State
from bench.records.shot.recorded_shot import shot_of_cycles, shot_to_json
from bench.records.shot.strike import DriftMonitor, ball_struck, strike_seen
from bench.records.telemetry.record_file import (
    RecordQueue,
    SwingRecord,
    folder_fault,
    record_path,
    remove_partial,
)
from bench.records.telemetry.ring import RingReader
from bench.records.telemetry.swing_cutter import Cycles, RecordSegment, SwingSegmenter
from bench.records.telemetry.swing_metadata import begin_of, profile_entry, run_entries, since, swing_metadata
from bench.supervisor._timing_record import TimingReader, summary
from bench.supervisor.child_process import (
    CORRECTED,
    CORRECTED_FILE,
    RING_FILE,
    SNAPSHOT_FILE,
    TIMING_FILE,
    Condition,
    HeartbeatSender,
    RecorderPlan,
    begin_service,
    send_event,
    weights_of,
)
from drivers.base.shared_memory import SharedRecord

POLL = 0.01
"""Polling period of the ring, s."""
_PAUSE = 1.0
"""Time between two attempts to store a record, s."""
_CHECK_PERIOD = 2.0
"""Period of the folder checks, s."""
_SNAPSHOTS = 16
"""Number of newest snapshots kept: one per request to move, and records are minutes apart."""


class Recorder:
    """One run of the recorder; call `turn` once per polling period."""

    def __init__(self, plan: RecorderPlan, now: float) -> None:
        """Open the shared files, at `now` (s, CLOCK_MONOTONIC).

        Raises:
            BenchError, SharedMemoryError: the ring or another shared file is unusable, or the plan's metadata
                cannot be written as JSON.
        """
        self.plan = plan
        self._entries = run_entries(plan.run, plan.profile)
        folder = plan.folder
        self._heartbeat = HeartbeatSender(folder, "recorder")
        self._ring = RingReader(folder / RING_FILE, from_oldest=True)
        self._snapshot = SharedRecord.open(folder / SNAPSHOT_FILE, plan.snapshot_dtype)
        self._snapshots: deque[np.ndarray[Any, Any]] = deque(maxlen=_SNAPSHOTS)
        self._corrected = SharedRecord.open(folder / CORRECTED_FILE, CORRECTED)
        self._corrections: deque[np.ndarray[Any, Any]] = deque(maxlen=_SNAPSHOTS)
        self._cutter = SwingSegmenter(lead=plan.lead, tail=plan.tail, room=plan.room)
        self._queue = RecordQueue(plan.waiting, _PAUSE)
        self._timing = TimingReader(folder / TIMING_FILE)
        self._timed = self._timing.snapshot()
        self._drift = DriftMonitor()
        self._swings = plan.data_dir / "swings" / plan.run["bench"]
        remove_partial(self._swings)
        self._number = int(self._heartbeat.last["done"][0])
        self._from = 0
        """Tick after which records begin; earlier ones were stored by a previous recorder."""
        self._resume()
        self._tick = self._from
        self._lost, self._past_lost = 0, 0
        self._started = False
        self._utc_less_loop = 0.0
        self._last_cycle_at = self._next_check = now
        self._folder_fault = ""
        self._fault_reported, self._reported_dropped = False, 0

    def _resume(self) -> None:
        """Continue where a previous recorder of this ring ended."""
        last, newest = self._heartbeat.last[0], self._ring.newest()
        if newest is None or last["tick"] > newest["tick"][0]:
            return
        self._from = int(last["resume"])
        # It may have been killed after renaming the file and before its next heartbeat.
        number = int(last["storing"])
        began = datetime.fromtimestamp(float(last["storing_began"]), UTC)
        if number > self._number and record_path(self._swings, began, number).exists():
            self._number = number
            self._from = max(self._from, int(last["storing_tick"]))

    @property
    def moving(self) -> bool:
        """Whether the robot moves or the tail of its record is incomplete."""
        return self._cutter.moving

    @property
    def worth_waiting(self) -> bool:
        """Whether a swing or a stop is in progress."""
        return self._cutter.worth_waiting

    def turn(self, now: float, utc: float, *, ending: bool = False) -> bool:
        """Read, cut, store and report, at `now` (s, CLOCK_MONOTONIC) and `utc` (s).

        Returns whether there were new cycles. With `ending`, records are retried at once and the heartbeat
        reports ENDING.
        """
        newest = self._ring.newest()  # current; unread cycles may be seconds old
        self._note_snapshot()
        cycles = self._read()
        if len(cycles):
            self._tick, self._last_cycle_at = int(cycles["tick"][-1]), now
            paced = None if self.plan.wall else newest
            self._utc_less_loop = utc - (now if paced is None else float(paced["time"][0]))
        lost, self._lost = self._ring.lost - self._past_lost - self._lost, self._ring.lost - self._past_lost
        for cut in self._cutter.take(cycles, lost):
            self._keep(cut)
        if self._cutter.moving and now - self._last_cycle_at > self.plan.silence:
            self._finish("the loop fell silent", keep=True)
        self._store(now, at_once=ending)
        self._report(now, Condition.ENDING if ending else Condition.WORKING)
        return len(cycles) > 0

    def finish(self, why: str, now: float) -> int:
        """End the current records, store as many as possible, return the number of lost ones."""
        self._finish(why, keep=False)
        for _ in range(len(self._queue)):
            self._store(now, at_once=True)
        self._report(now, Condition.ENDING)
        return len(self._queue) + self._queue.dropped

    def close(self) -> None:
        """Unmap the shared files."""
        for shared in (self._heartbeat, self._ring, self._snapshot, self._corrected):
            shared.close()

    def _read(self) -> Cycles:
        """Return the new cycles without those stored by a previous recorder."""
        cycles = self._ring.read()
        if not self._started and len(cycles):
            # Reading from the oldest, the writer may overtake the first read: that is not a loss of this run.
            self._started, self._past_lost = True, self._ring.lost
        return cycles[np.searchsorted(cycles["tick"], self._from, side="right") :]

    def _note_snapshot(self) -> None:
        found = np.zeros(1, self.plan.snapshot_dtype)
        self._note_correction()
        if self._snapshot.read(found) and all(s["tick"][0] != found["tick"][0] for s in self._snapshots):
            self._snapshots.append(found)

    def _note_correction(self) -> None:
        found = np.zeros(1, CORRECTED)
        self._corrected.read(found)
        if not self._corrections or found["tick"][0] != self._corrections[-1]["tick"][0]:
            self._corrections.append(found)

    def _entries_of(self, cut: RecordSegment) -> Mapping[str, Any]:
        """Return the common entries of all records, with the corrected profile of `cut`."""
        begin = _begin(cut.cycles)
        tick = cut.cycles["tick"][-1] if begin is None else begin
        held = [c["order"] for c in self._corrections if c["tick"][0] <= tick]
        if not held or not (weights := weights_of(held[-1])):
            return self._entries
        corrected = self.plan.basis.corrected(self.plan.profile, weights)
        beside = {"correction": {"number": int(held[-1]["number"][0]), "weights": weights}}
        return {**self._entries, "profile": profile_entry(corrected) | beside}

    def _finish(self, why: str, *, keep: bool) -> None:
        for cut in self._cutter.finish(why, keep=keep):
            self._keep(cut)

    def _keep(self, cut: RecordSegment) -> None:
        self._number += 1
        begin = begin_of(cut.cycles)
        began = datetime.fromtimestamp(float(cut.cycles["time"][0]) + self._utc_less_loop, UTC)
        metadata = swing_metadata(
            cut,
            self._entries_of(cut),
            number=self._number,
            begin=begin,
            time_utc=began,
            snapshots=self._snapshots,
        )
        if cut.kind == "swing":
            metadata["drift"] = self._drift_of(cut, metadata)
        metadata["loop"] = self._loop_since_before()
        path = record_path(self._swings, began, self._number)
        self._queue.put(SwingRecord(path, since(cut.cycles, begin), metadata))

    def _loop_since_before(self) -> dict[str, Any]:
        before, self._timed = self._timed, self._timing.snapshot()
        counted = summary(self._timed, before)
        return {
            name: counted[name]
            for name in ("ticks", "skipped", "late", "page_faults", "preemptions", "stalls")
        }

    def _drift_of(self, cut: RecordSegment, metadata: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return speed and place of the head at the ball against the swings before; None without a strike."""
        plant = self.plan.run["configuration"].get("plant")
        encoders = plant.get("encoders") if isinstance(plant, Mapping) else None
        counts = encoders.get("counts_per_revolution", 0) if isinstance(encoders, Mapping) else 0
        if not counts or cut.lost or metadata["outcome"]["cause"] != Cause.NONE.name:
            return None
        seen = strike_seen(cut.cycles, int(counts), struck=ball_struck(cut.cycles))
        if seen is None:
            return None
        return self._drift.take(seen, metadata["profile"]["data"]).as_json()

    def _store(self, now: float, *, at_once: bool) -> None:
        due = self._queue.due(now, at_once=at_once)
        if due is None:
            return
        if due.path.parent == self._swings:
            self._heartbeat.beat(
                now,
                Condition(int(self._heartbeat.last["condition"][0])),
                storing=due.metadata["number"],
                storing_began=due.time_utc.timestamp(),
                storing_tick=int(due.cycles["tick"][-1]),
            )
        stored = self._queue.store(now, at_once=at_once)
        if stored is None:
            return
        facts = ("kind", "number", "lost_records", "complete", "replayable", "shot_id")
        outcome = stored.metadata["outcome"]
        send_event(
            "stored",
            path=str(stored.path),
            cause=outcome["cause"],
            warnings=(stored.metadata.get("drift") or {}).get("warnings", []),
            tick=_begin(stored.cycles),
            shot=self._shot_of(stored),
            **{key: stored.metadata[key] for key in facts},
        )

    def _shot_of(self, stored: SwingRecord) -> dict[str, Any] | None:
        """Return a swing's row of the shot table; None of another record, or if the plan asks for none."""
        if self.plan.plant is None or stored.metadata["kind"] != "swing":
            return None
        shot = shot_of_cycles(
            stored.cycles,
            self.plan.plant,
            self.plan.around,
            number=stored.metadata["number"],
            time_utc=stored.time_utc,
        )
        return shot_to_json(shot.shot)

    def _report(self, now: float, condition: Condition) -> None:
        """Send a heartbeat and report changes to the parent."""
        if now >= self._next_check:
            self._next_check = now + _CHECK_PERIOD
            self._folder_fault = folder_fault(self._swings, self.plan.least_free)
        fault = self._queue.fault or self._folder_fault
        if fault and not self._fault_reported:
            send_event("fault", text=fault, waiting=len(self._queue))
        elif self._fault_reported and not fault:
            send_event("recovered")
        self._fault_reported = bool(fault)
        if self._queue.dropped > self._reported_dropped:
            self._reported_dropped = self._queue.dropped
            send_event("dropped", count=self._reported_dropped)
        if fault and condition is Condition.WORKING:
            condition = Condition.FAULT
        idle = not self._cutter.moving and not len(self._queue)
        owed = [after for after in (self._queue.owed_after, self._cutter.owed_after) if after is not None]
        resume = max(self._from, min(owed))
        self._heartbeat.beat(
            now,
            condition,
            lost=self._lost,
            done=self._number - len(self._queue),
            waiting=len(self._queue),
            tick=self._tick if idle else resume,
            resume=resume,
        )


def _begin(cycles: Cycles) -> int | None:
    """Return the tick at which the swing in `cycles` began; None without one."""
    swung = cycles["tick"][cycles["state"] == State.SWINGING]
    return int(swung[0]) if len(swung) else None


def main() -> int:
    """Record until stopped by the supervisor or orphaned."""
    parent, recorder = begin_service(lambda plan: Recorder(plan, time.monotonic()))
    last = None
    while True:
        now, ending = time.monotonic(), parent.wants_end
        if recorder.turn(now, time.time(), ending=ending):
            continue
        if ending:
            last = last or now + recorder.plan.timeout
            # A loop without its supervisor stops the robot; that is worth a record.
            if now > last or not (recorder.moving if parent.gone else recorder.worth_waiting):
                break
        time.sleep(POLL)
    lost = recorder.finish("the recorder was ended", time.monotonic())
    recorder.close()
    send_event("ended", waiting=lost)
    return ExitCode.FILE if lost else ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
