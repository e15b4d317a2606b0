"""Messages of `golfbench/<id>/shot`: their keys, writing and reading.

JSON of the keys of `ShotPublication`, always all of them; an unknown value is null.

A bench without a launch monitor sends one message a swing, when its record is stored. With one it sends a
second message with the outcome, and one for every launch that belongs to no swing or came too often.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypedDict, cast

from bench.errors import BenchError
from bench.lifecycle import Cause
from bench.shot.shot import Shot
from drivers.launch_monitor.matching import MatchOutcome
from drivers.launch_monitor.record import SOURCE, ClubFigures, LaunchRecord

SHOT_VERSION = 1

_LONGEST_TEXT = 300
"""Max length of a reason, characters."""
_PLAIN = ("speed", "launch_angle", "direction", "spin", "spin_axis", "carry")
_CURE = "Use the same golfbench for bench and command line."


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
    message: dict[str, Any] = {**dict.fromkeys(ShotPublication.__annotations__), "version": SHOT_VERSION}
    for name, value in ({"reason": ""} | known).items():
        if name not in message:
            raise KeyError(name)
        message[name] = value
    return cast(ShotPublication, message)


class ShotMessage(NamedTuple):
    """A message that was read; missing parts are None or empty."""

    shot_id: str
    record: Path | None
    number: int | None
    tick: int | None
    """At which the swing began."""
    cause: str
    """Name of the first cause of a stop in the record; empty while it is not stored."""
    shot: Mapping[str, Any] | None
    """Row of the shot table, its names and units."""
    outcome: MatchOutcome | None
    launch: LaunchRecord | None
    reason: str


def launch_to_json(launch: LaunchRecord) -> dict[str, Any]:
    """Return `launch` as a JSON object: m/s, rad, rad/s, m, s; figures that are not known are null."""
    return {
        "time": launch.time,
        "device": launch.device,
        "number": launch.number,
        **{name: getattr(launch, name) for name in _PLAIN},
        "club": launch.club._asdict(),
        "absent": [[name, shortened(why)] for name, why in launch.absent],
        "doubts": [shortened(doubt) for doubt in launch.doubts],
        "source": launch.source,
    }


def launch_from_json(given: Any, place: str) -> LaunchRecord:
    """Return the launch with the JSON object `given`; `place` names it.

    Raises:
        BenchError: a figure is missing, not a number, or not finite.
    """
    if not isinstance(given, Mapping):
        raise BenchError(place, repr(given)[:60], "an object", _CURE)
    try:
        club, number = given["club"], given["number"]
        if not isinstance(club, Mapping) or not (number is None or type(number) is int):
            raise TypeError("club or number")
        return LaunchRecord(
            time=_figure(given["time"]) or 0.0,
            device=_text(given["device"]),
            number=number,
            **{name: _figure(given[name]) for name in _PLAIN},
            club=ClubFigures(**{str(name): _figure(value) for name, value in club.items()}),
            absent=tuple((_text(name), _text(why)) for name, why in given["absent"]),
            doubts=tuple(_text(doubt) for doubt in given["doubts"]),
            source=_text(given.get("source", SOURCE)),
        )
    except (KeyError, TypeError, ValueError) as error:
        names = ", ".join(field.name for field in fields(LaunchRecord))
        raise BenchError(place, f"{type(error).__name__}: {error}", f"the figures {names}", _CURE) from None


def read_shot_message(payload: bytes) -> ShotMessage:
    """Return the content of a message of the key `shot`.

    Raises:
        BenchError: the message is not of this version.
    """
    place = "shot message"
    try:
        read = json.loads(payload)
    except (ValueError, RecursionError):
        read = None
    if not isinstance(read, dict) or read.get("version") != SHOT_VERSION:
        raise BenchError(place, repr(payload[:40]), f"an object of version {SHOT_VERSION}", _CURE)
    record, outcome, launch = read.get("record"), read.get("outcome"), read.get("launch")
    number, tick, shot = read.get("number"), read.get("tick"), read.get("shot")
    whole = isinstance(number, int | None) and isinstance(tick, int | None)
    if not (whole and isinstance(shot, dict | None)):
        found = f"number {number!r}, tick {tick!r}, shot {type(shot).__name__}"
        raise BenchError(place, found, "whole numbers, and a row", _CURE)
    try:
        return ShotMessage(
            _text(read.get("shot_id") or ""),
            None if record is None else Path(_text(record)),
            number,
            tick,
            _text(read.get("cause") or ""),
            shot,
            None if outcome is None else MatchOutcome(outcome),
            None if launch is None else launch_from_json(launch, f"{place}: launch"),
            _text(read.get("reason") or ""),
        )
    except (TypeError, ValueError) as error:
        raise BenchError(place, str(error), f"a shot of version {SHOT_VERSION}", _CURE) from None


def shortened(text: str) -> str:
    """Return `text`, cut where it is longer than anybody reads."""
    return text if len(text) <= _LONGEST_TEXT else f"{text[: _LONGEST_TEXT - 1]}…"


def _figure(value: Any) -> float | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise TypeError(f"{value!r} is not a finite number")
    return float(value)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is not a text")
    return value
