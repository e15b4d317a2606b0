"""Messages of `golfbench/<id>/shot`: their keys, writing and reading.

JSON of the keys of `ShotPublication`, always all of them; an unknown value is null.

A bench without a launch monitor sends one message a swing, when its record is stored. With one it sends a
second message with the outcome, and one for every launch that belongs to no swing or came too often.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, TypedDict, cast

from bench.base.errors import BenchError
from bench.base.json_schema import json_object, require_fit
from bench.base.lifecycle import Cause
from bench.records.shot.shot import Shot
from drivers.launch_monitor.record import ClubFigures, LaunchRecord, MatchOutcome

SHOT_VERSION = 1

_MAX_TEXT_LENGTH = 300
"""Max length of a reason, characters."""
_ACTION = "Use the same golfbench for bench and command line."


class ShotPublication(TypedDict):
    """A swing, or a launch that belongs to none."""

    version: int
    shot_id: str | None
    """Id of the shot, also in the metadata of its record; null for a launch that no swing made."""
    record: str | None
    """Path of the swing's record on the bench's machine; null while it is not stored."""
    number: int | None
    """Number of the record in the bench's run; this and the next five are null while it is not stored."""
    tick: int | None
    """Tick of the loop at which the swing began."""
    lost_records: int | None
    """Cycles that the record lacks."""
    complete: bool | None
    """Every tick from first to last is in the record, and the robot stood at its end."""
    replayable: bool | None
    cause: Annotated[str, Cause] | None
    """First cause of a stop in the record; NONE without one."""
    shot: Annotated[dict[str, Any], Shot] | None
    """Row of the shot table. Without a launch monitor launch and flight of a struck ball are modelled; with
    one it is null until the outcome is settled."""
    outcome: MatchOutcome | None
    """Null until it is settled."""
    launch: Annotated[dict[str, Any], LaunchRecord] | None
    """Launch from the monitor: m/s, rad, rad/s, m, s; null without one."""
    reason: str
    """Objection to the launch, or why it is missing; empty without objection."""


def shot_publication(**known: Any) -> ShotPublication:
    """Return the message with the `known` keys, null elsewhere.

    Raises:
        KeyError: `known` has a key that the message does not have.
    """
    message: dict[str, Any] = dict.fromkeys(ShotPublication.__annotations__)
    if unknown := known.keys() - message.keys():
        raise KeyError(*unknown)
    return cast(ShotPublication, message | {"version": SHOT_VERSION, "reason": ""} | known)


def launch_to_json(launch: LaunchRecord) -> dict[str, Any]:
    """Return `launch` as a JSON object: m/s, rad, rad/s, m, s; figures that are not known are null."""
    return {
        **vars(launch),
        "club": launch.club._asdict(),
        "absent": [[name, shortened(why)] for name, why in launch.absent],
        "doubts": [shortened(doubt) for doubt in launch.doubts],
    }


def launch_from_json(given: Mapping[str, Any]) -> LaunchRecord:
    """Return the launch of a message that `read_shot_message` has checked."""
    known = {field.name: given[field.name] for field in fields(LaunchRecord)}
    known["club"] = ClubFigures(*(given["club"][name] for name in ClubFigures._fields))
    known["absent"] = tuple((name, why) for name, why in given["absent"])
    return LaunchRecord(**known | {"doubts": tuple(given["doubts"])})


def read_shot_message(payload: bytes) -> ShotPublication:
    """Return the content of a message of the key `shot`.

    Raises:
        BenchError: the message is not of this version, or a key is missing or not of its type.
    """
    location = "shot message"
    read = json_object(payload)
    if read is None or read.get("version") != SHOT_VERSION:
        raise BenchError(location, repr(payload[:40]), f"an object of version {SHOT_VERSION}", _ACTION)
    require_fit(read, ShotPublication, location, _ACTION)
    return cast(ShotPublication, read)


def shortened(text: str) -> str:
    """Return `text`, cut to the max length of a reason."""
    return text if len(text) <= _MAX_TEXT_LENGTH else f"{text[: _MAX_TEXT_LENGTH - 1]}…"


MAX_RECORD_WAIT = 60.0
"""Max time for which an outcome waits for the record of its swing (s)."""
_MAX_REMEMBERED = 64
"""Records that are remembered, and outcomes that wait."""


class ShotJoin:
    """Outcomes and records that wait for each other; time is an argument."""

    def __init__(self) -> None:
        self._records: dict[str, Mapping[str, Any]] = {}
        self._waiting: list[tuple[float, ShotPublication]] = []

    def note_record(self, shot_id: str, facts: Mapping[str, Any]) -> None:
        """Add the known keys of a shot's record."""
        self._records[shot_id] = facts
        for old in list(self._records)[:-_MAX_REMEMBERED]:
            del self._records[old]

    def note_outcome(self, message: ShotPublication, now: float) -> None:
        """Add an outcome at `now` (s)."""
        self._waiting.append((now + MAX_RECORD_WAIT, message))

    def take(self, now: float) -> list[ShotPublication]:
        """Return the outcomes that need not or must not wait any longer, in order."""
        due, left = list[ShotPublication](), list[tuple[float, ShotPublication]]()
        for n, (last, message) in enumerate(self._waiting):
            shot = message["shot_id"]
            record = self._records.get(shot or "")
            if shot is None or record or now > last or n < len(self._waiting) - _MAX_REMEMBERED:
                due.append({**message, **(record or {})})  # type: ignore[typeddict-item]
            else:
                left.append((last, message))
        self._waiting = left
        return due
