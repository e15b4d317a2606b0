"""GSPro's Open Connect, version 1: its messages, read tolerantly and written exactly.

Accepted variants: any `APIversion` with the fields of version 1, numbers as strings, other capitals and
underscores in names, `BackSpin` and `SideSpin` instead of `TotalSpin` and `SpinAxis`, missing figures, null
or 0 for values that were not measured: 0 rpm, no carry, 0 degrees of loft, a strike of exactly 0 in both
directions, and every club figure of 0 where the club has no speed or all others are 0. A ball of speed 0 is
no ball: the message is one of the club, or of the status if all are 0 and the monitor is ready and sees a
ball. Fields of known devices that hold something else are ignored, see `quirks.toml`.
Speeds are mph whatever `Units` says; `CarryDistance` is in yards without `Units`, and absent with one that
is unknown. Angles keep their signs: `HLA`, `SpinAxis` and `SideSpin` are positive to the right.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cache
from math import atan2, cos, degrees, hypot, isfinite, pi, sin
from pathlib import Path
from typing import Any, NamedTuple

from drivers.base import Launch
from drivers.base.ranges import read_number
from drivers.launch_monitor.record import NO_CLUB, ClubFigures, ClubRecord, LaunchRecord

MPH = 0.44704
"""Mile per hour (m/s)."""
YARD = 0.9144
"""Yard (m)."""
RPM = pi / 30.0
"""Revolution per minute (rad/s)."""

SHOT_TAKEN, PLAYER, READY, ENDED, FAILURE, TOO_LARGE = 200, 201, 202, 203, 501, 413
"""Answer codes."""

CLUB_CODE = re.compile(r"DR|PT|[PGSL]W|[WH][2-7]|I[1-9]")
"""Clubs that monitors know; some do not parse any other."""

MAX_NAME_LENGTH = 64
"""Maximum number of characters kept of a device name."""


class ReportedStatus(NamedTuple):
    """Status of a monitor from a heartbeat or a message without a shot; None for values not sent."""

    device: str
    heartbeat: bool
    ready: bool | None = None
    ball_detected: bool | None = None
    ball_data: bool = False
    """Whether the message is announced as one of a ball, so that the monitor may await an answer."""


class RejectedMessage(NamedTuple):
    """A rejected message with the reason."""

    code: int
    reason: str


Message = LaunchRecord | ClubRecord | ReportedStatus | RejectedMessage


class _Bounds(NamedTuple):
    """Possible range of a figure in the unit of the protocol, and the factor to SI."""

    low: float
    high: float
    unit: str
    factor: float


_SPEED = _Bounds(0.09, 300.0, "mph", MPH)
_ELEVATION = _Bounds(-90.0, 90.0, "deg", pi / 180.0)
_AZIMUTH = _Bounds(-180.0, 180.0, "deg", pi / 180.0)
_SPIN = _Bounds(0.0, 20_000.0, "rpm", RPM)
_BACK_SPIN = _Bounds(-20_000.0, 20_000.0, "rpm", RPM)
_CARRY_YD = _Bounds(0.0, 600.0, "yd", YARD)
_CARRY_M = _Bounds(0.0, 550.0, "m", 1.0)
_CARRY = {
    **dict.fromkeys(("", "yards", "yard", "yds", "yd", "imperial"), _CARRY_YD),
    **dict.fromkeys(("meters", "metres", "meter", "metre", "m", "metric"), _CARRY_M),
}
"""Bounds of the carry by `Units` in lower case; the specification's default is yards."""
_BALL_FIELDS = ("Speed", "VLA", "HLA", "TotalSpin", "SpinAxis", "BackSpin", "SideSpin")
_STRIKE = _Bounds(-100.0, 100.0, "mm", 1e-3)
_CLUB = {
    "speed": ("Speed", _SPEED),
    "attack_angle": ("AngleOfAttack", _ELEVATION),
    "path": ("Path", _ELEVATION),
    "face_angle": ("FaceToTarget", _ELEVATION),
    "dynamic_loft": ("Loft", _ELEVATION),
    "strike_x": ("HorizontalFaceImpact", _STRIKE),
    "strike_y": ("VerticalFaceImpact", _STRIKE),
}
"""Fields of the club and their bounds, by the names of `ClubFigures`."""
_NOT_MEASURED = "0: not measured"


def read_message(data: bytes, time: float) -> Message:
    """Parse the object `data`; `time` (s) is stored in the record. Never raises."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError) as error:
        return RejectedMessage(FAILURE, f"invalid JSON: {_short(error)}")
    if not isinstance(tree, dict):
        return RejectedMessage(FAILURE, "not a JSON object")
    root = _plain_names(tree)
    options, ball, club = (
        _plain_names(part) if isinstance(part, dict) else {}
        for part in (root.get("shotdataoptions", root), root.get("balldata"), root.get("clubdata"))
    )
    flags = (
        "containsballdata",
        "containsclubdata",
        "isheartbeat",
        "launchmonitorisready",
        "launchmonitorballdetected",
    )
    has_ball, has_club, heartbeat, ready, detected = (_yes(options.get(name)) for name in flags)
    status = ReportedStatus(_text(root.get("deviceid")), bool(heartbeat), ready, detected)
    if has_ball is None:
        has_ball = bool(ball) and not heartbeat
    if has_club is None:
        has_club = bool(club) and not heartbeat
    if not has_ball and not has_club:
        told = any(name in options for name in flags)
        return status if told else _unknown_layout("neither BallData nor ShotDataOptions", root)
    figures = _Figures(ball, club if has_club else {}, quirk_of(status.device))
    ball_known = any(name.lower() in ball for name in _BALL_FIELDS)
    if has_ball and ball_known and _number(ball.get("speed")) != 0.0:
        return _record(figures, time, status.device, root)
    known = figures.of_club()
    if any(value is not None for value in known):
        return ClubRecord(time, status.device, known, tuple(figures.absent))
    if not has_ball:
        return status
    if "speed" in ball and ready and detected and not any(map(_number, ball.values())):  # not yet struck
        return status._replace(ball_data=True)
    if "speed" in ball:
        return RejectedMessage(SHOT_TAKEN, "a ball of speed 0, and no club")
    found = f"BallData of {_short(', '.join(ball))}" if ball else "ContainsBallData without BallData"
    return _unknown_layout(f"{found}, expected {', '.join(_BALL_FIELDS)}", root)


def _unknown_layout(found: str, root: Mapping[str, Any]) -> RejectedMessage:
    """Return the refusal of a message without the fields of version 1; names its `APIversion` if another."""
    version = root.get("apiversion")
    other = "" if version is None or _number(version) == 1.0 else f"; APIversion {_short(version)}"
    return RejectedMessage(FAILURE, found + other)


class _Figures:
    """Figures of one message in SI; those without a measurement are collected with their reason."""

    def __init__(self, ball: Mapping[str, Any], club: Mapping[str, Any], quirk: MonitorQuirk | None) -> None:
        self.ball, self.club, self._quirk = ball, club, quirk
        self.absent: list[tuple[str, str]] = []

    def of_ball(self, name: str, key: str, bounds: _Bounds, *, measured_zero: bool = True) -> float | None:
        """Return a figure of the ball."""
        return self._kept(name, self.value(self.ball, key, bounds, measured_zero=measured_zero))

    def of_club(self) -> ClubFigures:
        """Return the figures of the club."""
        club = self.club
        if not club:
            return NO_CLUB
        sent = {
            name: self.value(club, key, bounds, measured_zero=name != "dynamic_loft")
            for name, (key, bounds) in _CLUB.items()
        }
        strike = {name: sent[name] for name in ("strike_x", "strike_y")}
        if not any(isinstance(part, float) and part for part in strike.values()):
            sent |= {name: _NOT_MEASURED for name, part in strike.items() if part == 0.0}
        moving = any(isinstance(value, float) and value for name, value in sent.items() if name != "speed")
        resting = isinstance(sent["speed"], str) or not moving
        return ClubFigures(
            *(
                self._kept(f"club.{name}", _NOT_MEASURED if resting and value == 0.0 else value)
                for name, value in sent.items()
            )
        )

    def value(
        self, data: Mapping[str, Any], key: str, bounds: _Bounds, *, measured_zero: bool = True
    ) -> float | str:
        """Return the figure in SI, or why it is missing."""
        value, sent, of_club = _figure(data, key, bounds), data.get(key.lower()), data is self.club
        if self._quirk is not None and self._quirk.covers(key, sent, of_club=of_club):
            return f"{key} of this device: {self._quirk.reason}"
        return _NOT_MEASURED if value == 0.0 and not measured_zero else value

    def is_coded(self, key: str) -> bool:
        """Return whether the ball's field `key` has a value that states no measurement."""
        return self._quirk is not None and self._quirk.is_code(key, self.ball.get(key.lower()))

    def _kept(self, name: str, value: float | str) -> float | None:
        if isinstance(value, str):
            self.absent.append((name, value))
            return None
        return value


def _record(figures: _Figures, time: float, device: str, root: Mapping[str, Any]) -> LaunchRecord:
    units, number = _text(root.get("units")).strip(), _number(root.get("shotnumber"))
    speed = figures.of_ball("speed", "Speed", _SPEED)
    launch_angle = figures.of_ball("launch_angle", "VLA", _ELEVATION)
    direction = figures.of_ball("direction", "HLA", _AZIMUTH)
    spin, spin_axis = _spin(figures)
    for name, value in (("spin", spin), ("spin_axis", spin_axis)):
        if isinstance(value, str):
            figures.absent.append((name, value))
    bounds = _CARRY.get(units.lower())
    carry = figures.of_ball("carry", "CarryDistance", bounds or _CARRY_M, measured_zero=False)
    if carry is not None and bounds is None:
        carry = None
        figures.absent.append(("carry", f"CarryDistance in Units {_short(units)}, expected Yards or Meters"))
    club = figures.of_club()
    return LaunchRecord(
        time=time,
        device=device,
        number=int(number) if number is not None and 0 <= number <= 1e9 and number == int(number) else None,
        speed=speed,
        launch_angle=launch_angle,
        direction=direction,
        spin=None if isinstance(spin, str) else spin,
        spin_axis=None if isinstance(spin_axis, str) else spin_axis,
        carry=carry,
        club=club,
        absent=tuple(figures.absent),
    )


def _spin(figures: _Figures) -> tuple[float | str, float | str]:
    """Return spin (rad/s) and axis (rad), each replaced by a reason if unknown.

    Total spin and axis take precedence over the components, which may disagree, as in the specification's own
    example; an axis of 0 with a side spin does not. No ball leaves a club without spin: 0 rpm means that
    spin was not measured.
    """
    ball, value = figures.ball, figures.value
    total, axis = value(ball, "TotalSpin", _SPIN), value(ball, "SpinAxis", _AZIMUTH)
    back, side = value(ball, "BackSpin", _BACK_SPIN), value(ball, "SideSpin", _BACK_SPIN)
    for key, read in (("TotalSpin", total), ("BackSpin", back)):
        if figures.is_coded(key):
            return read, read
    if not isinstance(total, str) and total == 0.0:
        total = "0 rpm: not measured"
    if isinstance(back, float) and isinstance(side, float) and (back or side):
        if isinstance(total, str):
            total, axis = hypot(back, side), atan2(side, back)
        elif isinstance(axis, str) or (axis == 0.0 and side):
            axis = atan2(side, back)
    return total, total if isinstance(total, str) else axis


def write_shot(
    number: int, launch: Launch, device: str, club: ClubFigures = NO_CLUB, carry: float | None = None
) -> bytes:
    """Return the message of a shot (SI in, protocol units out), ending with a line feed.

    Raises:
        ValueError: a figure is not finite.
    """
    speed, launch_angle, direction, spin, spin_axis = launch
    ball = {
        "Speed": speed / MPH,
        "SpinAxis": degrees(spin_axis),
        "TotalSpin": spin / RPM,
        "BackSpin": spin / RPM * cos(spin_axis),
        "SideSpin": spin / RPM * sin(spin_axis),
        "HLA": degrees(direction),
        "VLA": degrees(launch_angle),
    }
    if carry is not None:
        ball["CarryDistance"] = carry / YARD
    known = [(*_CLUB[name], value) for name, value in club._asdict().items() if value is not None]
    of_club = {key: value / bounds.factor for key, bounds, value in known}
    if club.speed is not None:
        of_club["SpeedAtImpact"] = of_club["Speed"]
    return _written(
        {
            **_head(device, number),
            "BallData": {name: round(value, 4) for name, value in ball.items()},
            "ClubData": {name: round(value, 4) for name, value in of_club.items()},
            "ShotDataOptions": _options(ball=True, club=bool(of_club)),
        }
    )


def write_heartbeat(number: int, device: str) -> bytes:
    """Return a heartbeat; `number` is the number of the last shot."""
    return _written({**_head(device, number), "ShotDataOptions": _options(heartbeat=True)})


def _head(device: str, number: int) -> dict[str, Any]:
    return {"DeviceID": device, "Units": "Yards", "ShotNumber": number, "APIversion": "1"}


def _options(*, ball: bool = False, club: bool = False, heartbeat: bool = False) -> dict[str, bool]:
    return {
        "ContainsBallData": ball,
        "ContainsClubData": club,
        "LaunchMonitorIsReady": True,
        "LaunchMonitorBallDetected": ball,
        "IsHeartBeat": heartbeat,
    }


# Known monitors ----------------------------------------------------------------------------------

_QUIRKS_FILE = Path(__file__).with_name("quirks.toml")


class MonitorQuirk(NamedTuple):
    """A family of known monitors whose fields hold something else than their names say."""

    name: str
    devices: tuple[str, ...]
    """Device names as they send them; one that ends in `*` covers all that begin so."""
    ignore: frozenset[str]
    """Fields without a measurement, in lower case; `club.speed` is that of the club only."""
    codes: Mapping[str, frozenset[float]]
    """Values by field, in lower case, that state no measurement."""
    reason: str
    source: str
    """Source of this entry: repository, commit and file."""

    def covers(self, key: str, value: Any, *, of_club: bool) -> bool:
        """Return whether field `key`, of club or ball, holds no measurement with this `value`."""
        name = key.lower()
        ignored = name in self.ignore or (of_club and f"club.{name}" in self.ignore)
        return ignored or self.is_code(key, value)

    def is_code(self, key: str, value: Any) -> bool:
        """Return whether this `value` of field `key` states no measurement."""
        return _number(value) in self.codes.get(key.lower(), ())


@cache
def quirks() -> Mapping[str, MonitorQuirk]:
    """Return the quirks by device name in lower case."""
    found: dict[str, MonitorQuirk] = {}
    for name, entry in tomllib.loads(_QUIRKS_FILE.read_text(encoding="utf-8-sig")).items():
        ignore = frozenset(field.lower() for field in entry.get("ignore", ()))
        codes = {field.lower(): frozenset(values) for field, values in entry.get("codes", {}).items()}
        quirk = MonitorQuirk(name, tuple(entry["names"]), ignore, codes, entry["reason"], entry["source"])
        found |= {device.lower(): quirk for device in quirk.devices}
    return found


def quirk_of(device: str) -> MonitorQuirk | None:
    """Return the quirk of the monitor that calls itself `device`; None if it has none."""
    name, known = device.strip().lower(), quirks()
    return known.get(name) or next((one for key, one in known.items() if fnmatchcase(name, key)), None)


# Answers -----------------------------------------------------------------------------------------


class SimulatorResponse(NamedTuple):
    """Answer of a simulator."""

    code: int
    text: str
    club: str = ""
    """Club of the player in GSPro's code (DR, W3, I7, PT ...); informative only."""
    handed: str = ""


def write_answer(code: int, text: str) -> bytes:
    """Return an answer; senders expect no line feed."""
    return json.dumps({"Code": code, "Message": text}).encode()


def write_player(club: str) -> bytes:
    """Return the player message: right-handed, as the robot is, 230 m from the target."""
    player = {"Handed": "RH", "Club": club, "DistanceToTarget": round(230.0 / YARD, 1)}
    return json.dumps({"Code": PLAYER, "Message": "GSPro Player Information", "Player": player}).encode()


def write_ready() -> bytes:
    """Return the message that shots are awaited: some monitors do not arm before."""
    return write_answer(READY, "GSPro ready")


def write_ended() -> bytes:
    """Return the message that no more shots are awaited."""
    return write_answer(ENDED, "GSPro round ended")


def club_code(name: str) -> str:
    """Return the code of a club from its name, such as I7 for "iron7"; a driver's if it is unclear."""
    words = re.fullmatch(r"(driver|putter|wood|hybrid|iron|pw|gw|sw|lw)[ _-]?([1-9]?)", name.strip().lower())
    if words is None:
        return "DR"
    kind, number = words.groups()
    code = {"driver": "DR", "putter": "PT", "wood": "W", "hybrid": "H", "iron": "I"}.get(kind, kind.upper())
    code = f"{code}{number}" if len(code) == 1 else code
    return code if CLUB_CODE.fullmatch(code) else "DR"


def read_answer(data: bytes) -> SimulatorResponse | None:
    """Parse an answer; None if invalid. Never raises."""
    try:
        tree = json.loads(data)
    except (ValueError, RecursionError):
        return None
    root = _plain_names(tree) if isinstance(tree, dict) else {}
    code = _number(root.get("code"))
    if code is None or not 100 <= code <= 999:
        return None
    player = root.get("player")
    player = _plain_names(player) if isinstance(player, dict) else {}
    return SimulatorResponse(
        int(code), _text(root.get("message")), _text(player.get("club")), _text(player.get("handed"))
    )


# Values ------------------------------------------------------------------------------------------


def _written(tree: dict[str, Any]) -> bytes:
    return json.dumps(tree, allow_nan=False).encode() + b"\n"


def _plain_names(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return `tree` with names in lower case, without spaces and underscores."""
    return {name.replace("_", "").replace(" ", "").lower(): value for name, value in tree.items()}


def _figure(data: Mapping[str, Any], key: str, bounds: _Bounds) -> float | str:
    """Return the figure in SI, or why it is missing."""
    value = data.get(key.lower())
    if value is None or value == "":
        return f"no {key}"
    number = _number(value)
    if number is None:
        return f"{key} {_short(value)}, not a number"
    if not bounds.low <= number <= bounds.high:
        return f"{key} {number:g} {bounds.unit}, possible {bounds.low:g} to {bounds.high:g}"
    return number * bounds.factor


def _number(value: Any) -> float | None:
    """Return a finite number given as number or text, else None."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    if isinstance(value, str) and len(value) > 40:
        return None
    try:
        number = read_number(value) if isinstance(value, str) else float(value)
    except (ValueError, OverflowError):
        return None
    return number if isfinite(number) else None


def _yes(value: Any) -> bool | None:
    """Return a Boolean given as Boolean, 0 or 1, or text; None if invalid."""
    if isinstance(value, bool):
        return value
    return {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}.get(
        str(value).strip().lower() if isinstance(value, (int, str)) else ""
    )


def _text(value: Any) -> str:
    """Return printable text, truncated; empty if not text."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return _short(value)
    return "".join(c for c in value[:MAX_NAME_LENGTH] if c.isprintable()) if isinstance(value, str) else ""


def _short(value: Any) -> str:
    try:
        text = str(value) if isinstance(value, BaseException) else repr(value)
    except (ValueError, RecursionError):  # an integer of more digits than Python prints
        return type(value).__name__
    printable = "".join(c if c.isprintable() else "?" for c in text[:MAX_NAME_LENGTH])
    return printable if len(text) <= MAX_NAME_LENGTH else f"{printable}..."
