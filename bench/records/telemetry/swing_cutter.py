"""Which cycles belong to one record: a pure state machine over the stream of cycles.

A record begins `lead` before the robot is armed or homed and ends `tail` after it stands again. So charging
and the way to the address are seen, and a replay finds its snapshot. In a series, where the bench is armed
again after each swing, the next record begins `lead` before its own swing. Kept is what held a swing, a stop
or a fault; homing or arming that ended as requested leaves no record.

Memory is bounded: during a long hold at the address the oldest cycles are dropped. A record that still
does not fit is cut into several: all but the last state why they end, all but the first that they continue.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bench.base.lifecycle import LATCHED, MOVING, State
from bench.records.telemetry.cycle_record import CYCLE

Cycles = np.ndarray[Any, Any]
"""Records of CYCLE, `time` on the loop's clock."""

_MOVING = np.array([state in MOVING for state in State])


class RecordSegment(NamedTuple):
    """The cycles of one record."""

    cycles: Cycles
    kind: str
    """"swing", or "stop": no swing, but a stop or a fault."""
    lost: int
    """Number of records that the ring lost within `cycles`."""
    ended: str = ""
    """Reason why the record ends before standstill; empty if it does not."""
    continued: bool = False
    """The robot moved already at its start: the previous record was cut there, or no recorder ran."""


@dataclass
class _Part:
    """A record in progress."""

    begin: int
    """Number of its first cycle."""
    kind: str = ""
    """Kind of the record; empty while there is no reason to keep it."""
    series: bool = False
    """The bench was armed again automatically: the record is to start at its swing."""
    trimmed: bool = False
    continued: bool = False
    stood: float | None = None
    """Time of the standstill (s), once it stands."""


class SwingSegmenter:
    """Cuts the stream of cycles into records."""

    def __init__(self, *, lead: float, tail: float, room: int) -> None:
        """`lead`, `tail` in s; `room` in cycles: all the memory there is."""
        self._lead, self._tail = lead, tail
        self._past = _Past(room)
        self._state = State.STARTING
        self._tick: int | None = None
        self._lead_from = 0
        """Number of the first cycle that a record which begins now would hold."""
        self._open: _Part | None = None
        self._closing: list[_Part] = []
        self._missing = 0
        self._losses: list[tuple[int, int]] = []
        """Number of the cycle before which records are missing, and how many."""

    @property
    def moving(self) -> bool:
        """Whether a record is in progress, its tail included."""
        return self._open is not None or bool(self._closing)

    @property
    def worth_waiting(self) -> bool:
        """Whether a record in progress will be kept."""
        return bool(self._closing) or (self._open is not None and bool(self._open.kind))

    @property
    def owed_after(self) -> int:
        """The tick after which come all cycles of the records in the making and of the next one's lead."""
        parts = [*self._closing, *([self._open] if self._open else [])]
        first = min((part.begin for part in parts), default=self._lead_from)
        return self._past.tick(min(first, self._lead_from)) - 1 if self._past.end else 0

    def take(self, cycles: Cycles, lost: int = 0) -> list[RecordSegment]:
        """Add `cycles`; `lost` cycles are missing before or between them. Return the complete records."""
        cuts: list[RecordSegment] = []
        self._missing += lost
        for begin in range(0, len(cycles), self._past.room // 4):
            cuts += self._take(cycles[begin : begin + self._past.room // 4])
        return cuts

    def finish(self, why: str, *, keep: bool) -> list[RecordSegment]:
        """End all records here, because `why`; with `keep` also one that has no swing or stop yet."""
        cuts = [self._cut(part, self._past.end) for part in self._closing]
        if self._open is not None:
            cut = self._cut(self._open, self._past.end, why)
            cuts.append(cut._replace(kind="stop") if keep and not cut.kind else cut)
        self._closing, self._open = [], None
        self._state = State.STARTING  # robot still moving: later cycles open a record again
        return [cut for cut in cuts if cut.kind]

    def _take(self, cycles: Cycles) -> list[RecordSegment]:
        cuts = list(self._make_room(len(cycles)))
        first = self._past.end
        if self._missing:
            self._note_loss(cycles, first)
        self._past.append(cycles)
        states = cycles["state"]
        before = np.concatenate([[np.uint8(self._state)], states[:-1]])
        for index in np.flatnonzero(states != before):
            cuts += self._close(float(cycles["time"][index]))
            self._change(first + int(index), State(int(states[index])), float(cycles["time"][index]))
        self._tick = int(cycles["tick"][-1])
        self._lead_from = self._before(self._past.end, float(cycles["time"][-1]), self._lead_from)
        cuts += self._close(float(cycles["time"][-1]))
        return cuts

    def _change(self, number: int, state: State, time: float) -> None:
        """Follow the change to `state` in cycle `number` at `time`."""
        before, self._state = self._state, state
        part = self._open
        if part is None:
            if state in MOVING:
                late = before is State.STARTING  # nothing moves in STARTING: the start was not recorded
                self._open = part = _Part(self._before(number, time), continued=late, series=late)
        elif state not in MOVING or (state is State.ARMED and before is State.RECOVERING):
            if state in LATCHED and not part.kind:
                part.kind = "stop"
            part.stood, self._open = time, None
            self._closing.append(part)
            if state is State.ARMED:
                self._open = part = _Part(number, series=True)
        if state is State.SWINGING and part is not None:
            if before is State.ARMED and (part.series or part.trimmed):
                part.begin, part.continued = max(part.begin, self._before(number, time)), False
            part.kind, part.series, part.trimmed = "swing", False, False

    def _close(self, time: float) -> Iterator[RecordSegment]:
        """Yield the records to keep whose tail is over at `time`."""
        for part in list(self._closing):
            if part.stood is not None and time >= part.stood + self._tail:
                self._closing.remove(part)
                end = self._past.number_at(part.begin, part.stood + self._tail)
                cut = self._cut(part, end)
                if cut.kind:
                    yield cut

    def _make_room(self, count: int) -> Iterator[RecordSegment]:
        """Give up what `count` more cycles displace; yield the records that must be cut for it."""
        past = self._past
        for part in (*self._closing, *([self._open] if self._open else [])):
            if part is self._open and not part.kind:
                oldest = past.end + count - past.room // 2
                if part.begin < oldest:
                    part.begin, part.trimmed = min(oldest, past.end), True
            elif part.begin < past.end + count - past.room:
                yield self._cut(part, past.end, "longer than the recorder's memory")
                part.begin, part.continued = past.end, True
        kept = past.end + count - past.room
        self._losses = [(number, lost) for number, lost in self._losses if number >= kept]

    def _note_loss(self, cycles: Cycles, first: int) -> None:
        """Note that records are missing, at the largest gap in the ticks."""
        ticks = cycles["tick"]
        before = self._tick if self._tick is not None else int(ticks[0]) - 1
        leaps = np.diff(ticks, prepend=before)
        self._losses.append((first + int(np.argmax(leaps)), self._missing))
        self._missing = 0

    def _cut(self, part: _Part, end: int, ended: str = "") -> RecordSegment:
        """Return the record of `part` up to cycle `end`; its kind is empty when it need not be kept."""
        # A loss stands before the cycle it is noted at: the record's first does not count.
        lost = sum(count for number, count in self._losses if part.begin < number < end)
        cycles = self._past.copy(part.begin, end)
        tripped = bool(np.any(cycles["cause"][_MOVING[cycles["state"]]]))
        return RecordSegment(cycles, part.kind or ("stop" if tripped else ""), lost, ended, part.continued)

    def _before(self, number: int, time: float, begin: int = 0) -> int:
        """Return the number, from `begin` on, of the first cycle within `lead` before `time`."""
        return min(self._past.number_at(max(self._past.first, begin), time - self._lead), number)


class _Past:
    """The newest cycles, numbered from 0 on."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.end = 0
        """Number of the next one."""
        self._cycles = np.zeros(room, CYCLE)
        # As bytes: numpy copies records field by field, and leaves their padding to chance.
        self._bytes = self._cycles.view(np.uint8).reshape(room, CYCLE.itemsize)

    @property
    def first(self) -> int:
        """Number of the oldest one."""
        return max(0, self.end - self.room)

    def append(self, cycles: Cycles) -> None:
        """Take up to `room` cycles in place of the oldest."""
        data = np.ascontiguousarray(cycles).view(np.uint8).reshape(len(cycles), CYCLE.itemsize)
        location = self.end % self.room
        straight = min(len(cycles), self.room - location)
        self._bytes[location : location + straight] = data[:straight]
        self._bytes[: len(cycles) - straight] = data[straight:]
        self.end += len(cycles)

    def copy(self, begin: int, end: int) -> Cycles:
        """Return the cycles `begin` to `end` - 1 as a separate array."""
        found = np.empty(end - begin, CYCLE)
        data = found.view(np.uint8).reshape(len(found), CYCLE.itemsize)
        location = begin % self.room
        straight = min(len(found), self.room - location)
        data[:straight] = self._bytes[location : location + straight]
        data[straight:] = self._bytes[: len(found) - straight]
        return found

    def tick(self, number: int) -> int:
        """Return the tick of cycle `number`."""
        return int(self._cycles["tick"][number % self.room])

    def number_at(self, begin: int, time: float) -> int:
        """Return the number, from `begin` on, of the first cycle at `time` or later, else `end`."""
        numbers = np.arange(begin, self.end)
        late = np.flatnonzero(self._cycles["time"][numbers % self.room] >= time)
        return begin + int(late[0]) if len(late) else self.end
