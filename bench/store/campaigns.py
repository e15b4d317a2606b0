"""Campaigns in the database: started once; batches of shots are added atomically.

A shot's file is complete on disk before its row is written; rows, events and hit counts of a batch are one
transaction. At worst, a crash leaves a file without a row, which the same shot replaces.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from typing import Any, NamedTuple, TypeVar, get_type_hints

from sqlalchemy import Connection, Engine, Executable, Select, Table, func, insert, select, text, update
from sqlalchemy.exc import IntegrityError, OperationalError

from bench.base.errors import BenchError, Refused
from bench.records.shot.shot import COLUMNS, Shot, ShotStatus
from bench.store.database import (
    AIR_READINGS,
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
from bench.store.rows import (
    AirReading,
    CampaignEntry,
    CampaignRun,
    CampaignState,
    Event,
    Hit,
    Prompt,
    ShotExclusion,
    ShotNote,
    Standing,
    amendment,
)

_Answer = TypeVar("_Answer")
_Row = TypeVar("_Row")
_ENTRY = tuple(CampaignEntry.__dataclass_fields__)


class StoredShot(NamedTuple):
    """A shot and its complete file of cycles; "" when the robot did not swing."""

    shot: Shot
    file: str = ""
    bytes: int = 0
    set_aside: bool = False
    """Whether the shot's block was restarted after the shot."""


class CampaignStore:
    """The campaigns in one open database."""

    def __init__(self, engine: Engine) -> None:
        self.database = engine
        """The database, for its other contents."""
        self.waiting: Callable[[DatabaseLocked], None] | None = None
        """Called while the database is held by another process or away; raises its argument to give up."""
        self._writer, self._writes = secrets.token_hex(16), 0

    def begin(self, entry: CampaignEntry) -> None:
        """Add a campaign; raises Refused: the id exists already."""
        standing = Standing(CampaignState.RUNNING, "", "")._asdict()
        values = asdict(entry) | standing | {"number": _next(CAMPAIGNS.c.number)}
        try:
            self._execute(insert(CAMPAIGNS).values(values))
        except IntegrityError:
            location, action = f"campaign {entry.id}", "Start it again in a second."
            raise Refused(location, "the id exists already", "a new id", action) from None

    def entry(self, campaign: str) -> CampaignEntry:
        """Return a campaign's entry; raises BenchError: there is no such campaign."""
        query = select(*(CAMPAIGNS.c[name] for name in _ENTRY)).where(CAMPAIGNS.c.id == campaign)
        if not (rows := self._found(query)):
            action = "See golfbench campaign list."
            raise BenchError(f"campaign {campaign}", "no such campaign", "the ID of a campaign", action)
        return CampaignEntry(*rows[0])

    def entries(self) -> list[tuple[CampaignEntry, Standing, Counter[str]]]:
        """Return all campaigns with their states and shots by status, the last started first.

        A shot that is excluded by hand counts as excluded.
        """
        c, s = CAMPAIGNS.c, SHOTS.c
        every = select(CAMPAIGNS).order_by(c.number.desc(), c.date.desc())
        grouped = select(s.campaign, s.status, func.count()).group_by(s.campaign, s.status)

        def work(connection: Connection) -> list[tuple[CampaignEntry, Standing, Counter[str]]]:
            counts: dict[str, Counter[str]] = {}
            for campaign, status, number in connection.execute(grouped):
                counts.setdefault(campaign, Counter())[status] = number
            for campaign, number in connection.execute(_excluded_by_hand()):
                counts[campaign][ShotStatus.VALID] -= number
                counts[campaign][ShotStatus.EXCLUDED] += number
            return [
                (
                    CampaignEntry(**{name: row[name] for name in _ENTRY}),
                    _standing(row[name] for name in Standing._fields),
                    counts.get(row["id"], Counter()),
                )
                for row in connection.execute(every).mappings()
            ]

        return self._read(work)

    def standing(self, campaign: str) -> Standing:
        """Return the state of a campaign."""
        columns = (CAMPAIGNS.c[name] for name in Standing._fields)
        return _standing(self._found(select(*columns).where(CAMPAIGNS.c.id == campaign))[0])

    def change(self, campaign: str, **values: Any) -> None:
        """Set columns of `Standing`."""
        self._execute(update(CAMPAIGNS).where(CAMPAIGNS.c.id == campaign).values(**values))

    def shots(self, campaign: str) -> list[StoredShot]:
        """Return its shots in order."""
        c = SHOTS.c
        columns = (*(c[name] for name in COLUMNS), c.file, c.bytes, c.set_aside)
        rows = self._found(select(*columns).where(c.campaign == campaign).order_by(c.shot))
        return [StoredShot(_shot(row[:-3]), *row[-3:]) for row in rows]

    def events(self, campaign: str) -> list[Event]:
        """Return its events in order."""
        return self._rows(EVENTS, Event, campaign, "before_shot", "id")

    def note_event(self, campaign: str, event: Event) -> None:
        """Add an event at once."""
        self._execute(insert(EVENTS).values(campaign=campaign, **event._asdict()))

    def note_issue(self, campaign: str, issue: Event, number: int) -> None:
        """Add the issue of a report as the one with `number`; raises Refused: another one has that number."""
        c = EVENTS.c
        issues = select(func.count()).where((c.campaign == campaign) & (c.kind == issue.kind))

        def work(connection: Connection) -> None:
            connection.execute(select(CAMPAIGNS.c.id).where(CAMPAIGNS.c.id == campaign).with_for_update())
            if connection.scalar(issues) != number - 1:
                action = f"See that report. Amend it: {amendment(campaign)}."
                found, expected = f"report R{number} issued meanwhile", "one issue at a time"
                raise Refused(f"campaign {campaign}", found, expected, action)
            connection.execute(insert(EVENTS).values(campaign=campaign, **issue._asdict()))

        self._write(work)

    def begin_run(self, campaign: str, run: CampaignRun) -> None:
        """Add a run, numbered as the next one."""
        number = _next(RUNS.c.number, RUNS.c.campaign == campaign)
        self._execute(insert(RUNS).values(run._asdict() | {"campaign": campaign, "number": number}))

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

    def last_shot(self, campaign: str) -> int:
        """Return the number of its last shot; 0 before the first."""
        c = SHOTS.c
        return int(self._found(select(func.max(c.shot)).where(c.campaign == campaign))[0][0] or 0)

    def add_note(self, campaign: str, note: ShotNote) -> None:
        """Add a person's note on a shot; raises Refused: there is no such shot."""
        last = self.last_shot(campaign)
        if not 1 <= note.shot <= last:
            expected = f"a shot from 1 to {last}" if last else "a shot, once there is one"
            action = "Give --shot with a number of this campaign."
            raise Refused(f"campaign {campaign}", f"no shot {note.shot}", expected, action)
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

    def ask(self, campaign: str, prompt: Prompt) -> None:
        """Add a prompt."""
        self._execute(insert(PROMPTS).values(campaign=campaign, **prompt._asdict()))

    def answer(self, campaign: str, number: int, by: str, date: datetime) -> bool:
        """Mark prompt `number` as done; return whether it was open."""
        c = PROMPTS.c
        mine = (c.campaign == campaign) & (c.number == number) & c.answered.is_(None)

        def work(connection: Connection) -> bool:
            values = {"answered": date, "by": by, "answer": _next(PROMPTS.c.answer)}
            return bool(connection.execute(update(PROMPTS).where(mine).values(values)).rowcount)

        return self._write(work)

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
        return next(((row[0], Prompt(*row[1:])) for row in self._found(query)), None)

    def hits(self, scope: str) -> Counter[Hit]:
        """Return the number of uses of each part."""
        c = HITS.c
        rows = self._found(select(c.kind, c.name, c.sample, c.hits).where(c.scope == scope))
        return Counter({Hit(kind, name, sample): hits for kind, name, sample, hits in rows})

    def add_air(self, reading: AirReading) -> None:
        """Add a reading of the air."""
        self._execute(insert(AIR_READINGS).values(reading._asdict()))

    def newest_air(self, bench: str, since: datetime) -> AirReading | None:
        """Return the reading added last at `bench`, of those dated `since` or later; None if there is none.

        The last one added is the newest whatever the clock said, which may have been set back.
        """
        c = AIR_READINGS.c
        columns = (c[name] for name in AirReading._fields)
        query = select(*columns).where((c.bench == bench) & (c.date >= since)).order_by(c.id.desc()).limit(1)
        return next((AirReading(*row) for row in self._found(query)), None)

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
        scope = entry.hit_scope
        counted = [{"scope": scope, "hits": n, **hit._asdict()} for hit, n in (hits or {}).items()]

        def work(connection: Connection) -> None:
            if rows:
                connection.execute(insert(SHOTS), rows)
            if found:
                connection.execute(insert(EVENTS), found)
            if asked:
                first: int = connection.execute(select(_next(PROMPTS.c.answer))).scalar_one()
                numbered = [row | {"answer": order} for order, row in enumerate(asked, first)]
                connection.execute(insert(PROMPTS), numbered)
            if counted:
                connection.execute(_COUNT, counted)

        try:
            self._write(work)
        except IntegrityError:
            there = f"shot {shots[0].shot.shot}" if shots else "a row"
            location, expected = f"campaign {entry.id}", "one runner a campaign"
            raise Refused(location, f"{there} there already", expected, "Stop the other runner.") from None

    def _rows(self, table: Table, record: type[_Row], campaign: str, *order: str) -> list[_Row]:
        """Return the `record`s of a campaign in `table`, in order of these columns."""
        c = table.c
        query = select(*(c[name] for name in get_type_hints(record))).where(c.campaign == campaign)
        return [record(*row) for row in self._found(query.order_by(*(c[name] for name in order)))]

    def _found(self, query: Executable) -> Sequence[Any]:
        return self._read(lambda connection: connection.execute(query).all())

    def _read(self, work: Callable[[Connection], _Answer]) -> _Answer:
        """Return the answer of `work`, which only reads, from one transaction.

        It is repeated if its connection is lost and the store waits for its database.
        """
        while True:
            try:
                with transaction(self.database, writes=False, waiting=self.waiting) as connection:
                    return work(connection)
            except OperationalError as error:
                if not self._repeats(error):
                    raise

    def _write(self, work: Callable[[Connection], _Answer]) -> _Answer:
        """Do `work` in one transaction that takes the write lock at once, and return its answer.

        If the connection is lost, `work` is repeated, provided that `waiting` is set. A commit of which only
        the answer was lost has stored the number of this write, so nothing is stored twice. Without `waiting`
        there is no repetition, and no number.
        """
        self._writes += 1
        answers: list[_Answer] = []
        while True:
            try:
                with transaction(self.database, writes=True, waiting=self.waiting) as connection:
                    if not (answers and self._is_stored(connection)):
                        answers.append(work(connection))
                        if self.waiting is not None:
                            self._note_stored(connection)
                    return answers[-1]
            except OperationalError as error:
                if not self._repeats(error):
                    raise

    def _repeats(self, error: OperationalError) -> bool:
        """Return whether `error` has cut off a transaction that this store repeats."""
        return self.waiting is not None and is_away(error)

    def _execute(self, *statements: Executable) -> None:

        def work(connection: Connection) -> None:
            for statement in statements:
                connection.execute(statement)

        self._write(work)

    def _is_stored(self, connection: Connection) -> bool:
        query = select(WRITERS.c.writes).where(WRITERS.c.id == self._writer)
        return connection.scalar(query) == self._writes

    def _note_stored(self, connection: Connection) -> None:
        """Let the database know that the present write is in it."""
        mine = update(WRITERS).where(WRITERS.c.id == self._writer)
        if not connection.execute(mine.values(writes=self._writes)).rowcount:
            connection.execute(insert(WRITERS).values(id=self._writer, writes=self._writes))


def _standing(values: Iterable[Any]) -> Standing:
    state, *others = values
    return Standing(CampaignState(state), *others)


def _shot(values: Sequence[Any]) -> Shot:
    found = dict(zip(COLUMNS, values, strict=True))
    return Shot(**found | {"status": ShotStatus(found["status"])})


def _excluded_by_hand() -> Select[str, int]:
    """Return the query for the number of valid shots of each campaign whose last exclusion holds."""
    c, s = EXCLUSIONS.c, SHOTS.c
    last = select(func.max(c.id)).group_by(c.campaign, c.shot).scalar_subquery()
    held = (s.campaign == c.campaign) & (s.shot == c.shot) & (s.status == ShotStatus.VALID)
    query = select(c.campaign, func.count()).join(SHOTS, held).where(c.excluded, c.id.in_(last))
    return query.group_by(c.campaign)


def _next(column: Any, *where: Any) -> Any:
    """Return the query for the number that follows the largest one in `column`."""
    return select(func.coalesce(func.max(column), 0) + 1).where(*where).scalar_subquery()


_COUNT = text(
    "INSERT INTO hit_counts (scope, kind, name, sample, hits) VALUES (:scope, :kind, :name, :sample, :hits) "
    "ON CONFLICT (scope, kind, name, sample) DO UPDATE SET hits = hit_counts.hits + excluded.hits"
)
"""Adds uses of a part; SQLite and PostgreSQL know it, and neither asks first whether the row is there."""
