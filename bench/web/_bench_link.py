"""The page's connection to its bench: retried until there is one, followed in a separate thread.

It receives the bench's publications and asks with `BenchClient`, so it can do no more than that client.
Commands are sent once: after a lost connection nothing is repeated. The page gets the state as text for the
operator, with values in SI, which the browser converts.

Readers of the page get the newest of each topic; their number is bounded. One that is too slow loses older
messages, never the newest, and costs no more memory than one message a topic. Nothing waits for it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from datetime import UTC, datetime
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING, Any
from weakref import WeakSet

from bench.base.errors import BenchError
from bench.base.lifecycle import ACCEPTED_IN, LATCHED, MOVING, NEEDS_LEASE, Phase, Reaction, Request, State
from bench.network.bench_service import BenchStatus, CauseStatus
from bench.network.client import BenchClient, checked_status
from bench.network.command import REQUESTS
from bench.network.status_words import (
    PHASE_WORDS,
    REACTION_WORDS,
    interlock_conditions,
    next_step,
    robot_conditions,
    sentence,
    shut_off_words,
    state_words,
    vent_words,
    warning_texts,
)
from bench.network.zenoh_session import NoAnswer, open_client
from bench.viewer.feed import Feed
from drivers.base import ACTUATORS, JOINTS

if TYPE_CHECKING:
    import zenoh

    from bench.base.address import NetworkSettings


def state_view(status: BenchStatus) -> dict[str, Any]:
    """Return `status`, valid as JSON, with words, conditions and commands for the page."""
    state = State[status["state"]]
    chambers = status["chamber_pressure_pa"]
    sides = zip(ACTUATORS, chambers[::2], chambers[1::2], strict=True)
    return {
        **status,
        "tone": _tone(state, vented=status["vented"]),
        "words": state_words(status),
        "next": next_step(status),
        "phase": PHASE_WORDS[Phase[status["phase"]]],
        "reaction": _reaction(Reaction[status["reaction"]], vented=status["vented"]),
        "cause": _cause(status["cause"]),
        "latest_cause": _cause(status["latest_cause"]),
        "conditions": [c._asdict() for c in (*robot_conditions(status), *interlock_conditions(status))],
        "joints": [
            {"name": name, "deg": angle} for name, angle in zip(JOINTS, status["joints_deg"], strict=True)
        ],
        "chambers": [{"name": name, "a_pa": a, "b_pa": b} for name, a, b in sides],
        "vents": vent_words(status["vents_open"]),
        "shut_off": shut_off_words(status["shut_off_open"]),
        "warnings": warning_texts(status),
        "accepts": accepted_commands(state),
    }


def _reaction(reaction: Reaction, *, vented: bool) -> str:
    """Return the words of `reaction`; none for a venting that is over."""
    return "" if reaction is Reaction.VENT and vented else REACTION_WORDS[reaction]


def _tone(state: State, *, vented: bool) -> str:
    """Return the colour of `state`: stopped, moving, ready or rest."""
    if state in LATCHED:
        return "stopped"
    if state in MOVING:
        return "moving"
    return "ready" if state is State.READY and vented else "rest"


def accepted_commands(state: State) -> list[str]:
    """Return the commands that the bench may accept in `state`, apart from the stops."""
    return sorted(
        str(verb)
        for verb, request in REQUESTS.items()
        if state in ACCEPTED_IN[request] and request in NEEDS_LEASE | {Request.DISARM}
    )


def _cause(cause: CauseStatus | None) -> dict[str, str] | None:
    if cause is None:
        return None
    return {"name": cause["name"], "what": sentence(cause["text"]), "action": sentence(cause["action"])}


TOPICS = ("state", "event", "shot", "loop")
"""Messages of the bench that the page shows; telemetry at 1 kHz is left to the viewer."""
EVENTS = 30
TIMEOUT = 1.5
"""Time-out of the bench's answer to a command, s."""

_RETRY = 0.5
"""Time between two attempts to connect, s."""
_TAKE = 0.25
"""Max time without a look whether the link is to end, s."""

_log = logging.getLogger("golfbench")


class BenchLink:
    """Follows one bench and passes on its publications; `close` ends its thread."""

    def __init__(
        self,
        network: NetworkSettings,
        bench: str,
        publish: Callable[[str, Any], None],
        on_swing: Callable[[bool], None],
        on_shot: Callable[[dict[str, Any]], None],
    ) -> None:
        """Pass messages as topic and content to `publish`, those about shots to `on_shot`.

        `on_swing` is called at each state in a swing (True) and once after it (False). All are called in the
        link's thread.
        """
        self.bench, self._network, self._publish = bench, network, publish
        self._on_swing, self._on_shot = on_swing, on_shot
        self._session: zenoh.Session | None = None
        self._lock, self._ended = Lock(), Event()
        self._heard_at = -float("inf")
        self._events: deque[dict[str, Any]] = deque(maxlen=EVENTS)
        self._state = ""
        self._thread = Thread(target=self._follow, name="page-bench", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the connection and the thread."""
        self._ended.set()
        self._thread.join()

    def silence(self) -> float:
        """Return the time since the bench's newest state, s; infinite before the first."""
        return time.monotonic() - self._heard_at

    def client(self) -> BenchClient:
        """Return a client without a lease on the open connection; not to be closed.

        Raises:
            NoAnswer: there is no connection.
        """
        with self._lock:
            session = self._session
        if session is None:
            raise NoAnswer(self.bench, self._network.endpoint)
        return BenchClient(session, self.bench, self._network, TIMEOUT)

    def _follow(self) -> None:
        while not self._ended.is_set():
            try:
                session = open_client(self._network, self.bench)
            except BenchError:
                self._ended.wait(_RETRY)
                continue
            with Feed(session, self.bench, TOPICS) as feed:
                with self._lock:
                    self._session = session
                try:
                    while not self._ended.is_set():
                        for topic, content in feed.take(_TAKE).messages:
                            self._receive(feed, topic, content)
                finally:
                    with self._lock:
                        self._session = None

    def _receive(self, feed: Feed, topic: str, content: dict[str, Any]) -> None:
        """Pass on one message; an invalid one is counted."""
        try:
            if topic == "state":
                view = state_view(checked_status(content))
                self._heard_at = time.monotonic()
                self._publish("state", view | {"seen": self._heard_at})
                before, self._state = self._state, view["state"]
                if State.SWINGING.name in (before, self._state):
                    self._on_swing(self._state == State.SWINGING.name)
            elif topic == "event":
                self._events.append(
                    content | {"at_utc": datetime.now(UTC).isoformat(timespec="milliseconds")}
                )
                self._publish("events", list(self._events))
            elif topic == "shot":
                self._on_shot(content)
            else:
                self._publish(topic, content)
        except (BenchError, KeyError, TypeError, ValueError) as error:
            feed.count_invalid(str(error))
            _log.warning("page: invalid message on %s: %s", topic, error)


# Messages to the readers -----------------------------------------------------------------------------

MAX_READERS = 32
"""Max number of open pages."""


class PageReader:
    """Waiting messages of one reader, to be used in the server's event loop."""

    def __init__(self, newest: Mapping[str, bytes]) -> None:
        """Set the `newest` messages by topic."""
        self._waiting, self._arrived, self._ended = dict(newest), asyncio.Event(), False
        self._arrived.set()

    def put(self, topic: str, message: bytes) -> None:
        """Keep `message` in place of an older one of its topic."""
        self._waiting[topic] = message
        self._arrived.set()

    def end(self) -> None:
        """Let the reader end after the waiting messages."""
        self._ended = True
        self._arrived.set()

    async def take(self) -> bytes | None:
        """Return the waiting messages as one text, once there are any; None at the end."""
        while not self._waiting:
            if self._ended:
                return None
            self._arrived.clear()
            await self._arrived.wait()
        messages = b"".join(self._waiting.values())
        self._waiting.clear()
        return messages


class PageBroadcaster:
    """Passes messages from any thread to the readers."""

    def __init__(self) -> None:
        self._newest: dict[str, bytes] = {}
        self._readers = WeakSet[PageReader]()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._lock = Lock()

    def attach(self, loop: asyncio.AbstractEventLoop | None) -> None:
        """Serve readers in `loop` from now on; None: no longer."""
        with self._lock:
            self._loop = loop
        if loop is None:
            for reader in self._readers:
                reader.end()

    def publish(self, topic: str, content: Any) -> None:
        """Publish `content`, valid as JSON, as the newest of `topic`; from any thread."""
        message = event_text(topic, content)
        with self._lock:
            self._newest[topic] = message
            if self._loop is not None and not self._loop.is_closed():
                self._loop.call_soon_threadsafe(self._deliver, topic, message)

    def _deliver(self, topic: str, message: bytes) -> None:
        for reader in self._readers:
            reader.put(topic, message)

    def reader(self) -> PageReader | None:
        """Return a reader with the newest messages, served while it is held; None if MAX_READERS are."""
        if len(self._readers) >= MAX_READERS:
            return None
        with self._lock:
            reader = PageReader(self._newest)
        self._readers.add(reader)
        return reader

    async def messages(self, reader: PageReader, first: Any) -> AsyncIterator[bytes]:
        """Yield `first` on topic "you", then messages as the `reader` takes them, until its end."""
        try:
            yield event_text("you", first)
            while (message := await reader.take()) is not None:
                yield message
        finally:
            self._readers.discard(reader)


def event_text(topic: str, content: Any) -> bytes:
    """Return a server-sent event; JSON has no line breaks, whatever a name contains."""
    return f"event: {topic}\ndata: {json.dumps(content, allow_nan=False)}\n\n".encode()


_PERIOD = 1.0
"""Period of the looks, s."""


class TopicPoller:
    """Publishes contents that have changed; a separate thread looks at them every second."""

    def __init__(self, broadcaster: PageBroadcaster, looks: Mapping[str, Callable[[], Any]]) -> None:
        """`looks` are functions that return the content of a topic; one that raises is called again."""
        self._broadcaster, self._looks, self._ended = broadcaster, looks, Event()
        self._thread = Thread(target=self._work, name="page-poller", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _work(self) -> None:
        shown: dict[str, Any] = {}
        while not self._ended.is_set():
            for topic, look in self._looks.items():
                try:
                    content = look()
                    if topic not in shown or content != shown[topic]:
                        self._broadcaster.publish(topic, content)
                        shown[topic] = content
                except Exception as error:  # no bench, a folder that goes, a session that closes, NaN
                    _log.debug("page: %s: %s", topic, error)
            self._ended.wait(_PERIOD)
