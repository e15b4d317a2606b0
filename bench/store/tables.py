"""Tables of the bench's database.

A change of these is a change of `bench.store.database.SCHEMA_VERSION` and needs a migration there.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import DDL, JSON, DateTime, Dialect, Table, UniqueConstraint, event
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

    type_annotation_map = {datetime: UtcTime, dict[str, Any]: JSON}  # noqa: RUF012 - as SQLAlchemy wants it


class SchemaVersionRow(Row):
    """One row for each version that the tables have had; the highest one is theirs now."""

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
    """What was calibrated when there are several of a kind (the club's name), else empty."""
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
