"""The recorder: reads the ring and writes one Parquet file a swing. `python -m bench.processes.recorder`.

Plan: a pickled RecorderPlan on stdin. Told on stdout, one JSON line each:

`ready`      the ring is open and the folder can be written to
`stored`     `path`, `kind`, `number`, `lost_records`, `complete`, `replayable`, `shot_id`, `cause`
`trouble`    `text`, `waiting`: records cannot be stored; they wait in memory and are tried again
`relieved`   that is over
`dropped`    `count`: records lost so far, as memory had no more room for them
`failed`     `place`, `found`, `expected`, `cure`, `exit_code`: it cannot work at all
`ended`      `waiting`: records that could not be stored to the end

It ends, after the swing under way, by SIGTERM or when its supervisor is gone. Exit codes: 0; DEVICE, the ring
or another shared file is unusable; FILE, records were lost.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from bench.errors import BenchError, ExitCode
from bench.lifecycle import State
from bench.processes.child_process import Condition, HeartbeatSender, Parent, read_plan, tell, tell_failure
from bench.processes.correction import CORRECTED, weights_of
from bench.swing.correction import basis_of
from bench.swing.profile import Profile
from bench.telemetry.cycle_record import CYCLE
from bench.telemetry.record_queue import (
    QueuedRecord,
    RecordQueue,
    folder_trouble,
    record_path,
    remove_partial,
)
from bench.telemetry.ring import RingReader
from bench.telemetry.swing_cutter import Cut, Cycles, SwingCutter
from bench.telemetry.swing_metadata import RunMetadata, begin_of, profile_entry, since, swing_metadata
from drivers.base.shared_record import SharedMemoryError, SharedRecord

POLL = 0.01
"""s between two looks into the ring."""
_PAUSE = 1.0
"""s between two tries to store what could not be stored."""
_LOOK = 2.0
"""s between two looks at the folders."""
_SNAPSHOTS = 16
"""Kept from the newest back: one for each request to move, and records are minutes apart."""


@dataclass(frozen=True)
class RecorderPlan:
    """What the supervisor tells the recorder."""

    bench: str
    data_dir: Path
    ring: Path
    snapshot: Path
    """Shared record of `snapshot_dtype`."""
    heartbeat: Path
    """Shared record of HEARTBEAT."""
    snapshot_dtype: np.dtype[Any]
    """`bench.telemetry.snapshot.SNAPSHOT`: given, as the recorder need not load the controller for it."""
    corrected: Path
    """Shared record of CORRECTED."""
    profile: Profile
    run: str
    """Id of the bench's run, of which shots get theirs."""
    configuration: Mapping[str, Any]
    versions: Mapping[str, Any]
    real_time: Mapping[str, Any] = field(default_factory=dict)
    """What the loop asked of the machine and was granted."""
    calibrations: Mapping[str, Any] = field(default_factory=dict)
    wall: bool = True
    """The loop's time is CLOCK_MONOTONIC; otherwise virtual."""
    lead: float = 0.5
    tail: float = 0.5
    """s before and after each record."""
    segment_seconds: float = 0.0
    """Also store everything, in files of this length; 0: do not."""
    room: int = 65536
    """Cycles in memory for the record under way: 43 MB; a minute at 1 kHz."""
    waiting: int = 8
    """Records in memory that the disk does not take."""
    least_free: int = 64 << 20
    """Bytes on the disk below which nothing more is to be armed."""
    silence: float = 1.0
    """s without a cycle after which a record under way ends."""
    patience: float = 10.0
    """s for which an end waits for the swing under way."""


class Recorder:
    """One run of the recorder; `turn` is everything it does between two sleeps."""

    def __init__(self, plan: RecorderPlan, now: float) -> None:
        """Open the shared files, at `now` (s, CLOCK_MONOTONIC).

        Raises:
            BenchError, SharedMemoryError: the ring or another shared file is unusable, or the plan has
                something for the metadata that is no JSON.
        """
        self._plan = plan
        self._entries = RunMetadata(
            plan.bench,
            plan.run,
            plan.profile,
            plan.configuration,
            plan.versions,
            plan.real_time,
            plan.calibrations,
        ).entries()
        self._basis = basis_of(plan.profile)
        self._heart = HeartbeatSender(plan.heartbeat)
        self._ring = RingReader(plan.ring, from_oldest=True)
        self._snapshot = SharedRecord.open(plan.snapshot, plan.snapshot_dtype)
        self._snapshots: deque[np.ndarray[Any, Any]] = deque(maxlen=_SNAPSHOTS)
        self._corrected = SharedRecord.open(plan.corrected, CORRECTED)
        self._corrections: deque[np.ndarray[Any, Any]] = deque(maxlen=_SNAPSHOTS)
        self._cutter = SwingCutter(lead=plan.lead, tail=plan.tail, room=plan.room)
        self._queue = RecordQueue(plan.waiting, _PAUSE)
        self._segment: list[Cycles] = []
        self._segment_lost = 0
        self._swings = plan.data_dir / "swings" / plan.bench
        self._continuous = plan.data_dir / "continuous" / plan.bench
        self._folders = [self._swings] + ([self._continuous] if plan.segment_seconds else [])
        for folder in self._folders:
            remove_partial(folder)
        self._number = int(self._heart.last["done"][0])
        self._from = self._segment_from = 0
        """Ticks after which records and segments begin: what is before is a recorder's before this one."""
        self._resume()
        self._tick = self._from
        self._lost, self._past_lost = 0, 0
        self._started = False
        self._utc_less_loop = 0.0
        self._heard_at = self._look_at = now
        self._folder_trouble = ""
        self._told_trouble, self._told_dropped = False, 0

    def _resume(self) -> None:
        """Go on where a recorder before this one ended, if there was one beside this ring."""
        last, newest = self._heart.last[0], self._ring.newest()
        if newest is None or last["tick"] > newest["tick"][0]:
            return
        self._from, self._segment_from = int(last["resume"]), int(last["tick"])
        # It may have been killed between the file's new name and the next beat of its heart.
        number = int(last["storing"])
        began = datetime.fromtimestamp(float(last["storing_began"]), UTC)
        if number > self._number and record_path(self._swings, began, number).exists():
            self._number = number
            self._from = max(self._from, int(last["storing_tick"]))

    @property
    def moving(self) -> bool:
        """Whether the robot moves, or its record's tail is still to come."""
        return self._cutter.moving

    @property
    def worth_waiting(self) -> bool:
        """Whether a swing or a stop is under way."""
        return self._cutter.worth_waiting

    def turn(self, now: float, utc: float, *, ending: bool = False) -> bool:
        """Read, cut, store, tell, at `now` (s, CLOCK_MONOTONIC) and `utc` (s); say if there was anything new.

        `ending`: nothing waits for its next try, and the heart says so.
        """
        self._note_snapshot()
        cycles = self._read()
        if len(cycles):
            self._tick, self._heard_at = int(cycles["tick"][-1]), now
            self._utc_less_loop = utc - (now if self._plan.wall else float(cycles["time"][-1]))
        lost, self._lost = self._ring.lost - self._past_lost - self._lost, self._ring.lost - self._past_lost
        for cut in self._cutter.take(cycles, lost):
            self._keep(cut, self._swings)
        if self._plan.segment_seconds:
            self._continue(cycles, lost)
        if self._cutter.moving and now - self._heard_at > self._plan.silence:
            self._finish("the loop fell silent", keep=True)
        self._store(now, at_once=ending)
        self._tell(now, Condition.ENDING if ending else Condition.WORKING)
        return len(cycles) > 0

    def finish(self, why: str, now: float) -> int:
        """End the records under way, store what can be stored, return how many records are lost."""
        self._finish(why, keep=False)
        if self._segment:
            self._end_segment()
        for _ in range(len(self._queue)):
            self._store(now, at_once=True)
        self._tell(now, Condition.ENDING)
        return len(self._queue) + self._queue.dropped

    def close(self) -> None:
        """Unmap the shared files."""
        for shared in (self._heart, self._ring, self._snapshot, self._corrected):
            shared.close()

    def _read(self) -> Cycles:
        """Return the new cycles; what a recorder before this one was done with is none."""
        cycles = self._ring.read()
        if not self._started and len(cycles):
            # From the oldest on, the writer may overtake the first read: nothing of this run is lost by it.
            self._started, self._past_lost = True, self._ring.lost
        return cycles[np.searchsorted(cycles["tick"], self._from, side="right") :]

    def _note_snapshot(self) -> None:
        """Keep the newest snapshot if it is a new one."""
        found = np.zeros(1, self._plan.snapshot_dtype)
        self._note_correction()
        if self._snapshot.read(found) and all(s["tick"][0] != found["tick"][0] for s in self._snapshots):
            self._snapshots.append(found)

    def _note_correction(self) -> None:
        """Keep the correction that swings are made with, if it is another than before."""
        found = np.zeros(1, CORRECTED)
        self._corrected.read(found)
        if not self._corrections or found["tick"][0] != self._corrections[-1]["tick"][0]:
            self._corrections.append(found)

    def _entries_of(self, cut: Cut) -> Mapping[str, Any]:
        """Return what is the same for all records, with the profile as it was swung in `cut`."""
        swung = cut.cycles["tick"][cut.cycles["state"] == State.SWINGING]
        tick = int(swung[0] if len(swung) else cut.cycles["tick"][-1])
        held = [c["order"] for c in self._corrections if c["tick"][0] <= tick]
        if not held or not (weights := weights_of(held[-1])):
            return self._entries
        corrected = self._basis.corrected(self._plan.profile, weights)
        beside = {"correction": {"number": int(held[-1]["number"][0]), "weights": weights}}
        return {**self._entries, "profile": profile_entry(corrected) | beside}

    def _finish(self, why: str, *, keep: bool) -> None:
        for cut in self._cutter.finish(why, keep=keep):
            self._keep(cut, self._swings)

    def _keep(self, cut: Cut, folder: Path) -> None:
        """Queue `cut` for `folder`."""
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
        path = record_path(folder, began, self._number)
        self._queue.put(QueuedRecord(path, began, since(cut.cycles, begin), metadata))

    def _continue(self, cycles: Cycles, lost: int) -> None:
        """Add `cycles` to the segment under way; end it when it is long enough."""
        self._segment_lost += lost
        cycles = cycles[np.searchsorted(cycles["tick"], self._segment_from, side="right") :]
        if len(cycles):
            self._segment.append(cycles)
            length = cycles["time"][-1] - self._segment[0]["time"][0]
            if length >= self._plan.segment_seconds or sum(map(len, self._segment)) >= self._plan.room:
                self._end_segment()

    def _end_segment(self) -> None:
        data = bytearray().join(part.tobytes() for part in self._segment)
        self._keep(Cut(np.frombuffer(data, CYCLE), "segment", self._segment_lost), self._continuous)
        self._segment, self._segment_lost = [], 0

    def _store(self, now: float, *, at_once: bool) -> None:
        """Try to store the oldest record that waits."""
        due = self._queue.due(now, at_once=at_once)
        if due is None:
            return
        if due.path.parent == self._swings:
            self._heart.beat(
                now,
                Condition(int(self._heart.last["condition"][0])),
                storing=due.metadata["number"],
                storing_began=due.began.timestamp(),
                storing_tick=int(due.cycles["tick"][-1]),
            )
        stored = self._queue.store(now, at_once=at_once)
        if stored is None:
            return
        facts = ("kind", "number", "lost_records", "complete", "replayable", "shot_id")
        outcome = stored.metadata["outcome"]
        tell(
            "stored",
            path=str(stored.path),
            cause=outcome["cause"],
            **{key: stored.metadata[key] for key in facts},
        )

    def _tell(self, now: float, condition: Condition) -> None:
        """Let the heart beat, and tell the parent of what has changed."""
        if now >= self._look_at:
            self._look_at = now + _LOOK
            looks = (folder_trouble(folder, self._plan.least_free) for folder in self._folders)
            self._folder_trouble = next(filter(None, looks), "")
        trouble = self._queue.trouble or self._folder_trouble
        if trouble and not self._told_trouble:
            tell("trouble", text=trouble, waiting=len(self._queue))
        elif self._told_trouble and not trouble:
            tell("relieved")
        self._told_trouble = bool(trouble)
        if self._queue.dropped > self._told_dropped:
            self._told_dropped = self._queue.dropped
            tell("dropped", count=self._told_dropped)
        if trouble and condition is Condition.WORKING:
            condition = Condition.TROUBLE
        idle = not self._cutter.moving and not len(self._queue)
        owed = [after for after in (self._queue.owed_after, self._cutter.owed_after) if after is not None]
        resume = max(self._from, min(owed))
        self._heart.beat(
            now,
            condition,
            lost=self._lost,
            done=self._number - len(self._queue),
            waiting=len(self._queue),
            tick=self._tick if idle else resume,
            resume=resume,
        )


def main() -> int:
    """Record until the supervisor ends it or is gone."""
    parent = Parent()
    try:
        plan: RecorderPlan = read_plan()
        recorder = Recorder(plan, time.monotonic())
    except (BenchError, SharedMemoryError) as error:
        return tell_failure(error)
    parent.listen()
    tell("ready")
    last = None
    while True:
        now, ending = time.monotonic(), parent.wants_end or parent.gone
        if recorder.turn(now, time.time(), ending=ending):
            continue
        if ending:
            last = last or now + plan.patience
            # A loop whose supervisor is gone comes to a stand by itself; that is worth a record.
            if now > last or not (recorder.moving if parent.gone else recorder.worth_waiting):
                break
        time.sleep(POLL)
    lost = recorder.finish("the recorder was ended", time.monotonic())
    recorder.close()
    tell("ended", waiting=lost)
    return ExitCode.FILE if lost else ExitCode.OK


if __name__ == "__main__":
    sys.exit(main())
