"""Simulated launch monitor: reports the plant's balls over GSPro's Open Connect, with configurable faults.

It is a client of the bench's own server and written from the protocol's description alone. Faults of real
monitors can be enabled: noise, misread figures, missing spin, repeated or missing shots. The same seed and
shot number give the same messages.
"""

from __future__ import annotations

import errno
import json
import socket
from contextlib import suppress
from dataclasses import dataclass
from math import degrees, pi
from typing import Annotated, Any, NamedTuple

import numpy as np

from drivers.base import Launch
from drivers.base.ranges import Range, check_ranges

MPH, RPM, YARD = 0.44704, pi / 30.0, 0.9144
"""Units in m/s, rad/s and m."""
HEARTBEAT, RECONNECT = 2.0, 5.0
"""Heartbeat period and reconnection period, s."""

Share = Annotated[float, Range(0.0, 1.0, "")]


@dataclass(frozen=True)
class MonitorParameters:
    """Noise and faults of the monitor; shares are of shots.

    The noise is that of a good radar or camera (assumption, no published figures). Faults are off by default.
    """

    speed_noise: Annotated[float, Range(0.0, 0.2, "")] = 0.005
    """Standard deviation of the speed, as a share of the speed."""
    angle_noise: Annotated[float, Range(0.0, 0.2, "rad")] = 0.0035
    """Standard deviation of launch angle and direction, rad."""
    spin_noise: Annotated[float, Range(0.0, 0.5, "")] = 0.02
    """Standard deviation of the spin, as a share of the spin."""
    axis_noise: Annotated[float, Range(0.0, 0.5, "rad")] = 0.017
    carry_noise: Annotated[float, Range(0.0, 0.2, "")] = 0.005
    """Standard deviation of the carry, as a share of the carry."""
    delay: Annotated[float, Range(0.0, 30.0, "s")] = 0.6
    """Minimum time from impact to message, s."""
    delay_spread: Annotated[float, Range(0.0, 30.0, "s")] = 0.2
    """Width of the uniformly distributed additional delay, s."""
    missing: Share = 0.0
    """Share of shots not reported."""
    dropped: tuple[int, ...] = ()
    """Numbers of further balls, from 1, that are not reported."""
    double: Share = 0.0
    """Share of shots reported a second time as a new shot with new noise."""
    repeated: Share = 0.0
    """Share of shots whose message is sent twice."""
    misread: Share = 0.0
    """Share of shots with one wrong figure: launch angle 0, ten times the speed, or far too much spin."""
    no_spin: Share = 0.0
    club: bool = False
    """Whether club figures are reported, with the noise of the ball's speed and angles."""
    ghost: Share = 0.0
    """Share of shots followed by a false shot half a minute later."""
    seed: int = 1

    def __post_init__(self) -> None:
        """Raise ValueError if a value is out of range."""
        check_ranges(self)


class ClubMotion(NamedTuple):
    """Club figures that a monitor reports."""

    speed: float
    """Club head speed, m/s."""
    attack_angle: float
    """Attack angle, rad."""


class Planned(NamedTuple):
    """A message and its send time."""

    due: float
    """Time after the impact, of a running monitor on its clock, s."""
    message: bytes


def monitor_messages(
    launch: Launch,
    number: int,
    p: MonitorParameters,
    club: ClubMotion | None = None,
    carry: float | None = None,
) -> list[Planned]:
    """Return the monitor's messages about ball `number` with `launch`, in order of time.

    `club` is the club motion at impact and `carry` (m) that of the true flight, None if not measured.
    """
    chance = np.random.default_rng([p.seed, number])
    # One draw per fault, so that enabling one fault does not change another.
    missing, double, repeated, misread, no_spin, ghost = chance.random(6)
    delays = p.delay + p.delay_spread * np.sort(chance.random(3))
    figures = [_measured(launch, p, chance) for _ in range(2)]
    kind = int(chance.integers(3))
    if missing < p.missing or number in p.dropped:
        return []
    if misread < p.misread:
        figures[0] = _misread(figures[0], kind)
    seen = _club_seen(club, number, p)
    flown = _carries_seen(carry, number, p)
    messages = [
        _message(f, 2 * number + n, no_spin < p.no_spin, seen, flown[n]) for n, f in enumerate(figures)
    ]
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
    # A separate stream: it does not change the ball's draws.
    a, b = np.random.default_rng([p.seed, number, 1]).standard_normal(2)
    return ClubMotion(club.speed * (1.0 + p.speed_noise * a), club.attack_angle + p.angle_noise * b)


def _carries_seen(carry: float | None, number: int, p: MonitorParameters) -> list[float | None]:
    """Return the carry of the first and the second message, each with its own noise."""
    if carry is None:
        return [None, None]
    noise = np.random.default_rng([p.seed, number, 2]).standard_normal(2)
    return [carry * (1.0 + p.carry_noise * float(one)) for one in noise]


def _misread(launch: Launch, kind: int) -> Launch:
    match kind:
        case 0:
            return launch._replace(launch_angle=0.0)
        case 1:
            return launch._replace(speed=10.0 * launch.speed)
        case _:
            return launch._replace(spin=launch.spin + 16_000.0 * RPM)


def _message(
    launch: Launch, number: int, no_spin: bool, club: ClubMotion | None, carry: float | None
) -> bytes:
    ball = {
        "Speed": round(launch.speed / MPH, 3),
        "VLA": round(degrees(launch.launch_angle), 3),
        "HLA": round(degrees(launch.direction), 3),
        "TotalSpin": 0.0 if no_spin else round(launch.spin / RPM, 2),
        "SpinAxis": 0.0 if no_spin else round(degrees(launch.spin_axis), 3),
    }
    if carry is not None:
        ball["CarryDistance"] = round(carry / YARD, 3)
    more = {"BallData": ball}
    if club is not None:
        speed, attack = round(club.speed / MPH, 3), round(degrees(club.attack_angle), 3)
        more["ClubData"] = {"Speed": speed, "AngleOfAttack": attack}
    return _root(number, {"ContainsBallData": True, "ContainsClubData": club is not None}, more)


def _root(number: int, options: dict[str, Any], more: dict[str, Any]) -> bytes:
    root: dict[str, Any] = {
        "DeviceID": "simulated monitor",
        "Units": "Yards",
        "ShotNumber": number,
        "APIversion": "1",
        "ShotDataOptions": {**options, "LaunchMonitorIsReady": True, "LaunchMonitorBallDetected": True},
        **more,
    }
    return json.dumps(root).encode()


class SimulatedMonitor:
    """A running monitor: call `see` for each ball and `step` often. It never blocks and has no thread."""

    def __init__(self, parameters: MonitorParameters, address: str, port: int) -> None:
        self.parameters = parameters
        self.answers = b""
        """Newest 64 KiB of the server's answers."""
        self.sent = 0
        """Number of shot messages sent completely."""
        self._place = (address, port)
        self._waiting: list[Planned] = []
        self._number = 0
        self._connection: socket.socket | None = None
        self._connected = False
        self._next_attempt = self._next_heartbeat = -float("inf")
        self._unsent = bytearray()
        self._in_flight: list[Planned] = []
        """Shots whose message is in `_unsent`; a dropped connection puts them back."""

    @property
    def connected(self) -> bool:
        """Whether the server has accepted the connection."""
        return self._connected

    @property
    def waiting(self) -> int:
        """Number of messages not yet sent."""
        return len(self._waiting) + bool(self._unsent)

    def see(
        self, launch: Launch, time: float, club: ClubMotion | None = None, carry: float | None = None
    ) -> None:
        """Measure a ball with `launch` at `time` (s, the clock of `step`), the `club` and the `carry` (m)."""
        self._number += 1
        planned = monitor_messages(launch, self._number, self.parameters, club, carry)
        self._waiting += [Planned(time + delay, message) for delay, message in planned]
        self._waiting.sort(key=lambda outgoing: outgoing.due)

    def step(self, time: float) -> None:
        """Do the work due at `time` (s): connect, send, receive answers."""
        try:
            self._step(time)
        except OSError:  # not reachable or disconnected: retry later
            self.close()
            self._next_attempt = time + RECONNECT

    def close(self) -> None:
        """Disconnect. Allowed in any state; a later `step` reconnects."""
        if self._connection is not None:
            self._connection.close()
        self._connection, self._connected = None, False
        self._unsent.clear()
        self._waiting[:0] = self._in_flight
        self._in_flight.clear()

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
            self._unsent += _root(self._number, options, {})
        while self._waiting and self._waiting[0].due <= time:
            self._in_flight.append(self._waiting.pop(0))
            self._unsent += self._in_flight[-1].message
        with suppress(BlockingIOError):
            while self._unsent:
                del self._unsent[: self._connection.send(self._unsent)]
        if not self._unsent:
            self.sent += len(self._in_flight)
            self._in_flight.clear()
        with suppress(BlockingIOError):
            if not (answer := self._connection.recv(65_536)):
                raise ConnectionError("closed")
            self.answers = (self.answers + answer)[-65_536:]
