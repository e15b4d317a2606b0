"""Campaigns in the database: started once; batches of shots are added atomically.

A shot's file is complete on disk before its row is written; rows, events and hit counts of a batch are one
transaction. At worst, a crash leaves a file without a row, which the same shot replaces.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from datetime import datetime
from functools import wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast, get_type_hints

from sqlalchemy import Connection, Engine, Executable, Select, Table, func, insert, select, update
from sqlalchemy.exc import IntegrityError, OperationalError

from bench.base.errors import BenchError, Refused
from bench.records.shot.shot import COLUMNS, Shot, ShotStatus
from bench.store.database import (
    CAMPAIGNS,
    EVENTS,
    EXCLUSIONS,
    HITS,
    NOTES,
    PROMPTS,
    RUNS,
    SHOTS,
    WRITERS,
    DatabaseLocked,
    is_away,
    transaction,
)
from bench.store.records import (
    CampaignEntry,
    CampaignRun,
    CampaignState,
    Event,
    Hit,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
)

_Call = ParamSpec("_Call")
_Answer = TypeVar("_Answer")
_Row = TypeVar("_Row")


class StoredShot(NamedTuple):
    """A shot and its complete file of cycles; "" when the robot did not swing."""

    shot: Shot
    file: str = ""
    bytes: int = 0
    set_aside: bool = False
    """Whether the shot's block was restarted after the shot."""


def _again_if_lost(method: Callable[_Call, _Answer]) -> Callable[_Call, _Answer]:
    """Repeat a transaction that only reads if its connection is lost and the store waits for it."""

    @wraps(method)
    def repeated(*arguments: _Call.args, **options: _Call.kwargs) -> _Answer:
        store = cast(CampaignStore, arguments[0])
        while True:
            try:
                return method(*arguments, **options)
            except OperationalError as error:
                if not store.is_to_be_repeated(error):
                    raise

    return repeated


class CampaignStore:
    """The campaigns in one open database."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.waiting: Callable[[DatabaseLocked], None] | None = None
        """Called while the database is held by another process or away; raises its argument to give up."""
        self._writer, self._writes = secrets.token_hex(16), 0

    @property
    def database(self) -> Engine:
        """The database, for its other contents."""
        return self._engine

    def is_to_be_repeated(self, error: OperationalError) -> bool:
        """Return whether `error` has cut off a transaction that this store repeats."""
        return self.waiting is not None and is_away(error)

    def begin(self, entry: CampaignEntry) -> None:
        """Add a campaign.

        Raises:
            Refused: the id exists already.
        """
        values = asdict(entry) | {
            "state": CampaignState.RUNNING,
            "reason": "",
            "requested": "",
            "requested_by": "",
        }

        def work(connection: Connection) -> None:
            last = connection.scalar(select(func.max(CAMPAIGNS.c.number))) or 0
            connection.execute(insert(CAMPAIGNS).values(values | {"number": last + 1}))

        try:
            self._write(work)
        except IntegrityError:
            raise Refused(
                f"campaign {entry.id}", "the id exists already", "a new id", "Start it again in a second."
            ) from None

    @_again_if_lost
    def entry(self, campaign: str) -> CampaignEntry:
        """Return a campaign's entry.

        Raises:
            BenchError: there is no such campaign.
        """
        names = CampaignEntry.__dataclass_fields__
        with self._reading() as connection:
            query = select(*(CAMPAIGNS.c[name] for name in names)).where(CAMPAIGNS.c.id == campaign)
            found = connection.execute(query).mappings().first()
        if found is None:
            raise BenchError(
                f"campaign {campaign}",
                "no such campaign",
                "the ID of a campaign",
                "See golfbench campaign list.",
            )
        return CampaignEntry(**found)

    @_again_if_lost
    def entries(self) -> list[tuple[CampaignEntry, Standing, Counter[str]]]:
        """Return all campaigns with their states and shots by status, the last started first.

        A shot that is excluded by hand counts as excluded.
        """
        names = CampaignEntry.__dataclass_fields__
        last_first = CAMPAIGNS.c.number.desc(), CAMPAIGNS.c.date.desc()
        with self._reading() as connection:
            rows = connection.execute(select(CAMPAIGNS).order_by(*last_first)).mappings().all()
            counts: dict[str, Counter[str]] = {}
            grouped = select(SHOTS.c.campaign, SHOTS.c.status, func.count()).group_by(
                SHOTS.c.campaign, SHOTS.c.status
            )
            for campaign, status, number in connection.execute(grouped):
                counts.setdefault(campaign, Counter())[status] = number
            for campaign, number in connection.execute(_excluded_by_hand()):
                counts[campaign][ShotStatus.VALID] -= number
                counts[campaign][ShotStatus.EXCLUDED] += number
        return [
            (
                CampaignEntry(**{name: row[name] for name in names}),
                Standing(CampaignState(row["state"]), row["reason"], row["requested"], row["requested_by"]),
                counts.get(row["id"], Counter()),
            )
            for row in rows
        ]

    @_again_if_lost
    def standing(self, campaign: str) -> Standing:
        """Return the state of a campaign."""
        columns = (CAMPAIGNS.c[name] for name in Standing._fields)
        with self._reading() as connection:
            row = connection.execute(select(*columns).where(CAMPAIGNS.c.id == campaign)).one()
        return Standing(CampaignState(row[0]), *row[1:])

    def change(self, campaign: str, **values: Any) -> None:
        """Set columns of `Standing`."""
        self._execute(update(CAMPAIGNS).where(CAMPAIGNS.c.id == campaign).values(**values))

    @_again_if_lost
    def shots(self, campaign: str) -> list[StoredShot]:
        """Return its shots in order."""
        query = select(SHOTS).where(SHOTS.c.campaign == campaign).order_by(SHOTS.c.shot)
        with self._reading() as connection:
            return [
                StoredShot(
                    Shot(**{name: row[name] for name in COLUMNS} | {"status": ShotStatus(row["status"])}),
                    row["file"],
                    row["bytes"],
                    bool(row["set_aside"]),
                )
                for row in connection.execute(query).mappings()
            ]

    def events(self, campaign: str) -> list[Event]:
        """Return its events in order."""
        return self._rows(EVENTS, Event, campaign, "before_shot", "id")

    def note_event(self, campaign: str, event: Event) -> None:
        """Add an event at once."""
        self._execute(insert(EVENTS).values(campaign=campaign, **event._asdict()))

    def begin_run(
        self, campaign: str, by: str, began: datetime, versions: Mapping[str, Any], facts: Mapping[str, Any]
    ) -> None:
        """Add a run."""
        c = RUNS.c

        def work(connection: Connection) -> None:
            last = connection.scalar(select(func.max(c.number)).where(c.campaign == campaign)) or 0
            row = CampaignRun(last + 1, began, by, versions, facts)
            connection.execute(insert(RUNS).values(campaign=campaign, **row._asdict()))

        self._write(work)

    def runs(self, campaign: str) -> list[CampaignRun]:
        """Return its runs in order."""
        return self._rows(RUNS, CampaignRun, campaign, "number")

    def set_aside(self, campaign: str, shots: Sequence[int], event: Event) -> None:
        """Exclude `shots`, whose block restarts, with the text of `event`; they are kept. All or nothing."""
        c = SHOTS.c
        mine = (c.campaign == campaign) & c.shot.in_(shots)
        valid = mine & (c.status == ShotStatus.VALID)
        self._execute(
            update(SHOTS).where(mine).values(set_aside=True),
            update(SHOTS).where(valid).values(status=ShotStatus.EXCLUDED, reason=event.text),
            insert(EVENTS).values(campaign=campaign, **event._asdict()),
        )

    @_again_if_lost
    def last_shot(self, campaign: str) -> int:
        """Return the number of its last shot; 0 before the first."""
        c = SHOTS.c
        with self._reading() as connection:
            return connection.scalar(select(func.max(c.shot)).where(c.campaign == campaign)) or 0

    def add_note(self, campaign: str, note: ShotNote) -> None:
        """Add a person's note on a shot.

        Raises:
            Refused: there is no such shot.
        """
        last = self.last_shot(campaign)
        if not 1 <= note.shot <= last:
            expected = f"a shot from 1 to {last}" if last else "a shot, once there is one"
            raise Refused(
                f"campaign {campaign}",
                f"no shot {note.shot}",
                expected,
                "Give --shot with a number of this campaign.",
            )
        self._execute(insert(NOTES).values(campaign=campaign, **note._asdict()))

    def notes(self, campaign: str) -> list[ShotNote]:
        """Return the notes on its shots, by shot and in the order in which they were made."""
        return self._rows(NOTES, ShotNote, campaign, "shot", "id")

    def add_exclusion(self, campaign: str, exclusion: ShotExclusion) -> None:
        """Add a person's exclusion of a shot, whose own row stays as it is."""
        self._execute(insert(EXCLUSIONS).values(campaign=campaign, **exclusion._asdict()))

    def exclusions(self, campaign: str) -> list[ShotExclusion]:
        """Return the exclusions by hand in the order in which they were made."""
        return self._rows(EXCLUSIONS, ShotExclusion, campaign, "id")

    def prompts(self, campaign: str) -> list[Prompt]:
        """Return its prompts in order; at most the last one is not answered."""
        return self._rows(PROMPTS, Prompt, campaign, "number")

    def prompt(self, campaign: str, number: int) -> Prompt:
        """Return one of its prompts."""
        return next(prompt for prompt in self.prompts(campaign) if prompt.number == number)

    def ask(self, campaign: str, prompt: Prompt) -> None:
        """Add a prompt."""
        self._execute(insert(PROMPTS).values(campaign=campaign, **prompt._asdict()))

    def answer(self, campaign: str, number: int, by: str, date: datetime) -> bool:
        """Mark prompt `number` as done; return whether it was open."""
        c = PROMPTS.c
        mine = (c.campaign == campaign) & (c.number == number) & c.answered.is_(None)

        def work(connection: Connection) -> bool:
            values = {"answered": date, "by": by, "answer": _next_answer(connection)}
            return bool(connection.execute(update(PROMPTS).where(mine).values(values)).rowcount)

        return self._write(work)

    @_again_if_lost
    def last_answered(self, entry: CampaignEntry, kind: str) -> tuple[str, Prompt] | None:
        """Return the bench's prompt of `kind` that was answered last, with its campaign; None if none was.

        The order of answers counts, not the clock, which may have jumped back. Each simulated campaign
        has a separate bench; all campaigns of a real bench share it.
        """
        c, of = PROMPTS.c, CAMPAIGNS.c
        scope = c.campaign == entry.id if entry.simulated else (of.bench == entry.bench) & ~of.simulated
        query = (
            select(c.campaign, *(c[name] for name in Prompt._fields))
            .join(CAMPAIGNS, of.id == c.campaign)
            .where(scope & (c.kind == kind) & c.answered.is_not(None))
            .order_by(c.answer.desc(), c.number.desc())
            .limit(1)
        )
        with self._reading() as connection:
            row = connection.execute(query).first()
        return None if row is None else (row[0], Prompt(*row[1:]))

    @_again_if_lost
    def hits(self, scope: str) -> Counter[Hit]:
        """Return the number of uses of each part."""
        c = HITS.c
        with self._reading() as connection:
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
        """Add a batch in one transaction; the shots' files are complete and the prompts answered.

        Raises:
            Refused: one of these shots is there already: another runner has this campaign.
        """
        rows = [
            {"campaign": entry.id, "file": stored.file, "bytes": stored.bytes} | vars(stored.shot)
            for stored in shots
        ]
        found = [{"campaign": entry.id, **event._asdict()} for event in events]
        asked = [{"campaign": entry.id, **prompt._asdict()} for prompt in prompts]

        def work(connection: Connection) -> None:
            if rows:
                connection.execute(insert(SHOTS), rows)
            if found:
                connection.execute(insert(EVENTS), found)
            if asked:
                first = _next_answer(connection)
                numbered = [row | {"answer": order} for order, row in enumerate(asked, first)]
                connection.execute(insert(PROMPTS), numbered)
            for hit, number in (hits or {}).items():
                _count(connection, entry.hit_scope, hit, number)

        try:
            self._write(work)
        except IntegrityError:
            there = f"shot {shots[0].shot.shot}" if shots else "a row"
            location, expected = f"campaign {entry.id}", "one runner a campaign"
            raise Refused(location, f"{there} there already", expected, "Stop the other runner.") from None

    @_again_if_lost
    def _rows(self, table: Table, record: type[_Row], campaign: str, *order: str) -> list[_Row]:
        """Return the `record`s of a campaign in `table`, in order of these columns."""
        c = table.c
        query = select(*(c[name] for name in get_type_hints(record))).where(c.campaign == campaign)
        with self._reading() as connection:
            rows = connection.execute(query.order_by(*(c[name] for name in order)))
            return [record(*row) for row in rows]

    def _write(self, work: Callable[[Connection], _Answer]) -> _Answer:
        """Do `work` in one transaction that takes the write lock at once, and return its answer.

        If its connection is lost, it is repeated when the store waits for its database. A commit whose answer
        alone was lost has left the number of this write, so nothing is stored twice. Who does not wait does
        not repeat, and leaves no number.
        """
        self._writes += 1
        answers: list[_Answer] = []
        while True:
            try:
                with transaction(self._engine, writes=True, waiting=self.waiting) as connection:
                    if not (answers and self._is_stored(connection)):
                        answers.append(work(connection))
                        if self.waiting is not None:
                            self._note_stored(connection)
                    return answers[-1]
            except OperationalError as error:
                if not self.is_to_be_repeated(error):
                    raise

    def _execute(self, *statements: Executable) -> None:
        """Execute `statements` in one transaction, once."""

        def work(connection: Connection) -> None:
            for statement in statements:
                connection.execute(statement)

        self._write(work)

    def _is_stored(self, connection: Connection) -> bool:
        """Return whether the present write is in the database."""
        query = select(WRITERS.c.writes).where(WRITERS.c.id == self._writer)
        return connection.scalar(query) == self._writes

    def _note_stored(self, connection: Connection) -> None:
        """Let the database know that the present write is in it."""
        mine = update(WRITERS).where(WRITERS.c.id == self._writer)
        if not connection.execute(mine.values(writes=self._writes)).rowcount:
            connection.execute(insert(WRITERS).values(id=self._writer, writes=self._writes))

    def _reading(self) -> AbstractContextManager[Connection]:
        return transaction(self._engine, writes=False, waiting=self.waiting)


def _excluded_by_hand() -> Select[str, int]:
    """Return the query for the number of valid shots of each campaign whose last exclusion holds."""
    c, s = EXCLUSIONS.c, SHOTS.c
    last = select(func.max(c.id)).group_by(c.campaign, c.shot).scalar_subquery()
    held = (s.campaign == c.campaign) & (s.shot == c.shot) & (s.status == ShotStatus.VALID)
    query = select(c.campaign, func.count()).join(SHOTS, held).where(c.excluded, c.id.in_(last))
    return query.group_by(c.campaign)


def _next_answer(connection: Connection) -> int:
    return (connection.scalar(select(func.max(PROMPTS.c.answer))) or 0) + 1


def _count(connection: Connection, scope: str, hit: Hit, number: int) -> None:
    c = HITS.c
    mine = (c.scope == scope) & (c.kind == hit.kind) & (c.name == hit.name) & (c.sample == hit.sample)
    if not connection.execute(update(HITS).where(mine).values(hits=c.hits + number)).rowcount:
        connection.execute(insert(HITS).values(scope=scope, **hit._asdict(), hits=number))
