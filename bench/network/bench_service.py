"""The service that the command plane needs from a running bench: requests and their answers.

The supervisor implements it; tests have their own. `golfbench status --json` prints a `BenchStatus`, and
`golfbench/<id>/state` carries one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, TypedDict

from bench.lifecycle import Request

STATUS_VERSION = 1
"""Version of Status."""


class Reply(NamedTuple):
    """The bench's answer to a request."""

    accepted: bool
    state: str
    """Name of the `State` after the answer."""
    reason: str
    """Why it was refused, with the cure; empty when accepted."""


class CauseStatus(TypedDict):
    """Why the bench stopped."""

    name: str
    """Of the `Cause`."""
    text: str


class LeaseStatus(TypedDict):
    """Who holds the bench. Never with the key."""

    holder: str
    seconds_left: float


class ProcessStatus(TypedDict):
    """One process of the bench."""

    pid: int
    alive: bool
    note: str
    """What is to be said of it, for example why it ended."""


class LoopStatus(TypedDict):
    """How the loop keeps time."""

    rate_hz: float
    """Measured."""
    skipped: int
    late: int
    wake_p50_s: float
    wake_p99_s: float
    tick_p99_s: float


class CountStatus(TypedDict):
    """What became of the messages that came to the command plane since its start."""

    commands: int
    """Answered with accepted."""
    refused: int
    """Well formed, answered with refused; also for want of time ("busy")."""
    malformed: int
    """Answered with an error."""
    dropped: int
    """Not answered: the queue was full, or the bench was going down."""


class MonitorStatus(TypedDict):
    """A launch monitor that is connected."""

    address: str
    device: str
    """As it calls itself; empty before its first message."""
    silent_s: float
    """Since its last byte."""
    ready: bool | None
    ball_detected: bool | None


class SimulatorStatus(TypedDict):
    """How passing shots on to GSPro goes."""

    connected: bool
    trouble: str
    taken: int
    refused: int
    """Refused, not answered or out of date."""


class LaunchMonitorStatus(TypedDict):
    """The launch monitor's side of the bench."""

    listening: str
    """ADDRESS:PORT where a monitor may connect; empty when it cannot listen."""
    present: bool
    """A monitor is connected, so swings may count on it."""
    monitors: list[MonitorStatus]
    note: str
    """What is to be said of it; empty when all is well."""
    outcomes: dict[str, int]
    """How many swings and launches came to which `drivers.launch_monitor.matching.MatchOutcome`."""
    settled_s: float
    """After the impact: by then a swing's outcome is settled."""
    refused: int
    """Objects of the monitors that were no messages, not whole or too long."""
    simulator: SimulatorStatus | None
    """None: shots are not passed on."""


class DeviceStatus(TypedDict):
    """The robot's side of the driver."""

    trouble: str
    """Why it obeys no command; empty while it does."""
    counters: dict[str, int]
    """What its driver has counted since its start, of frames and of what went wrong; empty: nothing."""


class BenchStatus(TypedDict):
    """A snapshot of the bench, JSON-able: no NaN, None where a value is not there."""

    version: int
    bench: str
    """Its id."""
    state: str
    phase: str
    reaction: str
    cause: CauseStatus | None
    homed: bool
    vented: bool
    tick: int
    time: float
    """s, the loop's."""
    swings: int
    lease: LeaseStatus | None
    """Filled in by the command plane."""
    read_only: bool
    driver: str
    profile: str
    correction: int
    """Number of the learned correction that swings are made with, counted from the start; 0: none."""
    club: str
    """That the bench was started with."""
    joints_deg: list[float | None]
    """Three, in the order of `drivers.base.JOINTS`."""
    supply_pressure_pa: float | None
    chamber_pressure_pa: list[float | None]
    """Six, in the order of `drivers.base.CHAMBERS`, Pa absolute."""
    emergency_stop_clear: bool
    guard_closed: bool
    guard_locked: bool
    ball_present: bool
    """A ball lies on the tee."""
    support_ready: bool
    """Recorder and publisher are running."""
    launch_monitor: LaunchMonitorStatus | None
    """None: the bench has none."""
    processes: dict[str, ProcessStatus]
    device: DeviceStatus
    loop: LoopStatus
    real_time: dict[str, Any]
    """What was asked of the machine and what it granted."""
    counts: CountStatus
    """Filled in by the command plane."""
    last_stop: dict[str, Any] | None
    """The stop before this start, or the newest one: cause, time."""
    uptime: float
    """s since the supervisor's start."""


class BenchService(Protocol):
    """A running bench.

    The command plane calls it from threads of its own: `request` one at a time, the others at any moment,
    also while `request` waits.
    """

    def status(self) -> BenchStatus:
        """Return the snapshot; `lease` and `counts` are overwritten by the command plane."""

    def request(self, request: Request) -> Reply:
        """Put `request` to the loop and wait, 0.2 s at most, for its answer."""

    def correct(self, profile: str, weights: Sequence[float]) -> Reply:
        """Swing with the correction `weights` of the profile with the digest `profile` from now on.

        Without weights: as designed. Refused while the robot does not rest.
        """

    def stop(self) -> Reply:
        """Stop as the stopping table says; never waits behind a request."""

    def emergency_stop(self) -> Reply:
        """Stop as for an open emergency stop circuit; never waits behind a request."""
