"""Protocol of one monitor connection, without sockets and clock: objects, plausibility, answers, counts.

Split an unframed byte stream into JSON objects. Open Connect sends bare objects: one segment may hold
several, and one object may span several segments. Bytes between objects (line ends, commas, noise) are
skipped.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from math import cos, degrees, radians
from typing import NamedTuple

from drivers.launch_monitor.open_connect import (
    SHOT_TAKEN,
    TOO_LARGE,
    RejectedMessage,
    ReportedStatus,
    read_message,
    write_answer,
)
from drivers.launch_monitor.record import ClubFigures, ClubRecord, LaunchRecord, RefusedRecord

MAX_OBJECT_SIZE = 64 * 1024
"""Maximum bytes of one object; a shot has about 700."""
MAX_DEPTH = 8
"""Maximum nesting depth; a shot has two levels."""

_OUTSIDE_STRING = re.compile(rb'["{}]')
_IN_STRING = re.compile(rb'["\\]')
_QUOTE, _OPEN, _BACKSLASH = b'"', b"{", b"\\"


class ObjectStream:
    """Collects received bytes and returns complete objects, with their braces, as bytes."""

    def __init__(self) -> None:
        self.passed_over = 0
        """Number of bytes outside objects."""
        self.error = ""
        """Why the stream is invalid: an object too long or too deep; empty while valid."""
        self._forget()

    def _forget(self) -> None:
        self._part = bytearray()
        self._seen, self._depth, self._in_string = 0, 0, False

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete object."""
        return len(self._part)

    def drop(self) -> None:
        """Drop the incomplete object."""
        self.passed_over += len(self._part)
        self._forget()

    def feed(self, more: bytes) -> list[bytes]:
        """Return the objects that `more` completes, up to the first that is too large or too deep."""
        part = self._part
        part += more
        found: list[bytes] = []
        while not self.error and (self._depth or self._begin()):
            end = self._find_end()
            if (len(part) if end is None else end) > MAX_OBJECT_SIZE:
                self.error = f"an object of more than {MAX_OBJECT_SIZE} bytes"
            elif self._depth > MAX_DEPTH:
                self.error = f"objects nested more than {MAX_DEPTH} deep"
            if end is None or self.error:
                break
            found.append(bytes(part[:end]))
            del part[:end]
            self._seen = 0
        if self.error:
            self.drop()
        return found

    def _begin(self) -> bool:
        """Skip the bytes before the next object; return whether an object begins."""
        part = self._part
        start = part.find(_OPEN)
        skipped = len(part) if start < 0 else start
        self.passed_over += skipped
        del part[:skipped]
        self._seen = 0
        return start >= 0

    def _find_end(self) -> int | None:
        """Return the length of the object at the start of `_part`, None while incomplete."""
        part = self._part
        while self._seen < len(part):
            mark = (_IN_STRING if self._in_string else _OUTSIDE_STRING).search(part, self._seen)
            if mark is None:
                self._seen = len(part)
                return None
            symbol, self._seen = mark.group(), mark.end()
            if symbol == _BACKSLASH:
                if self._seen == len(part):  # the escaped character is missing
                    self._seen -= 1
                    return None
                self._seen += 1
            elif symbol == _QUOTE:
                self._in_string = not self._in_string
            elif symbol == _OPEN:
                self._depth += 1
                if self._depth > MAX_DEPTH:
                    return None
            else:
                self._depth -= 1
                if not self._depth:
                    return self._seen
        return None


SPEED = (5.0, 100.0)
"""Range of plausible ball speeds, m/s."""
MAX_LAUNCH_ANGLE = radians(60.0)
"""Maximum launch angle, rad; the minimum is just above 0, the value of misreads."""
MAX_DIRECTION = radians(30.0)
"""Maximum direction to either side, rad."""
MAX_SPIN = 1570.0
"""Maximum spin, rad/s (15,000 rpm)."""
SMASH = (0.8, 1.6)
"""Range of smash factors (ball speed over club speed): an elastic 46 g ball off a 200 g head reaches 1.63,
one at the Rules' limit 1.5. The lower bound falls with the cosine of the launch angle, for lofted clubs."""


def add_doubts(record: LaunchRecord, club_speed: float | None = None) -> LaunchRecord:
    """Return `record` with its doubts; `club_speed` (m/s) replaces the monitor's own."""
    doubts = [*record.doubts]
    speed, angle, direction, spin = record.speed, record.launch_angle, record.direction, record.spin
    if speed is not None and not SPEED[0] <= speed <= SPEED[1]:
        doubts.append(f"ball speed {speed:.3g} m/s, expected {SPEED[0]:g} to {SPEED[1]:g}")
    if angle is not None and not 0.0 < angle <= MAX_LAUNCH_ANGLE:
        most = f"{degrees(MAX_LAUNCH_ANGLE):.3g}"
        doubts.append(f"launch angle {degrees(angle):.3g} deg, expected above 0 to {most}")
    if direction is not None and abs(direction) > MAX_DIRECTION:
        most = f"{degrees(MAX_DIRECTION):.3g} at most to either side"
        doubts.append(f"direction {degrees(direction):.3g} deg, expected {most}")
    if spin is not None and spin > MAX_SPIN:
        doubts.append(f"spin {spin:.4g} rad/s, expected {MAX_SPIN:g} at most")
    club = record.club.speed if club_speed is None else club_speed
    if speed is not None and club is not None and club > 0.0:
        smash, least = speed / club, SMASH[0] * cos(min(angle or 0.0, MAX_LAUNCH_ANGLE))
        if not least <= smash <= SMASH[1]:
            doubts.append(f"ball speed {smash:.3g} times the club's, expected {least:.2g} to {SMASH[1]:g}")
    once = tuple(dict.fromkeys(doubts))
    return record if once == record.doubts else replace(record, doubts=once)


MAX_DEVICES = 64
"""Maximum number of device names that are remembered."""
OBJECT_TIMEOUT = 2.0
"""Time-out for receiving one object, s; an incomplete object is dropped."""
PERIODIC_BEATS = 3
"""Equal heartbeats in a row that show that a monitor sends them periodically. Several monitors send one on
connection or at each change of their status, and then nothing until the next shot."""


@dataclass
class MessageCounts:
    """Received messages: each object is a shot, a club, a status or refused."""

    received: int = 0
    """Received bytes."""
    objects: int = 0
    shots: int = 0
    clubs: int = 0
    """Messages with figures of the club alone."""
    statuses: int = 0
    """Status messages, including heartbeats."""
    refused: int = 0
    too_large: int = 0
    """Objects dropped because they were too large; not counted in `objects`."""
    cut_off: int = 0
    """Incomplete objects; not counted in `objects`."""
    passed_over: int = 0
    """Number of bytes outside objects."""

    def add(self, other: MessageCounts) -> None:
        """Add the counts of `other`."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))


class ParsedInput(NamedTuple):
    """Result of parsing received bytes."""

    records: list[LaunchRecord]
    answer: bytes
    keep_open: bool
    """False if the stream is invalid: close the connection after the answer."""


class MeasuredClubFields:
    """Fields of the club that each device has filled: 0 where it sends nothing else is no measurement."""

    def __init__(self) -> None:
        self._filled: dict[str, set[str]] = {}

    def check(
        self, device: str, club: ClubFigures, absent: tuple[tuple[str, str], ...]
    ) -> tuple[ClubFigures, tuple[tuple[str, str], ...]]:
        """Return `club` and `absent`, the zeros absent of fields that `device` has not filled so far."""
        filled = self._filled.setdefault(device, set())
        filled |= {name for name, value in club._asdict().items() if value}
        empty = [name for name, value in club._asdict().items() if value == 0.0 and name not in filled]
        while len(self._filled) > MAX_DEVICES:
            del self._filled[next(iter(self._filled))]
        reasons = tuple((f"club.{name}", "0 in each message so far: not measured") for name in empty)
        return club._replace(**dict.fromkeys(empty)), absent + reasons


class Conversation:
    """Protocol state of one connection; all times in s on one clock."""

    def __init__(self, now: float, measured: MeasuredClubFields | None = None) -> None:
        """Create a conversation; `measured` is shared by all connections."""
        self.counts = MessageCounts()
        self.asides: list[ClubRecord | RefusedRecord] = []
        """Club data without ball data, and refused messages; reading empties the list."""
        self.understood: float | None = None
        """Time of the last message that was not refused."""
        self._measured = measured or MeasuredClubFields()
        self.device = ""
        self.last_received = now
        """Time of the last byte."""
        self.heartbeats = False
        """Whether the monitor sends heartbeats periodically, so that silence means it is lost."""
        self._beat: ReportedStatus | None = None
        self._beats = 0
        self.ready: bool | None = None
        self.ball_detected: bool | None = None
        self._stream = ObjectStream()
        self._begun = now

    def receive(self, data: bytes, now: float) -> ParsedInput:
        """Process received bytes."""
        self.check(now)
        if not self._stream.pending:
            self._begun = now
        self.last_received = now
        counts = self.counts
        counts.received += len(data)
        records: list[LaunchRecord] = []
        answers: list[bytes] = []
        objects = self._stream.feed(data)
        counts.passed_over = self._stream.passed_over
        if objects:
            self._begun = now
        for found in objects:
            counts.objects += 1
            message = read_message(found, now)
            if isinstance(message, RejectedMessage):
                counts.refused += 1
                self.asides.append(RefusedRecord(now, message.reason))
                answers.append(write_answer(message.code, f"Refused: {message.reason}"))
                continue
            self.understood = now
            self.device = message.device or self.device
            if isinstance(message, ReportedStatus):
                counts.statuses += 1
                self._take_status(message)
                if message.ball_data:
                    answers.append(write_answer(SHOT_TAKEN, "No shot: a ball of speed 0"))
                continue
            self._beats = 0
            club, absent = self._measured.check(self.device, message.club, message.absent)
            if isinstance(message, ClubRecord):
                counts.clubs += 1
                self.asides.append(ClubRecord(now, self.device, club, absent))
            else:
                counts.shots += 1
                record = replace(message, device=self.device, club=club, absent=absent)
                records.append(add_doubts(record))
            answers.append(write_answer(SHOT_TAKEN, "Shot received successfully"))
        if self._stream.error:
            counts.too_large += 1
            self.asides.append(RefusedRecord(now, self._stream.error))
            answers.append(write_answer(TOO_LARGE, f"Refused: {self._stream.error}"))
        return ParsedInput(records, b"".join(answers), not self._stream.error)

    def check(self, now: float) -> None:
        """Drop an object that is incomplete after OBJECT_TIMEOUT."""
        if now - self._begun > OBJECT_TIMEOUT:
            self.end(now)

    def end(self, now: float) -> None:
        """Drop an incomplete object at the end of the connection."""
        if self._stream.pending:
            self.counts.cut_off += 1
            self.asides.append(RefusedRecord(now, f"an object cut off after {self._stream.pending} bytes"))
            self._stream.drop()
            self.counts.passed_over = self._stream.passed_over

    def _take_status(self, status: ReportedStatus) -> None:
        again = status.heartbeat and status == self._beat
        self._beats = self._beats + 1 if again else int(status.heartbeat)
        self._beat = status
        self.heartbeats |= self._beats >= PERIODIC_BEATS
        self.ready = self.ready if status.ready is None else status.ready
        self.ball_detected = self.ball_detected if status.ball_detected is None else status.ball_detected
