"""A launch monitor that sees the plant's balls and tells of them over GSPro's Open Connect, with its faults.

It is a client of the bench's own server and written from the protocol's description alone. What real ones do
can be switched on: noise, misread figures, spin not seen, shots told twice or not at all, numbers as text,
other spellings, messages in pieces. Of one seed and shot number always the same comes.
"""

from __future__ import annotations

import errno
import json
import socket
from contextlib import suppress
from dataclasses import dataclass
from math import cos, degrees, pi, sin
from typing import Annotated, Any, NamedTuple

import numpy as np

from drivers.base import Launch
from drivers.base.ranges import Range, check_ranges

MPH, RPM = 0.44704, pi / 30.0
"""m/s; rad/s."""
HEARTBEAT, RECONNECT = 2.0, 5.0
"""s between two heartbeats, and between two attempts to connect."""
_PIECE = 200
"""Bytes of a piece, about, where messages are sent in pieces."""

Share = Annotated[float, Range(0.0, 1.0, "")]


@dataclass(frozen=True)
class MonitorParameters:
    """How well the monitor measures and how badly it behaves; shares are of shots.

    The noise is a good radar's or camera's; assumption, there are no published figures. Faults are off.
    """

    speed_noise: Annotated[float, Range(0.0, 0.2, "")] = 0.005
    """Standard deviation as a share of the speed."""
    angle_noise: Annotated[float, Range(0.0, 0.2, "rad")] = 0.0035
    """Of launch angle and direction."""
    spin_noise: Annotated[float, Range(0.0, 0.5, "")] = 0.02
    """As a share of the spin."""
    axis_noise: Annotated[float, Range(0.0, 0.5, "rad")] = 0.017
    delay: Annotated[float, Range(0.0, 30.0, "s")] = 0.6
    """From impact to message."""
    delay_spread: Annotated[float, Range(0.0, 30.0, "s")] = 0.2
    """More than that at most, evenly spread."""
    missing: Share = 0.0
    """Not told at all."""
    dropped: tuple[int, ...] = ()
    """Numbers of balls, from 1, that are not told either."""
    double: Share = 0.0
    """Told a second time as a shot of its own, measured anew."""
    repeated: Share = 0.0
    """The same message sent again."""
    misread: Share = 0.0
    """One figure is wrong: a launch angle of 0, ten times the speed, a spin of thousands too much."""
    no_spin: Share = 0.0
    club: bool = False
    """Also tells of the club, as dearer ones do; with the noise of the ball's speed and angles."""
    ghost: Share = 0.0
    """After the shot one that nobody hit, half a minute later."""
    text_numbers: bool = False
    """Numbers as text, and components of the spin only."""
    other_spelling: bool = False
    pieces: bool = False
    seed: int = 1

    def __post_init__(self) -> None:
        """Raise ValueError when a value leaves its range."""
        check_ranges(self)


class ClubMotion(NamedTuple):
    """How the club came, as far as a monitor tells."""

    speed: float
    """m/s"""
    attack_angle: float
    """rad"""


class Planned(NamedTuple):
    """A message and when it goes out, s after the impact."""

    delay: float
    message: bytes


def messages_of(
    launch: Launch, number: int, p: MonitorParameters, club: ClubMotion | None = None
) -> list[Planned]:
    """Return what the monitor tells of ball `number` that left with `launch`, in the order of time.

    `club` is what struck it; None: the monitor did not see it.
    """
    chance = np.random.default_rng([p.seed, number])
    # One draw for each question, so that switching one fault on moves no other.
    missing, double, repeated, misread, no_spin, ghost = chance.random(6)
    delays = p.delay + p.delay_spread * np.sort(chance.random(3))
    figures = [_measured(launch, p, chance) for _ in range(2)]
    kind = int(chance.integers(3))
    if missing < p.missing or number in p.dropped:
        return []
    if misread < p.misread:
        figures[0] = _misread(figures[0], kind)
    seen = _club_seen(club, number, p)
    messages = [_message(f, 2 * number + n, p, no_spin < p.no_spin, seen) for n, f in enumerate(figures)]
    planned = [Planned(float(delays[0]), messages[0])]
    if repeated < p.repeated:
        planned.append(Planned(float(delays[1]), messages[0]))
    if double < p.double:
        planned.append(Planned(float(delays[2]), messages[1]))
    if ghost < p.ghost:
        planned.append(Planned(30.0, messages[1]))
    return planned


def _measured(launch: Launch, p: MonitorParameters, chance: np.random.Generator) -> Launch:
    a, b, c, d, e = chance.standard_normal(5)
    return Launch(
        launch.speed * (1.0 + p.speed_noise * a),
        launch.launch_angle + p.angle_noise * b,
        launch.direction + p.angle_noise * c,
        launch.spin * (1.0 + p.spin_noise * d),
        launch.spin_axis + p.axis_noise * e,
    )


def _club_seen(club: ClubMotion | None, number: int, p: MonitorParameters) -> ClubMotion | None:
    if club is None or not p.club:
        return None
    a, b = np.random.default_rng([p.seed, number, 1]).standard_normal(2)  # moves no draw of the ball's
    return ClubMotion(club.speed * (1.0 + p.speed_noise * a), club.attack_angle + p.angle_noise * b)


def _misread(launch: Launch, kind: int) -> Launch:
    match kind:
        case 0:
            return launch._replace(launch_angle=0.0)
        case 1:
            return launch._replace(speed=10.0 * launch.speed)
        case _:
            return launch._replace(spin=launch.spin + 16_000.0 * RPM)


def _message(
    launch: Launch, number: int, p: MonitorParameters, no_spin: bool, club: ClubMotion | None
) -> bytes:
    def shown(value: float, digits: int) -> float | str:
        return f"{value:.{digits}f}" if p.text_numbers else round(value, digits)

    spin, axis = launch.spin / RPM, launch.spin_axis
    ball: dict[str, Any] = {
        "Speed": shown(launch.speed / MPH, 3),
        "VLA": shown(degrees(launch.launch_angle), 3),
        "HLA": shown(degrees(launch.direction), 3),
    }
    if no_spin:
        ball |= {"TotalSpin": shown(0.0, 1), "SpinAxis": shown(0.0, 1)}
    elif p.text_numbers:
        back = "Backspin" if p.other_spelling else "BackSpin"
        ball |= {"TotalSpin": "0.0", back: shown(spin * cos(axis), 2), "SideSpin": shown(spin * sin(axis), 2)}
    else:
        ball |= {"TotalSpin": shown(spin, 2), "SpinAxis": shown(degrees(axis), 3)}
    more = {"BallData": ball}
    if club is not None:
        speed, attack = shown(club.speed / MPH, 3), shown(degrees(club.attack_angle), 3)
        more["ClubData"] = {"Speed": speed, "AngleOfAttack": attack}
    return _root(number, p, {"ContainsBallData": True, "ContainsClubData": club is not None}, more)


def _root(number: int, p: MonitorParameters, options: dict[str, Any], more: dict[str, Any]) -> bytes:
    root: dict[str, Any] = {
        "DeviceID": "simulated monitor",
        "Units": "Yards",
        "ShotNumber": number,
        "APIVersion" if p.other_spelling else "APIversion": "1",
        "ShotDataOptions": {
            **options,
            "LaunchMonitorIsReady": True,
            "LaunchMonitorBallDetected": True,
        },
        **more,
    }
    return json.dumps(root, indent=1 if p.other_spelling else None).encode()


class _Outgoing(NamedTuple):
    due: float
    message: bytes


class SimulatedMonitor:
    """The monitor at work: `see` what is struck, `step` often. It never waits and has no thread."""

    def __init__(self, parameters: MonitorParameters, address: str, port: int) -> None:
        self.parameters = parameters
        self.answers = b""
        """What the server answered, the newest 64 KiB."""
        self.sent = 0
        """Messages of shots that went out whole."""
        self._place = (address, port)
        self._waiting: list[_Outgoing] = []
        self._number = 0
        self._connection: socket.socket | None = None
        self._connected = False
        self._next_attempt = self._next_heartbeat = -float("inf")
        self._unsent = bytearray()

    @property
    def connected(self) -> bool:
        """Whether the server has taken the connection."""
        return self._connected

    @property
    def waiting(self) -> int:
        """Messages that have still to go out."""
        return len(self._waiting) + bool(self._unsent)

    def see(self, launch: Launch, time: float, club: ClubMotion | None = None) -> None:
        """Notice a ball that leaves with `launch` at `time` (s, the clock of `step`), and the `club`."""
        self._number += 1
        planned = messages_of(launch, self._number, self.parameters, club)
        self._waiting += [_Outgoing(time + delay, message) for delay, message in planned]
        self._waiting.sort(key=lambda outgoing: outgoing.due)

    def step(self, time: float) -> None:
        """Do what is due at `time`: connect, send, take answers."""
        try:
            self._step(time)
        except OSError:  # not there, or gone: again later
            self.close()
            self._next_attempt = time + RECONNECT

    def close(self) -> None:
        """Hang up. Allowed in any state; a later `step` connects anew."""
        if self._connection is not None:
            self._connection.close()
        self._connection, self._connected = None, False
        self._unsent.clear()

    def _step(self, time: float) -> None:
        if self._connection is None and time >= self._next_attempt:
            family = socket.AF_INET6 if ":" in self._place[0] else socket.AF_INET
            self._connection = socket.socket(family, socket.SOCK_STREAM)
            self._connection.setblocking(False)
            self._next_attempt = time + RECONNECT
        if self._connection is None:
            return
        if not self._connected:
            result = self._connection.connect_ex(self._place)
            if result in (errno.EINPROGRESS, errno.EALREADY):
                return
            if result not in (0, errno.EISCONN):
                raise OSError(result, "connect")
            self._connected = True
        if time >= self._next_heartbeat:
            self._next_heartbeat = time + HEARTBEAT
            options = {"ContainsBallData": False, "ContainsClubData": False, "IsHeartBeat": True}
            self._unsent += _root(self._number, self.parameters, options, {})
        while self._waiting and self._waiting[0].due <= time:
            self._unsent += self._waiting.pop(0).message
            self.sent += 1
        with suppress(BlockingIOError):
            while self._unsent:
                piece = self._unsent[:_PIECE] if self.parameters.pieces else self._unsent
                del self._unsent[: self._connection.send(piece)]
                if self.parameters.pieces:
                    break  # the rest at the next step
        with suppress(BlockingIOError):
            if not (answer := self._connection.recv(65_536)):
                raise ConnectionError("closed")
            self.answers = (self.answers + answer)[-65_536:]
