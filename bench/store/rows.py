"""Rows of the campaigns' tables; each class names the columns of its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.base.errors import Refused

if TYPE_CHECKING:
    from sim.ball import Air


class CampaignState(StrEnum):
    """State of a campaign."""

    RUNNING = "running"
    """Stored until its runner ends it; `bench.campaign.run.campaign_control.standing_now` finds a dead
    one."""
    WAITING = "waiting"
    PAUSED = "paused"
    SUSPENDED = "suspended"
    """Suspended by its runner, for a reason that a person must clear."""
    STOPPED = "stopped"
    """Stopped by a person after a complete shot; it can be resumed."""
    ABORTED = "aborted"
    """Aborted by a person at once; it cannot be resumed."""
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    """Derived, never stored: the runner died without closing the campaign."""


def state_text(state: str, reason: str) -> str:
    """Return `state` with its reason, which stands alone if it begins with the state."""
    return reason if reason.startswith(state) else f"{state}: {reason}" if reason else state


def amendment(campaign: str) -> str:
    """Return the command that issues the report of `campaign` again."""
    return f"golfbench campaign report {campaign} --issue --reason TEXT"


ENDED = frozenset({CampaignState.ABORTED, CampaignState.FINISHED})


@dataclass(frozen=True)
class CampaignEntry:
    """A campaign with all inputs it was started with."""

    id: str
    bench: str
    name: str
    title: str
    date: datetime
    simulated: bool
    seed: int
    plan: Mapping[str, Any]
    digest: str
    configuration: Mapping[str, Any]
    versions: Mapping[str, Any]
    real_time: Mapping[str, Any]
    calibrations: Mapping[str, Any]
    golfers: Mapping[str, Any] = field(default_factory=dict)
    """Measured swings that its profiles follow, by "swing, club"."""

    @property
    def hit_scope(self) -> str:
        """Scope of its hit counts: the campaign if simulated, else the bench."""
        return self.id if self.simulated else self.bench


class Standing(NamedTuple):
    """State of a campaign, with its reason and pending request."""

    state: CampaignState
    reason: str
    requested: str
    requested_by: str = ""


class Event(NamedTuple):
    """An event before a shot."""

    date: datetime
    before_shot: int
    kind: str
    text: str


class CampaignRun(NamedTuple):
    """One run of a campaign: from its start or resumption until the runner ends."""

    number: int
    """Number within its campaign, from 1."""
    began: datetime
    by: str = ""
    versions: Mapping[str, Any] = {}
    facts: Mapping[str, Any] = {}
    """Facts of the running bench, and the digest of the configuration."""


MAX_COMMENT_LENGTH = 200
"""Max length of a comment, characters."""


class ShotNote(NamedTuple):
    """A person's mark or comment on a shot."""

    shot: int
    date: datetime
    by: str
    text: str
    """Empty: a mark without a comment."""


class ShotExclusion(NamedTuple):
    """A person's exclusion of a shot, or its withdrawal."""

    shot: int
    date: datetime
    by: str
    reason: str
    excluded: bool
    """Whether it is excluded from then on; else it counts again."""
    after_shot: int
    """Number of the campaign's last shot then."""


class PromptKind(StrEnum):
    """Kind of a prompt."""

    CLUB = "club"
    BALLS = "balls"
    BENCH = "bench"
    """Restart of the bench, never automatic in simulation."""


Numbered = tuple[str, int]
"""A ball: its model and the number on it."""


def places(balls: Sequence[Numbered]) -> list[str]:
    """Return the places of the magazine with their balls, in the order of hitting."""
    return [f"{location}. {name} {number}" for location, (name, number) in enumerate(balls, 1)]


class Prompt(NamedTuple):
    """A prompt to the operator before a shot."""

    number: int
    """Number within its campaign, from 1."""
    before_shot: int
    kind: str
    text: str
    content: Mapping[str, Any]
    """State of the bench after the prompted work."""
    asked: datetime
    answered: datetime | None = None
    by: str = ""
    """Who answered."""

    @property
    def balls(self) -> list[Numbered]:
        """Load list; empty if it asks for something else."""
        return [(str(name), int(number)) for name, number in self.content.get("balls", ())]

    def require_count(self, count: int) -> None:
        """Refuse a number of loaded balls that is not that of the load list.

        Raises:
            Refused: too few or too many, or it asks for no balls.
        """
        balls, location, found = self.balls, f"before shot {self.before_shot}", f"{count} balls loaded"
        if not balls:
            expected = f"no number, as the prompt reads: {self.text}"
            raise Refused(location, found, expected, "Answer without a number of balls.")
        action = "Empty the feeder and load it by the list; then answer again."
        if count < len(balls):
            first = places(balls)[count]
            action = f"Load the rest from {first} on, if the others are by the list; then answer again."
        if count != len(balls):
            raise Refused(location, found, f"{len(balls)}, as listed", action)


class CalibrationRow(NamedTuple):
    """A calibration; a newer one supersedes it."""

    bench: str
    kind: str
    version: int
    subject: str
    """Name of the calibrated part if there are several of a kind (the club), else empty."""
    date: datetime
    expires: datetime
    by: str
    method: str
    note: str
    content: Mapping[str, Any]
    """The values, as `bench.calibration.calibration` names them."""


class LearnedSwingRow(NamedTuple):
    """A learned correction of a profile; the newest valid one is used."""

    bench: str
    profile: str
    version: int
    date: datetime
    simulated: bool
    source: str
    """Source of the delivery that it was learned from."""
    digest: str
    """Digest of the profile's tables."""
    club: str
    supply_pressure: float
    """Regulated pressure (Pa absolute)."""
    temperature: float
    """Air temperature (K)."""
    within: bool
    """The target was reached."""
    content: Mapping[str, Any]
    """Weights of the basis functions, and for people target, swings and scatter."""


class BallAerodynamicsRow(NamedTuple):
    """Aerodynamic coefficients measured on one ball model; the newest are used."""

    bench: str
    ball: str
    version: int
    date: datetime
    """Time of the measurement."""
    source: str
    """Device and place that the flight data come from."""
    by: str
    content: Mapping[str, Any]
    """The values, as `bench.calibration.ball_aerodynamics` names them."""


class AirReading(NamedTuple):
    """A reading of the air at a bench; the newest is used for a limited time."""

    bench: str
    date: datetime
    temperature: float
    """Temperature (K)."""
    pressure: float
    """Ambient pressure (Pa)."""
    relative_humidity: float
    by: str
    """Person or instrument that read it."""

    @property
    def air(self) -> Air:
        """The air that was read."""
        from sim.ball import Air  # most commands of a campaign do without the plant

        return Air(self.temperature, self.pressure, self.relative_humidity)


class Hit(NamedTuple):
    """A part that wears: a ball's sample, a club, a valve."""

    kind: str
    name: str
    sample: int = 0
