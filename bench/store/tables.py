"""Tables of the bench's database.

A change of these is a change of `bench.store.database.SCHEMA_VERSION`.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import DDL, JSON, DateTime, Dialect, Double, ForeignKey, Table, UniqueConstraint, event, false
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.types import TypeDecorator


class UtcTime(TypeDecorator[datetime]):
    """An instant: UTC in the database, aware in Python. SQLite keeps no zone of its own."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return `value` in UTC; ValueError when it has no zone."""
        if value is not None and value.tzinfo is None:
            raise ValueError(f"a time without a zone: {value!r}")
        return None if value is None else value.astimezone(UTC)

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Return the stored time as an aware one."""
        return None if value is None else value.replace(tzinfo=value.tzinfo or UTC).astimezone(UTC)


class Row(DeclarativeBase):
    """Base of all tables."""

    type_annotation_map = {datetime: UtcTime, dict[str, Any]: JSON, float: Double}  # noqa: RUF012 - as SQLAlchemy wants it


class SchemaVersionRow(Row):
    """The version of the tables, in one row."""

    __tablename__ = "schema_version"

    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    date: Mapped[datetime]


class CalibrationRow(Row):
    """One calibration. Rows are only added: a newer one supersedes, none is changed."""

    __tablename__ = "calibrations"
    __table_args__ = (UniqueConstraint("bench", "kind", "version"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    bench: Mapped[str]
    kind: Mapped[str]
    version: Mapped[int]
    """Rises by one per bench and kind."""
    subject: Mapped[str]
    """Name of the calibrated part if there are several of a kind (the club), else empty."""
    date: Mapped[datetime]
    expires: Mapped[datetime]
    by: Mapped[str]
    method: Mapped[str]
    note: Mapped[str]
    content: Mapped[dict[str, Any]]
    """The values, as `bench.calibration.values` names them."""


def _only_add(table: Table, what: str) -> None:
    """Let the database itself refuse to change or delete rows of `table`."""
    for action in ("UPDATE", "DELETE"):
        trigger = DDL(  # type: ignore[no-untyped-call]
            f"CREATE TRIGGER {table.name}_no_{action.lower()} BEFORE {action} ON {table.name} "
            f"BEGIN SELECT RAISE(ABORT, '{what} are only added'); END"
        ).execute_if(dialect="sqlite")
        event.listen(table, "after_create", trigger)


_only_add(Row.metadata.tables[CalibrationRow.__tablename__], "calibrations")


class CampaignRow(Row):
    """One campaign, with all that it was begun with."""

    __tablename__ = "campaigns"

    id: Mapped[str] = mapped_column(primary_key=True)
    bench: Mapped[str]
    name: Mapped[str]
    title: Mapped[str]
    date: Mapped[datetime]
    simulated: Mapped[bool]
    state: Mapped[str]
    """A `bench.store.campaigns.CampaignState`."""
    reason: Mapped[str]
    """Reason of that state, or empty."""
    requested: Mapped[str]
    """Pending request to its runner: "pause", "stop", "abort" or empty."""
    seed: Mapped[int]
    plan: Mapped[dict[str, Any]]
    digest: Mapped[str]
    """Digest of the plan."""
    configuration: Mapped[dict[str, Any]]
    versions: Mapped[dict[str, Any]]
    real_time: Mapped[dict[str, Any]]
    """Settings as granted; empty in simulation."""
    calibrations: Mapped[dict[str, Any]]
    number: Mapped[int] = mapped_column(server_default="0")
    """Rises by one per campaign: the order in which they were begun, whatever the clock said."""


class ShotRow(Row):
    """One shot; but for the first and the last two its columns are those of the shot table."""

    __tablename__ = "shots"

    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), primary_key=True)
    shot: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    block: Mapped[int]
    position: Mapped[int]
    club: Mapped[str]
    ball: Mapped[str]
    status: Mapped[str]
    reason: Mapped[str]
    club_speed_mps: Mapped[float | None]
    attack_angle_deg: Mapped[float | None]
    club_path_deg: Mapped[float | None]
    face_angle_deg: Mapped[float | None]
    dynamic_loft_deg: Mapped[float | None]
    strike_x_mm: Mapped[float | None]
    strike_y_mm: Mapped[float | None]
    ball_speed_mps: Mapped[float | None]
    launch_angle_deg: Mapped[float | None]
    direction_deg: Mapped[float | None]
    spin_rpm: Mapped[float | None]
    spin_axis_deg: Mapped[float | None]
    carry_m: Mapped[float | None]
    total_m: Mapped[float | None]
    apex_m: Mapped[float | None]
    landing_angle_deg: Mapped[float | None]
    delivery_source: Mapped[str]
    launch_source: Mapped[str]
    carry_source: Mapped[str]
    time_utc: Mapped[datetime]
    carry_side_m: Mapped[float | None]
    swing: Mapped[str]
    role: Mapped[str]
    section: Mapped[int]
    attempt: Mapped[int]
    sample: Mapped[int]
    air_temperature_k: Mapped[float | None]
    air_pressure_pa: Mapped[float | None]
    relative_humidity: Mapped[float | None]
    carry_reference_m: Mapped[float | None]
    carry_monitor_m: Mapped[float | None]
    carry_measured_m: Mapped[float | None]
    carry_measured_error_m: Mapped[float | None]
    flight_source: Mapped[str] = mapped_column(server_default="")
    file: Mapped[str]
    """Record of its cycles below `data_dir`, whole before this row exists; empty: the robot did not swing."""
    bytes: Mapped[int]
    """Size of that file."""
    set_aside: Mapped[bool] = mapped_column(server_default=false())
    """Whether its block was restarted after it: kept, excluded, and not counted as tried."""


class CampaignEventRow(Row):
    """An event of a campaign other than a shot."""

    __tablename__ = "campaign_events"

    id: Mapped[int] = mapped_column(primary_key=True)
    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), index=True)
    date: Mapped[datetime]
    before_shot: Mapped[int]
    kind: Mapped[str]
    text: Mapped[str]


class CampaignRunRow(Row):
    """One run of a campaign: from its begin or a resume until the runner ends."""

    __tablename__ = "campaign_runs"

    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    """From 1."""
    began: Mapped[datetime]
    by: Mapped[str]
    versions: Mapped[dict[str, Any]]
    facts: Mapped[dict[str, Any]]
    """Facts of the running bench, and the digest of the configuration."""


class ShotNoteRow(Row):
    """A person's mark or comment on a shot. Rows are only added."""

    __tablename__ = "shot_notes"

    id: Mapped[int] = mapped_column(primary_key=True)
    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), index=True)
    shot: Mapped[int]
    date: Mapped[datetime]
    by: Mapped[str]
    text: Mapped[str]
    """Empty: a mark without a comment."""


class ShotExclusionRow(Row):
    """A person's exclusion of a shot, or its taking back. Rows are only added; the shot's row stays."""

    __tablename__ = "shot_exclusions"

    id: Mapped[int] = mapped_column(primary_key=True)
    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), index=True)
    shot: Mapped[int]
    date: Mapped[datetime]
    by: Mapped[str]
    reason: Mapped[str]
    excluded: Mapped[bool]
    """Whether it is excluded from then on; else it counts again."""
    after_shot: Mapped[int]
    """Number of the campaign's last shot then."""


class CampaignPromptRow(Row):
    """A prompt to the operator: mount a club, fill the feeder."""

    __tablename__ = "campaign_prompts"

    campaign: Mapped[str] = mapped_column(ForeignKey("campaigns.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    """From 1."""
    before_shot: Mapped[int]
    kind: Mapped[str]
    text: Mapped[str]
    content: Mapped[dict[str, Any]]
    """State of the bench once it is done."""
    asked: Mapped[datetime]
    answered: Mapped[datetime | None]
    by: Mapped[str]
    """Who answered; empty until then."""
    answer: Mapped[int] = mapped_column(server_default="0")
    """Rises by one per answer: the order of answers, whatever the clock said; 0 until then."""


class HitCountRow(Row):
    """Number of uses of a ball, a club, a valve."""

    __tablename__ = "hit_counts"

    scope: Mapped[str] = mapped_column(primary_key=True)
    """Id of the bench; of the campaign when it is simulated, whose balls do not exist elsewhere."""
    kind: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    sample: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    hits: Mapped[int]


class WriterRow(Row):
    """Last write of a program that repeats what it cannot know to be stored."""

    __tablename__ = "writers"

    id: Mapped[str] = mapped_column(primary_key=True)
    """Random."""
    writes: Mapped[int]
    """Number of its last write that is in the database, from 1."""


class LearnedSwingRow(Row):
    """One learned correction of a profile. Rows are only added: the newest that holds is used."""

    __tablename__ = "learned_swings"
    __table_args__ = (UniqueConstraint("bench", "profile", "version"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    bench: Mapped[str]
    profile: Mapped[str]
    version: Mapped[int]
    """Rises by one per bench and profile."""
    date: Mapped[datetime]
    simulated: Mapped[bool]
    source: Mapped[str]
    """Source of the delivery that it was learned from."""
    digest: Mapped[str]
    """Digest of the profile's tables."""
    club: Mapped[str]
    supply_pressure: Mapped[float]
    """Pa absolute, regulated."""
    temperature: Mapped[float]
    """K"""
    within: Mapped[bool]
    """The target was reached."""
    content: Mapped[dict[str, Any]]
    """Weights of the basis functions, and for people target, swings and scatter."""


_only_add(Row.metadata.tables[LearnedSwingRow.__tablename__], "learned swings")


class AirReadingRow(Row):
    """One reading of the air at a bench. Rows are only added."""

    __tablename__ = "air_readings"

    id: Mapped[int] = mapped_column(primary_key=True)
    bench: Mapped[str] = mapped_column(index=True)
    date: Mapped[datetime]
    temperature: Mapped[float]
    """K"""
    pressure: Mapped[float]
    """Pa"""
    relative_humidity: Mapped[float]
    by: Mapped[str]


_only_add(Row.metadata.tables[AirReadingRow.__tablename__], "readings of the air")


class BallAerodynamicsRow(Row):
    """Aerodynamic coefficients measured on one ball model. Rows are only added: the newest is used."""

    __tablename__ = "ball_aerodynamics"
    __table_args__ = (UniqueConstraint("bench", "ball", "version"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    bench: Mapped[str]
    ball: Mapped[str]
    version: Mapped[int]
    """Rises by one per bench and ball."""
    date: Mapped[datetime]
    """Time of the measurement."""
    source: Mapped[str]
    """Device and place that the flight data come from."""
    by: Mapped[str]
    content: Mapped[dict[str, Any]]
    """The values, as `bench.calibration.ball_aerodynamics` names them."""


_only_add(Row.metadata.tables[BallAerodynamicsRow.__tablename__], "aerodynamics of balls")
