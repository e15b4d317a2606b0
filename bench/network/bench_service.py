"""The service that the command plane needs from a running bench: requests and their answers.

The supervisor implements it; tests have their own. `golfbench status --json` prints a `BenchStatus`, and
`golfbench/<id>/state` carries one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, NotRequired, Protocol, TypedDict

from bench.base.lifecycle import REFUSAL_WORDS, Block, Cause, Phase, Reaction, Refusal, Request, State
from drivers.base.ranges import Count

STATUS_VERSION = 1


BAR_HOMING = frozenset({Block.INPUTS, Block.UNREADABLE})
"""Reasons that also block homing."""


class ArmingBlock(TypedDict):
    """A reason that blocks arming, in the parts of an error message."""

    code: Block
    location: str
    found: str
    expected: str
    action: str


class CommandAnswer(NamedTuple):
    """The bench's answer to a valid command."""

    accepted: bool
    state: Annotated[str, State]
    """State after the answer."""
    refusal: Annotated[str, Refusal] = Refusal.NONE.name
    """Code of the refusal."""
    cause: Annotated[str, Cause] = Cause.NONE.name
    """Cause of the previous stop or disarming."""
    reason: str = ""
    """Reason of the refusal, human-readable; empty when accepted."""
    action: str = ""
    """Action after the refusal, human-readable."""
    note: str = ""
    """Further information for the operator."""
    content: Mapping[str, Any] = {}
    """`status` of status; `holder`, `seconds_left` and, for who took it, `key` of lease; the reasons that
    block arming of `arm`."""


def refused(state: str, refusal: Refusal, fact: str = "", action: str = "") -> CommandAnswer:
    """Return the refusal of a request, in its own words where `fact` or `action` say no more."""
    words = REFUSAL_WORDS[refusal]
    return CommandAnswer(False, state, refusal.name, reason=fact or words[0], action=action or words[1])


class CauseStatus(TypedDict):
    """Why the bench stopped."""

    name: Annotated[str, Cause]
    text: str
    """Text for people, without the action."""
    action: str
    """Action for people; empty without a known one."""


class LeaseStatus(TypedDict):
    """The lease, never with its key."""

    holder: str
    seconds_left: float
    lapsing: bool
    """Whether the lease expires soon unless renewed; an armed bench then disarms."""


class ProcessStatus(TypedDict):
    """One process of the bench."""

    pid: int
    alive: bool
    note: str
    """Remark, for example why it ended."""


class LoopStatus(TypedDict):
    """Timing of the loop."""

    rate_hz: float
    """Measured."""
    skipped: int
    late: int
    page_faults: int
    preemptions: int
    """Preemptions of the loop's thread since it became ready."""
    stalls: dict[str, int]
    """Ticks that were late or followed skipped ones, by why: `preemption`, `page_fault`, `long_tick` (the
    bench's own work), or `machine` (stolen time, interrupts)."""
    wake_p50_s: float
    wake_p99_s: float
    tick_p99_s: float


class CountStatus(TypedDict):
    """Messages to the command plane since its start, by outcome."""

    commands: int
    """Messages answered with `accepted`."""
    refused: int
    """Well formed, answered with refused; also if the bench is busy."""
    malformed: int
    """Answered with an error."""
    dropped: int
    """Not answered: the queue was full, or the bench was shutting down."""


class MonitorStatus(TypedDict):
    """A launch monitor that is connected."""

    address: str
    device: str
    """Name it gives itself; empty before its first message."""
    silent_s: float
    """Time since its last byte, s."""
    ready: bool | None
    ball_detected: bool | None


class SimulatorStatus(TypedDict):
    """State of the forwarding of shots to GSPro."""

    connected: bool
    fault: str
    taken: int
    refused: int
    """Refused, not answered or out of date."""


class LaunchMonitorStatus(TypedDict):
    """The launch monitor's side of the bench."""

    listening: str
    """ADDRESS:PORT where a monitor may connect; empty if it cannot listen."""
    presence: Literal["connected", "per_shot"]
    """When a monitor is present: `[launch_monitor] presence`."""
    present: bool
    """Whether a monitor is connected, or answers for the balls that are struck."""
    seen_s: float | None
    """Time since the last message that was not refused, s; None before the first."""
    monitors: list[MonitorStatus]
    note: str
    """Remark; empty if all is well."""
    outcomes: dict[str, int]
    """Number of swings and launches by `drivers.launch_monitor.record.MatchOutcome`."""
    settled_s: float
    """Time after the impact at which a swing's outcome is settled, s."""
    refused: int
    """Number of refused connections, and of invalid, incomplete or too long objects."""
    refusal: str
    """Newest reason of a refusal; empty without one."""
    simulator: SimulatorStatus | None
    """None if shots are not forwarded."""


class DeviceStatus(TypedDict):
    """The robot's side of the driver."""

    fault: str
    """Why it does not execute commands; empty while it does."""
    counters: dict[str, int]
    """Counters of its driver since its start, of frames and errors."""


class SettingStatus(TypedDict):
    """A real-time setting, requested and granted."""

    name: str
    asked: str
    granted: str
    """Value read back."""
    held: bool
    """Whether the requested value is in force."""
    reason: NotRequired[str]
    """Why it is not in force."""
    action: NotRequired[str]
    """Action to get it granted."""
    required: NotRequired[bool]
    """Whether mode `require` needs the setting; other settings only reduce jitter."""


class RealTimeStatus(TypedDict):
    """Real-time settings of the loop."""

    mode: str
    """require, prefer or off."""
    held: bool
    """Whether all required settings are in force."""
    settings: dict[str, SettingStatus]


class StopStatus(TypedDict):
    """A stop of this run or of one before."""

    cause: str
    text: NotRequired[str]
    state: NotRequired[str]
    """State in which the stop occurred."""
    phase: NotRequired[str]
    time_utc: NotRequired[str]
    """Time of the stop, ISO 8601; missing if only the start of its run is known."""
    run_started_utc: NotRequired[str | None]


class WearFinding(TypedDict):
    """A finding of `golfbench wear`; open until a later analysis no longer has it."""

    part: str
    """Worn part and value, or joint and comparison whose residual nears its limit."""
    text: str
    """Finding and action, for people."""
    time_utc: str
    """Time of the newest swing analysed, ISO 8601."""


class BenchStatus(TypedDict):
    """A snapshot of the bench, valid as JSON: no NaN, None for missing values."""

    version: int
    bench: str
    """Id of the bench."""
    state: Annotated[str, State]
    phase: Annotated[str, Phase]
    reaction: Annotated[str, Reaction]
    cause: CauseStatus | None
    """First cause of a stop, or cause of disarming since the last motion."""
    latest_cause: CauseStatus | None
    """Newest cause found after it; None without one."""
    homed: bool
    vented: bool
    tick: int
    time: float
    """Time of the loop, s."""
    swings: int
    lease: LeaseStatus | None
    """Filled in by the command plane."""
    read_only: bool
    driver: str
    profile: str
    correction: int
    """Number of the learned correction that swings are made with, counted from the start; 0: none."""
    club: str
    """Club that the bench was started with."""
    arming_blocks: list[ArmingBlock]
    """Reasons that block arming, as of the start or the latest request to arm."""
    readiness_warnings: list[str]
    """Properties of configuration, calibrations and profile that do not block arming."""
    series: bool
    """Whether the robot holds the address between swings; otherwise it vents."""
    joints_deg: Annotated[list[float | None], Count(3)]
    """Three, in the order of `drivers.base.JOINTS`."""
    supply_pressure_pa: float | None
    chamber_pressure_pa: Annotated[list[float | None], Count(6)]
    """Six, in the order of `drivers.base.CHAMBERS`, Pa absolute."""
    spool_positions: Annotated[list[float | None], Count(3)]
    """Measured positions of the valves' spools, -1 to 1; None without feedback."""
    air_faults: list[str]
    """Texts of the pressure sensors, vents, manifold and guard's lock that fail."""
    drift: list[str]
    """Warnings of the latest swing's record: speed or strike has drifted from that of the first swings."""
    wear: list[WearFinding]
    """Findings of the latest `golfbench wear`."""
    vents_open: Annotated[list[bool | None], Count(2)]
    """Position of each of the two vents; None without feedback."""
    shut_off_open: bool | None
    """Position of the shut-off valve; None without feedback."""
    emergency_stop_clear: bool
    guard_closed: bool
    guard_locked: bool
    ball_present: bool
    """A ball lies on the tee."""
    support_ready: bool
    """Recorder and publisher are running."""
    launch_monitor: LaunchMonitorStatus | None
    """None without a launch monitor."""
    processes: dict[str, ProcessStatus]
    device: DeviceStatus
    loop: LoopStatus
    real_time: RealTimeStatus
    counts: CountStatus
    """Filled in by the command plane."""
    last_stop: StopStatus | None
    """The stop before this start, or the newest one."""
    uptime: float
    """Time since the supervisor's start, s."""


class BenchService(Protocol):
    """A running bench.

    The command plane calls it from separate threads: `request` one at a time, the others at any moment,
    also while `request` waits.
    """

    def status(self) -> BenchStatus:
        """Return the snapshot; `lease` and `counts` are overwritten by the command plane."""

    def request(self, request: Request, is_late: Callable[[], bool]) -> CommandAnswer:
        """Put `request` to the loop and wait, 0.2 s at most, for its answer; the cause is added.

        Refused if it `is_late` once it is ready for the loop.
        """

    def correct(self, profile: str, weights: Sequence[float]) -> CommandAnswer:
        """Swing with the correction `weights` of the profile with the digest `profile` from now on.

        Without weights: as designed. Refused unless the robot is at rest.
        """

    def stop(self, request: Request) -> CommandAnswer:
        """Stop as the stopping table says, or with EMERGENCY_STOP as for an open emergency stop circuit.

        Never waits behind a request.
        """
