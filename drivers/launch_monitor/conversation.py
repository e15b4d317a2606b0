"""Protocol of one monitor connection: bytes in; records, answers and counts out. No sockets, no clock."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from drivers.launch_monitor.objects import ObjectStream
from drivers.launch_monitor.open_connect import (
    SHOT_TAKEN,
    TOO_LARGE,
    RejectedMessage,
    ReportedStatus,
    read_message,
    write_answer,
)
from drivers.launch_monitor.plausibility import add_doubts
from drivers.launch_monitor.record import ClubFigures, ClubRecord, LaunchRecord, RefusedRecord

MAX_DEVICES = 64
"""Maximum number of device names that are remembered."""
OBJECT_TIMEOUT = 2.0
"""Time-out for receiving one object, s; an incomplete object is dropped."""


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
    """Bytes outside objects."""

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
        """Clubs without a ball and refused messages; the reader empties the list."""
        self.understood: float | None = None
        """Time of the last message that was not refused."""
        self._measured = measured or MeasuredClubFields()
        self.device = ""
        self.last_received = now
        """Time of the last byte."""
        self.heartbeats = False
        """Whether the monitor sends heartbeats, so that silence means it is lost."""
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
                continue
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
        self.heartbeats |= status.heartbeat
        self.ready = self.ready if status.ready is None else status.ready
        self.ball_detected = self.ball_detected if status.ball_detected is None else status.ball_detected
