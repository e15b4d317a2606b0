"""Tables of the bench's database.

A change of these is a change of `bench.store.database.SCHEMA_VERSION`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from types import UnionType
from typing import Any, get_args, get_type_hints

from sqlalchemy import (
    DDL,
    JSON,
    Boolean,
    Column,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    Integer,
    String,
    Table,
    UniqueConstraint,
    event,
    false,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.types import TypeDecorator

from bench.shot.shot import Shot
from bench.store.records import (
    CampaignEntry,
    CampaignRun,
    Event,
    Hit,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
)


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
    """The values, as `bench.calibration.calibration` names them."""


def _only_add(table: Table, what: str) -> None:
    """Let the database itself refuse to change or delete rows of `table`."""
    for action in ("UPDATE", "DELETE"):
        trigger = DDL(  # type: ignore[no-untyped-call]
            f"CREATE TRIGGER {table.name}_no_{action.lower()} BEFORE {action} ON {table.name} "
            f"BEGIN SELECT RAISE(ABORT, '{what} are only added'); END"
        ).execute_if(dialect="sqlite")
        event.listen(table, "after_create", trigger)


_only_add(Row.metadata.tables[CalibrationRow.__tablename__], "calibrations")


_TYPES = {int: Integer, float: Double, bool: Boolean, datetime: UtcTime, Mapping[str, Any]: JSON}
"""Type of a column by that of its field; of others, texts and codes, String."""


def _columns(record: type, *key: str) -> Iterator[Column[Any]]:
    """Yield a column for each field of `record`; those in `key` identify a row."""
    for name, hint in get_type_hints(record).items():
        optional = isinstance(hint, UnionType)
        kind = _TYPES.get(get_args(hint)[0] if optional else hint, String)
        yield Column(name, kind, primary_key=name in key, autoincrement=False, nullable=optional)


def _of_campaign(name: str, record: type, *key: str, more: Iterable[Column[Any]] = ()) -> Table:
    """Return a table of `record`s of campaigns, by the fields in `key`; without any by a number."""
    number = [] if key else [Column("id", Integer, primary_key=True)]
    campaign: Column[str] = Column(
        "campaign", ForeignKey("campaigns.id"), primary_key=bool(key), index=not key
    )
    return Table(name, Row.metadata, *number, campaign, *_columns(record, *key), *more)


CAMPAIGNS = Table(
    "campaigns",
    Row.metadata,
    *_columns(CampaignEntry, "id"),
    *_columns(Standing),
    Column("number", Integer, nullable=False),
)
"""The number rises by one per campaign: the order in which they were begun, whatever the clock said."""

SHOTS = _of_campaign(
    "shots",
    Shot,
    "shot",
    more=(
        Column("file", String, nullable=False),
        Column("bytes", Integer, nullable=False),
        Column("set_aside", Boolean, nullable=False, server_default=false()),
    ),
)
"""With the record of a shot's cycles below `data_dir`, whole before its row exists, and its size; empty: the
robot did not swing. Set aside: its block was restarted after it; it is kept and excluded."""

EVENTS = _of_campaign("campaign_events", Event)
RUNS = _of_campaign("campaign_runs", CampaignRun, "number")
NOTES = _of_campaign("shot_notes", ShotNote)
"""Rows are only added."""
EXCLUSIONS = _of_campaign("shot_exclusions", ShotExclusion)
"""Rows are only added; the shot's row stays."""
PROMPTS = _of_campaign(
    "campaign_prompts", Prompt, "number", more=[Column("answer", Integer, nullable=False, server_default="0")]
)
"""The answer's number rises by one per answer: their order, whatever the clock said; 0 until then."""

HITS = Table(
    "hit_counts",
    Row.metadata,
    Column("scope", String, primary_key=True),
    *_columns(Hit, *Hit._fields),
    Column("hits", Integer, nullable=False),
)
"""Number of uses of a ball, a club, a valve, in the `CampaignEntry.hit_scope`."""

WRITERS = Table(
    "writers", Row.metadata, Column("id", String, primary_key=True), Column("writes", Integer, nullable=False)
)
"""Number of the last write, from 1, that is in the database, of each program that repeats what it cannot know
to be stored."""


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
