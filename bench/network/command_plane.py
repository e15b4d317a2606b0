"""The command plane of the daemon: commands in over a zenoh queryable, state and events out.

Three lanes, each a bounded queue with its own thread: stops, requests (one at a time to the loop), and
lookups. zenoh's threads only sort a message into its lane. For a full lane they answer "busy" themselves,
so that a flood delays only its sender; a stop they accept. A stop is noted before anything else is done with
its message, even an invalid one: only its answer may get lost, never the stop.
"""

from __future__ import annotations

import json
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from threading import Condition, Lock, Thread
from typing import Any, NamedTuple, cast

import zenoh

from bench.base.address import root_key
from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, Refusal, Request, State
from bench.control.requests import STOP_LOCKOUT_TIME
from bench.network.bench_service import (
    BenchService,
    BenchStatus,
    CommandAnswer,
    CountStatus,
    LeaseStatus,
    refused,
)
from bench.network.command import (
    CONVENIENCE,
    MAX_COMMAND_BYTES,
    PLAIN,
    REQUESTS,
    STOPS,
    VERSION,
    LeaseContent,
    ParsedCommand,
    Verb,
    encode_answer,
    encode_error,
    parse_command,
    too_long,
)
from bench.network.lease import Lease, LeaseBook, LeaseRefused
from bench.network.messages import wire_contract
from bench.network.status_words import next_step

QUEUE = 64
"""Max messages waiting in a lane."""

MAX_REQUEST_WAIT = STOP_LOCKOUT_TIME - 0.5
"""Max age of a request handed to the loop, s; the sender of an older one has given up: it is dropped."""

HEARTBEAT = 0.2
"""Interval of published states without a change, s."""

CLOSE_TIMEOUT = 1.5
"""Time `CommandPlane.close` waits for the lanes, s."""

_CHANGES = (
    "state",
    "phase",
    "reaction",
    "cause",
    "latest_cause",
    "homed",
    "vented",
    "swings",
    "support_ready",
    "arming_blocks",
    "emergency_stop_clear",
    "guard_closed",
    "guard_locked",
)
"""Parts of the state that are published as soon as they change, as the lease's holder and a launch monitor's
coming and going are."""

_STOPS_ANYWAY = "The bench stops all the same."
_REQUESTED = frozenset({Verb.LEASE, Verb.CORRECT, *REQUESTS})
_NEVER_LATE = frozenset({"lease release", Verb.DISARM})
"""Forms that only end permissions: carried out at any age."""


class Message(NamedTuple):
    """One command as received."""

    query: zenoh.Query
    verb: str
    """Part of the key after `command/`; an unknown one is answered with an error."""
    payload: bytes
    arrived: float
    """Arrival on the plane's clock (s)."""


class _Lane:
    """A bounded queue and the thread that empties it."""

    def __init__(self, name: str, work: Callable[[list[Message], frozenset[str]], None], batch: int) -> None:
        """`work` gets up to `batch` messages, and the verbs of all that came, with and without room."""
        self._work, self._batch = work, batch
        self._waiting: deque[Message] = deque()
        self._verbs: set[str] = set()
        self._changed = Condition(Lock())
        self._closed = False
        self._thread = Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def offer(self, message: Message) -> bool:
        """Queue `message`; return False if the queue is full. Never blocks for long."""
        with self._changed:
            if self._closed:
                return False
            self._verbs.add(message.verb)
            room = len(self._waiting) < QUEUE
            if room:
                self._waiting.append(message)
            self._changed.notify()
            return room

    def note(self, verb: str) -> None:
        """Notify the thread that `verb` arrived without content."""
        with self._changed:
            self._verbs.add(verb)
            self._changed.notify()

    def close(self) -> None:
        """Accept no more messages; the thread ends when the queue is empty."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def join(self, timeout: float) -> bool:
        """Wait up to `timeout` s for the thread's end; return whether it ended."""
        self._thread.join(max(0.0, timeout))
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not (self._waiting or self._verbs or self._closed):
                    self._changed.wait()
                if not (self._waiting or self._verbs):
                    return
                count = min(self._batch, len(self._waiting))
                messages = [self._waiting.popleft() for _ in range(count)]
                verbs, self._verbs = frozenset(self._verbs), set()
            self._work(messages, verbs)


class CommandPlane:
    """Answers commands for `service` on an open session, and publishes the supervisor's messages."""

    def __init__(
        self,
        session: zenoh.Session,
        bench: str,
        service: BenchService,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Start answering. `bench` is the bench's id; leases run on `clock` (s)."""
        self._root, self._service, self._clock = root_key(bench), service, clock
        self._book, self._book_lock = LeaseBook(), Lock()
        self._counts, self._count_lock = Counter[str](), Lock()
        self._closing = False
        self._last_state = State.STARTING.name
        self._told: tuple[Any, ...] = ()
        self._told_at = -HEARTBEAT
        self._stops = _Lane("command stops", self._do_stops, QUEUE)
        self._requests = _Lane("command requests", self._do_each, 1)
        self._lookups = _Lane("command lookups", self._do_each, 1)
        # All drop messages that a receiver does not take.
        self._state, self._event, self._shot = (
            session.declare_publisher(
                f"{self._root}/{name}",
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            for name in ("state", "event", "shot")
        )
        self._contract = json.dumps(wire_contract(bench)).encode()
        # Called by the link's own thread: zenoh's own queue for Python would have no bound.
        self._queryable = session.declare_queryable(
            f"{self._root}/command/**", zenoh.handlers.Callback(self._receive, indirect=False)
        )
        self._schema = session.declare_queryable(
            f"{self._root}/schema", zenoh.handlers.Callback(self._send_contract, indirect=False)
        )

    def close(self) -> bool:
        """Close within 2 s: waiting requests are refused, stops are carried out; False if the desk hangs."""
        self._closing = True
        with suppress(zenoh.ZError):  # the session may be gone
            self._queryable.undeclare()
            self._schema.undeclare()
        lanes = (self._stops, self._requests, self._lookups)
        for lane in lanes:
            lane.close()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        ended = [lane.join(deadline - time.monotonic()) for lane in lanes]
        with suppress(zenoh.ZError):
            self._state.undeclare()
            self._event.undeclare()
            self._shot.undeclare()
        return all(ended)

    # For the supervisor --------------------------------------------------------------------------

    def lease(self) -> Lease | None:
        """Return the valid lease, if any."""
        with self._book_lock:
            return self._book.held(self._clock())

    def lease_status(self) -> LeaseStatus | None:
        """Return the valid lease as the status has it, if any."""
        lease, now = self.lease(), self._clock()
        if lease is None:
            return None
        left, lapsing = lease.expiry - now, lease.lapses_soon(now)
        return LeaseStatus(holder=lease.holder, seconds_left=left, lapsing=lapsing)

    def counts(self) -> CountStatus:
        """Return the counts of messages by outcome."""
        with self._count_lock:
            return cast(CountStatus, {kind: self._counts[kind] for kind in CountStatus.__annotations__})

    def publish_state(self, status: BenchStatus) -> bool:
        """Publish `status` if it has changed or a heartbeat is due; return whether it was."""
        status = self._completed(status)
        lease, monitor, now = status["lease"], status["launch_monitor"], self._clock()
        beside = lease and (lease["holder"], lease["lapsing"]), monitor and monitor["present"]
        telling = (*beside, *(status[name] for name in _CHANGES))  # type: ignore[literal-required]
        if telling == self._told and now - self._told_at < HEARTBEAT:
            return False
        self._told, self._told_at = telling, now
        with suppress(zenoh.ZError):  # no session to publish to
            self._state.put(json.dumps(status, allow_nan=False))
        return True

    def publish_event(self, event: str, **content: Any) -> None:
        """Publish that `event` happened, with `content` after its name and time (s, the plane's clock)."""
        message = {"version": VERSION, "event": event, "time": self._clock(), **content}
        with suppress(zenoh.ZError):
            self._event.put(json.dumps(message, allow_nan=False))

    def publish_shot(self, message: Mapping[str, Any]) -> None:
        """Publish the present message about a shot, see `bench.records.shot.shot_message`."""
        with suppress(zenoh.ZError):
            self._shot.put(json.dumps(message, allow_nan=False))

    # Receiving: in zenoh's threads, must neither wait nor raise ----------------------------------

    def _receive(self, query: zenoh.Query) -> None:
        try:
            verb = self._verb(str(query.key_expr))
            size = sum(len(part) for part in (query.payload, query.attachment) if part is not None)
            size += len(str(query.parameters))
            lane = self._stops if verb in STOPS else self._requests if verb in _REQUESTED else self._lookups
            if size > MAX_COMMAND_BYTES:
                # It is not to wait in a queue, which holds few messages but could hold long ones.
                if lane is self._stops:
                    lane.note(verb)
                self._answer_error(query, too_long(f"command {verb[:40]}", size))
                return
            payload = b"" if query.payload is None else query.payload.to_bytes()
            if lane.offer(Message(query, verb, payload, self._clock())):
                return
            if lane is self._stops and not self._closing:
                note = f"Others asked before. {CONVENIENCE}" if verb == Verb.ESTOP else "Others asked before."
                self._answer(query, verb, CommandAnswer(True, self._last_state, note=note))
            else:
                self._refuse(query, verb, Refusal.SHUTTING_DOWN if self._closing else Refusal.BUSY)
        except Exception:  # whatever the error, zenoh's thread must continue
            with self._count_lock:
                self._counts["dropped"] += 1

    def _send_contract(self, query: zenoh.Query) -> None:
        with suppress(zenoh.ZError), query:
            query.reply(f"{self._root}/schema", self._contract, encoding=zenoh.Encoding.APPLICATION_JSON)

    def _verb(self, key: str) -> str:
        """Return the part of `key` after `command/`, also if it names several benches."""
        chunks = key.split("/", 3)
        return chunks[3] if len(chunks) == 4 and chunks[2] == "command" else key

    # The lanes' work -----------------------------------------------------------------------------

    def _do_stops(self, messages: list[Message], verbs: frozenset[str]) -> None:
        """Stop once for all waiting requests, then answer each."""
        replies: dict[str, CommandAnswer] = {}
        stops = (Verb.ESTOP, Request.EMERGENCY_STOP, CONVENIENCE), (Verb.STOP, Request.STOP, "")
        for verb, request, note in stops:
            if verb in verbs:
                try:
                    reply = self._answer_of(self._service.stop(request))
                except Exception as error:  # see _do
                    reply = self._failed(error)
                replies[verb] = reply._replace(note=note)
        for message in messages:
            try:
                parse_command(message.verb, message.payload)
            except BenchError as error:
                stopped = BenchError(
                    error.location, error.found, error.expected, f"{error.action} {_STOPS_ANYWAY}"
                )
                self._answer_error(message.query, stopped)
            else:
                self._answer(message.query, message.verb, replies[message.verb])

    def _do_each(self, messages: list[Message], _: frozenset[str]) -> None:
        for query, verb, payload, arrived in messages:
            if verb in _REQUESTED and self._closing:
                self._refuse(query, verb, Refusal.SHUTTING_DOWN)
            else:
                self._do(query, verb, payload, arrived)

    def _do(self, query: zenoh.Query, verb: str, payload: bytes, arrived: float) -> None:
        try:
            command = parse_command(verb, payload)
        except BenchError as error:
            self._answer_error(query, error)
            return
        ages = command.verb in _REQUESTED and command.form not in _NEVER_LATE

        def is_late() -> bool:
            return ages and self._clock() - arrived > MAX_REQUEST_WAIT

        if is_late():
            self._refuse(query, verb, Refusal.TOO_LATE)
            return
        try:
            answer = self._obey(command, is_late)
        except LeaseRefused as error:
            answer = self._answer_of(refused("", error.refusal, *error.words))
        except Exception as error:  # the client gets an answer to any error of the service
            answer = self._failed(error)
        self._answer(query, verb, answer)

    def _obey(self, command: ParsedCommand, is_late: Callable[[], bool]) -> CommandAnswer:
        verb, key, sequence = command.verb, command.key, command.sequence
        match command.form:
            case "lease take":
                with self._book_lock:
                    lease = self._book.take(command.holder, command.seconds, self._clock())
                return self._of_lease(lease, key=lease.key)
            case "lease renew":
                with self._book_lock:
                    lease = self._book.renew(key, sequence, command.seconds, self._clock())
                return self._of_lease(lease)
            case "lease release":
                with self._book_lock:
                    self._book.release(key, sequence, self._clock())
                return self._answer_of(CommandAnswer(True, ""))
            case Verb.STATUS:
                status = self._completed(self._service.status())
                return CommandAnswer(True, status["state"], content=dict(status))
        if verb not in PLAIN:
            with self._book_lock:
                self._book.use(key, sequence, self._clock())
        if verb is Verb.CORRECT:
            return self._answer_of(self._service.correct(command.profile, command.weights))
        return self._answer_of(self._service.request(REQUESTS[verb], is_late))

    def _failed(self, error: Exception) -> CommandAnswer:
        fact = f"the bench could not do it, {type(error).__name__}: {error}"
        return refused(self._last_state, Refusal.FAILED, fact)

    def _of_lease(self, lease: Lease, **more: str) -> CommandAnswer:
        content = LeaseContent(holder=lease.holder, seconds_left=lease.expiry - self._clock())
        return self._answer_of(CommandAnswer(True, ""))._replace(content={**content, **more})

    def _answer_of(self, answer: CommandAnswer) -> CommandAnswer:
        """Return `answer` with state, cause and, if refused for its state, the next step."""
        try:
            status = self._service.status()
        except Exception:  # see _do
            return answer._replace(state=answer.state or self._last_state)
        state, cause = answer.state or status["state"], status["cause"]
        if answer.refusal == Refusal.STATE.name:
            answer = answer._replace(action=next_step({**status, "state": state}))
        return answer._replace(state=state, cause=Cause.NONE.name if cause is None else cause["name"])

    def _completed(self, status: BenchStatus) -> BenchStatus:
        self._last_state = status["state"]
        return {**status, "lease": self.lease_status(), "counts": self.counts()}

    # Answering -----------------------------------------------------------------------------------

    def _refuse(self, query: zenoh.Query, verb: str, refusal: Refusal) -> None:
        self._answer(query, verb, refused(self._last_state, refusal))

    def _answer(self, query: zenoh.Query, verb: str, answer: CommandAnswer) -> None:
        try:
            payload = encode_answer(answer)
        except (TypeError, ValueError) as error:  # a desk's status that is no JSON
            answer = self._failed(error)
            payload = encode_answer(answer)
        self._last_state = answer.state
        with self._counted("commands" if answer.accepted else "refused"), query:
            # Not the query's own key, which may match several benches.
            query.reply(f"{self._root}/command/{verb}", payload, encoding=zenoh.Encoding.APPLICATION_JSON)

    def _answer_error(self, query: zenoh.Query, error: BenchError) -> None:
        with self._counted("malformed"), query:
            query.reply_err(encode_error(error), encoding=zenoh.Encoding.APPLICATION_JSON)

    @contextmanager
    def _counted(self, kind: str) -> Iterator[None]:
        """Count one message of `kind`, as dropped if its answer cannot be sent."""
        with self._count_lock:
            self._counts[kind] += 1
        try:
            yield
        except zenoh.ZError:
            with self._count_lock:
                self._counts.subtract({kind: 1, "dropped": -1})
