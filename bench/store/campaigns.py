"""Campaigns in the database: begun once, shots added in batches, each batch whole or not at all.

A shot's file is whole on disk before its row is written; rows, events and hit counts of a batch are one
transaction. What a crash leaves is therefore at worst a file that no row knows, which the same shot replaces.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, NamedTuple

from sqlalchemy import Connection, Engine, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from bench.errors import BenchError, Refused
from bench.shot.shot import COLUMNS, Shot, ShotStatus
from bench.store.tables import CampaignEventRow, CampaignPromptRow, CampaignRow, HitCountRow, Row, ShotRow

_CAMPAIGNS, _SHOTS, _EVENTS, _PROMPTS, _HITS = (
    Row.metadata.tables[row.__tablename__]
    for row in (CampaignRow, ShotRow, CampaignEventRow, CampaignPromptRow, HitCountRow)
)


class CampaignState(StrEnum):
    """State of a campaign."""

    RUNNING = "running"
    """Or its runner died: `campaign resume` finds out."""
    WAITING = "waiting"
    """Waiting for the answer to a prompt; or its runner died meanwhile."""
    PAUSED = "paused"
    SUSPENDED = "suspended"
    """Suspended by its runner, for a reason that a person must clear."""
    STOPPED = "stopped"
    """Stopped by a person after a complete shot; it can be resumed."""
    ABORTED = "aborted"
    """Aborted by a person at once; it cannot be resumed."""
    FINISHED = "finished"


ENDED = frozenset({CampaignState.ABORTED, CampaignState.FINISHED})
"""Final states."""


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

    @property
    def hit_scope(self) -> str:
        """Scope of its hit counts: the campaign if simulated, else the bench."""
        return self.id if self.simulated else self.bench


class Standing(NamedTuple):
    """State of a campaign, with its reason and pending request."""

    state: CampaignState
    reason: str
    requested: str


class StoredShot(NamedTuple):
    """A shot and the file of its cycles, whole already; "" when the robot did not swing."""

    shot: Shot
    file: str = ""
    bytes: int = 0


class Event(NamedTuple):
    """An event before a shot."""

    date: datetime
    before_shot: int
    kind: str
    text: str


class Prompt(NamedTuple):
    """A prompt to the operator before a shot."""

    number: int
    """From 1, within its campaign."""
    before_shot: int
    kind: str
    text: str
    content: Mapping[str, Any]
    """State of the bench once it is done."""
    asked: datetime
    answered: datetime | None = None
    by: str = ""
    """Who answered."""


class Hit(NamedTuple):
    """A part that wears: a ball's sample, a club, a valve."""

    kind: str
    name: str
    sample: int = 0


class CampaignStore:
    """The campaigns in one open database."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    @property
    def database(self) -> Engine:
        """The database, for its other contents."""
        return self._engine

    def begin(self, entry: CampaignEntry) -> None:
        """Add a campaign.

        Raises:
            Refused: the id exists already.
        """
        values = asdict(entry) | {
            "state": CampaignState.RUNNING,
            "reason": "",
            "requested": "",
        }
        try:
            with self._writing() as connection:
                connection.execute(insert(_CAMPAIGNS).values(values))
        except IntegrityError:
            raise Refused(
                f"campaign {entry.id}", "the id exists already", "a new id", "Start it again in a second."
            ) from None

    def entry(self, campaign: str) -> CampaignEntry:
        """Return a campaign's entry.

        Raises:
            BenchError: there is no such campaign.
        """
        names = CampaignEntry.__dataclass_fields__
        with self._engine.connect() as connection:
            query = select(*(_CAMPAIGNS.c[name] for name in names)).where(_CAMPAIGNS.c.id == campaign)
            found = connection.execute(query).mappings().first()
        if found is None:
            raise BenchError(
                f"campaign {campaign}", "no such campaign", "the id of one", "`golfbench campaign list`"
            )
        return CampaignEntry(**found)

    def entries(self) -> list[tuple[CampaignEntry, Standing, Counter[str]]]:
        """Return all campaigns, the newest first, with their states and shots by status."""
        names = CampaignEntry.__dataclass_fields__
        with self._engine.connect() as connection:
            rows = connection.execute(select(_CAMPAIGNS).order_by(_CAMPAIGNS.c.date.desc())).mappings().all()
            counts: dict[str, Counter[str]] = {}
            grouped = select(_SHOTS.c.campaign, _SHOTS.c.status, func.count()).group_by(
                _SHOTS.c.campaign, _SHOTS.c.status
            )
            for campaign, status, number in connection.execute(grouped):
                counts.setdefault(campaign, Counter())[status] = number
        return [
            (
                CampaignEntry(**{name: row[name] for name in names}),
                Standing(CampaignState(row["state"]), row["reason"], row["requested"]),
                counts.get(row["id"], Counter()),
            )
            for row in rows
        ]

    def standing(self, campaign: str) -> Standing:
        """Return the state of a campaign."""
        c = _CAMPAIGNS.c
        with self._engine.connect() as connection:
            row = connection.execute(select(c.state, c.reason, c.requested).where(c.id == campaign)).one()
        return Standing(CampaignState(row[0]), *row[1:])

    def change(self, campaign: str, **values: Any) -> None:
        """Set columns `state`, `reason` or `requested`."""
        with self._writing() as connection:
            connection.execute(update(_CAMPAIGNS).where(_CAMPAIGNS.c.id == campaign).values(**values))

    def shots(self, campaign: str) -> list[StoredShot]:
        """Return its shots in order."""
        query = select(_SHOTS).where(_SHOTS.c.campaign == campaign).order_by(_SHOTS.c.shot)
        names = [column.name for column in COLUMNS]
        with self._engine.connect() as connection:
            return [
                StoredShot(
                    Shot(**{name: row[name] for name in names} | {"status": ShotStatus(row["status"])}),
                    row["file"],
                    row["bytes"],
                )
                for row in connection.execute(query).mappings()
            ]

    def events(self, campaign: str) -> list[Event]:
        """Return its events in order."""
        c = _EVENTS.c
        query = (
            select(c.date, c.before_shot, c.kind, c.text)
            .where(c.campaign == campaign)
            .order_by(c.before_shot, c.id)
        )
        with self._engine.connect() as connection:
            return [Event(*row) for row in connection.execute(query)]

    def prompts(self, campaign: str) -> list[Prompt]:
        """Return its prompts in order; at most the last one is not answered."""
        c = _PROMPTS.c
        query = select(*(c[name] for name in Prompt._fields)).where(c.campaign == campaign).order_by(c.number)
        with self._engine.connect() as connection:
            return [Prompt(*row) for row in connection.execute(query)]

    def prompt(self, campaign: str, number: int) -> Prompt:
        """Return one of its prompts."""
        c = _PROMPTS.c
        query = select(*(c[name] for name in Prompt._fields))
        with self._engine.connect() as connection:
            return Prompt(
                *connection.execute(query.where((c.campaign == campaign) & (c.number == number))).one()
            )

    def ask(self, campaign: str, prompt: Prompt) -> None:
        """Add a prompt."""
        with self._writing() as connection:
            connection.execute(insert(_PROMPTS).values(campaign=campaign, **prompt._asdict()))

    def answer(self, campaign: str, number: int, by: str, date: datetime) -> bool:
        """Mark prompt `number` as done; return whether it was open."""
        c = _PROMPTS.c
        mine = (c.campaign == campaign) & (c.number == number) & c.answered.is_(None)
        with self._writing() as connection:
            done = connection.execute(update(_PROMPTS).where(mine).values(answered=date, by=by))
        return bool(done.rowcount)

    def last_answered(self, entry: CampaignEntry, kind: str) -> tuple[str, Prompt] | None:
        """Return the bench's newest answered prompt of `kind`, with its campaign; None if there is none.

        A simulated campaign has a bench of its own, a real bench has one for all its campaigns.
        """
        c, of = _PROMPTS.c, _CAMPAIGNS.c
        scope = c.campaign == entry.id if entry.simulated else (of.bench == entry.bench) & ~of.simulated
        query = (
            select(c.campaign, *(c[name] for name in Prompt._fields))
            .join(_CAMPAIGNS, of.id == c.campaign)
            .where(scope & (c.kind == kind) & c.answered.is_not(None))
            .order_by(c.answered.desc(), c.number.desc())
            .limit(1)
        )
        with self._engine.connect() as connection:
            row = connection.execute(query).first()
        return None if row is None else (row[0], Prompt(*row[1:]))

    def hits(self, scope: str) -> Counter[Hit]:
        """Return the number of uses of each part."""
        c = _HITS.c
        with self._engine.connect() as connection:
            rows = connection.execute(select(c.kind, c.name, c.sample, c.hits).where(c.scope == scope))
            return Counter({Hit(kind, name, sample): hits for kind, name, sample, hits in rows})

    def add(
        self,
        entry: CampaignEntry,
        shots: Sequence[StoredShot],
        events: Iterable[Event] = (),
        hits: Mapping[Hit, int] | None = None,
        prompts: Iterable[Prompt] = (),
    ) -> None:
        """Add a batch in one transaction; the shots' files are whole already.

        Raises:
            Refused: one of these shots is there already: another runner has this campaign.
        """
        names = [column.name for column in COLUMNS]
        rows = [
            {"campaign": entry.id, "file": stored.file, "bytes": stored.bytes}
            | {name: getattr(stored.shot, name) for name in names}
            for stored in shots
        ]
        found = [{"campaign": entry.id, **event._asdict()} for event in events]
        asked = [{"campaign": entry.id, **prompt._asdict()} for prompt in prompts]
        try:
            with self._writing() as connection:
                if rows:
                    connection.execute(insert(_SHOTS), rows)
                if found:
                    connection.execute(insert(_EVENTS), found)
                if asked:
                    connection.execute(insert(_PROMPTS), asked)
                for hit, number in (hits or {}).items():
                    _count(connection, entry.hit_scope, hit, number)
        except IntegrityError:
            raise Refused(
                f"campaign {entry.id}",
                f"shot {shots[0].shot.shot} there already",
                "one runner a campaign",
                "Stop the other runner.",
            ) from None

    def _writing(self) -> Any:
        """Return a transaction that takes the write lock at once."""
        return self._engine.execution_options(sqlite_begin="IMMEDIATE").begin()


def _count(connection: Connection, scope: str, hit: Hit, number: int) -> None:
    c = _HITS.c
    mine = (c.scope == scope) & (c.kind == hit.kind) & (c.name == hit.name) & (c.sample == hit.sample)
    if not connection.execute(update(_HITS).where(mine).values(hits=c.hits + number)).rowcount:
        connection.execute(insert(_HITS).values(scope=scope, **hit._asdict(), hits=number))
