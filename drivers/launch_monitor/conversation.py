"""One monitor's side of the connection: bytes in; records, answers and counts out. No sockets, no clock."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

from drivers.launch_monitor.objects import ObjectStream
from drivers.launch_monitor.open_connect import (
    SHOT_TAKEN,
    TOO_LARGE,
    MonitorStatus,
    read_message,
    write_answer,
)
from drivers.launch_monitor.plausibility import PlausibleFigures, judged
from drivers.launch_monitor.record import LaunchRecord

LONGEST_OBJECT = 2.0
"""s that an object may take to come; what is not whole by then was cut off and is given up."""


@dataclass
class MessageCounts:
    """What came: each object is a shot, a status or refused."""

    received: int = 0
    """Bytes."""
    objects: int = 0
    shots: int = 0
    statuses: int = 0
    """Heartbeats among them."""
    refused: int = 0
    too_large: int = 0
    """Objects that were cut off because they would not end; not among `objects`."""
    cut_off: int = 0
    """Objects whose end did not come; not among `objects`."""
    passed_over: int = 0
    """Bytes in no object."""

    def add(self, other: MessageCounts) -> None:
        """Add the counts of `other`."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))


class ParsedInput(NamedTuple):
    """What some bytes come to."""

    records: list[LaunchRecord]
    answer: bytes
    stays: bool
    """False: the stream is of no more use and the connection is to be closed after the answer."""


class Conversation:
    """See the module's text; times are seconds on one clock."""

    def __init__(self, plausible: PlausibleFigures, now: float) -> None:
        self.counts = MessageCounts()
        self.device = ""
        self.heard = now
        """Time of the last byte."""
        self.heartbeats = False
        """It sends heartbeats, so silence means something."""
        self.ready: bool | None = None
        self.ball_detected: bool | None = None
        self._plausible = plausible
        self._stream = ObjectStream()
        self._begun = now

    def hear(self, data: bytes, now: float) -> ParsedInput:
        """Take what came."""
        self.check(now)
        if not self._stream.pending:
            self._begun = now
        self.heard = now
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
            if isinstance(message, LaunchRecord):
                counts.shots += 1
                self.device = message.device or self.device
                records.append(judged(message, self._plausible))
                answers.append(write_answer(SHOT_TAKEN, "Shot received successfully"))
            elif isinstance(message, MonitorStatus):
                counts.statuses += 1
                self._take_status(message)
            else:
                counts.refused += 1
                answers.append(write_answer(message.code, f"Refused: {message.reason}"))
        if self._stream.useless:
            counts.too_large += 1
            answers.append(write_answer(TOO_LARGE, f"Refused: {self._stream.useless}"))
        return ParsedInput(records, b"".join(answers), not self._stream.useless)

    def check(self, now: float) -> None:
        """Give up an object that does not end."""
        if now - self._begun > LONGEST_OBJECT:
            self.end()

    def end(self) -> None:
        """The connection is over: what is not whole never will be."""
        if self._stream.pending:
            self.counts.cut_off += 1
            self._stream.drop()
            self.counts.passed_over = self._stream.passed_over

    def _take_status(self, status: MonitorStatus) -> None:
        self.device = status.device or self.device
        self.heartbeats |= status.heartbeat
        self.ready = self.ready if status.ready is None else status.ready
        self.ball_detected = self.ball_detected if status.ball_detected is None else status.ball_detected
