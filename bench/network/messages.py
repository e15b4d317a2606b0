"""Types of the messages that a bench and its campaigns publish.

Those of state and shot: `bench.network.bench_service`, `bench.shot.shot_message`.
"""

from __future__ import annotations

from typing import Annotated, Literal, NotRequired, TypedDict

from bench.lifecycle import Cause, Phase, Reaction, State
from bench.shot.shot import ShotStatus

LOOP_VERSION = 1
"""Version of `LoopMessage`."""
CAMPAIGN_VERSION = 1
"""Version of `CampaignMessage`."""


class ChangeEvent(TypedDict):
    """State, phase, reaction or cause changed."""

    version: int
    event: Literal["change"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    state: Annotated[str, State]
    phase: Annotated[str, Phase]
    reaction: Annotated[str, Reaction]
    cause: Annotated[str, Cause]
    tick: int
    """Number of the tick since the loop's start."""
    loop_time: float
    """Time of the tick on the loop's clock, s."""


class LeaseEvent(TypedDict):
    """The lease lapses soon unless it is renewed, or has ended: lapsed or released."""

    version: int
    event: Literal["lease lapses", "lease ended"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    holder: str
    seconds_left: NotRequired[float]
    """Until it lapses, s."""


class TroubleEvent(TypedDict):
    """The loop met an exception, or ended."""

    version: int
    event: Literal["exception", "loop died"]
    time: float
    """Time of the message on the supervisor's clock (CLOCK_MONOTONIC), s."""
    text: str


class SegmentTiming(TypedDict):
    """Durations of one segment of the ticks, us; None if nothing was counted."""

    count: int
    p50_us: float | None
    p99_us: float | None
    p999_us: float | None
    max_us: float | None


class LoopMessage(TypedDict):
    """Timing of the loop since the message before."""

    version: int
    time: float
    """UTC, s since 1970."""
    seconds: float
    """Time since the message before, s."""
    batches: int
    """Telemetry messages since the publisher's start."""
    lost: int
    """Records that the ring lost for the publisher, since its start."""
    ticks: int
    skipped: int
    """Grid points without a tick."""
    late: int
    """Ticks that began late."""
    page_faults: int
    preemptions: int
    """Of the loop's thread."""
    stalls: dict[str, int]
    """Ticks that were late or followed skipped ones, by why."""
    period_us: float
    segments: dict[str, SegmentTiming]


class BallCount(TypedDict):
    """Shots with one ball; without warm-up."""

    valid: int
    planned: int


class LastShot(TypedDict):
    """The newest shot of a campaign; figures that were not measured are null."""

    shot: int
    block: int
    role: str
    ball: str
    sample: int
    """Number of the physical ball; 0 if balls are not distinguished."""
    club: str
    swing: str
    status: ShotStatus
    reason: str
    """Why the shot is not valid."""
    club_speed_mps: float | None
    attack_angle_deg: float | None
    ball_speed_mps: float | None
    launch_angle_deg: float | None
    spin_rpm: float | None
    carry_m: float | None
    carry_source: str
    time_utc: str
    """ISO 8601."""


class ComingWork(TypedDict):
    """Work by hand that comes next."""

    shots: int
    """Number of shots before it."""
    text: str
    seconds: float | None
    """Time until then, s; None while the pace is not known."""


class CampaignNews(TypedDict):
    """Newest event of a campaign."""

    text: str
    time_utc: str
    """ISO 8601."""


class CampaignMessage(TypedDict):
    """State of a campaign."""

    version: int
    campaign: str
    """Id of the campaign."""
    name: str
    """Name of its plan."""
    state: Literal["running", "waiting", "paused", "suspended", "stopped", "aborted", "finished"]
    reason: str
    """Prompt while it waits, or why it does not run; else empty."""
    shots: int
    """Shots so far, also those that are not valid."""
    valid: int
    done: int
    """Planned shots that are settled."""
    planned: int
    block: int
    """Block of the newest shot, from 1; 0 before the first."""
    blocks: int
    balls: dict[str, BallCount]
    seconds_left: float | None
    """Expected time to the end, s; None while the pace is not known."""
    last_shot: LastShot | None
    next_work: ComingWork | None
    event: CampaignNews | None
