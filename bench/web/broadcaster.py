"""Messages to the readers of the page: the newest of each topic, to a bounded number of readers.

A reader that is too slow loses older messages, never the newest, and costs no more memory than one message a
topic. Nothing waits for it.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from threading import Event, Lock, Thread
from typing import Any

from bench.web.page_access import Receive, Scope, Send

MAX_READERS = 32
"""Max number of open pages."""


class TooManyReaders(Exception):
    """No further page can be served."""


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
        self._readers: set[PageReader] = set()
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

    @contextmanager
    def reader(self) -> Iterator[PageReader]:
        """Yield a reader with the newest messages.

        Raises:
            TooManyReaders: MAX_READERS are served.
        """
        if len(self._readers) >= MAX_READERS:
            raise TooManyReaders
        with self._lock:
            reader = PageReader(self._newest)
        self._readers.add(reader)
        try:
            yield reader
        finally:
            self._readers.discard(reader)


def event_text(topic: str, content: Any) -> bytes:
    """Return a server-sent event; JSON has no line breaks, whatever a name contains."""
    return f"event: {topic}\ndata: {json.dumps(content, allow_nan=False)}\n\n".encode()


_PERIOD = 1.0
"""Period of the looks, s."""

_log = logging.getLogger("golfbench")


class TopicPoller:
    """Publishes contents that have changed; a separate thread looks at them every second."""

    def __init__(self, broadcaster: PageBroadcaster, looks: Mapping[str, Callable[[], Any]]) -> None:
        """`looks` return the content by topic; one that raises is called again."""
        self._broadcaster, self._looks, self._ended = broadcaster, looks, Event()
        self._thread = Thread(target=self._work, name="page-poller", daemon=True)

    def start(self) -> None:
        """Begin to look."""
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


class EventStream:
    """The response to one reader: an ASGI application that sends the newest messages as it takes them."""

    def __init__(self, broadcaster: PageBroadcaster, first: Any) -> None:
        """`first` is the content of the first message, on topic "you"."""
        self._broadcaster, self._first = broadcaster, event_text("you", first)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send until the reader goes or the server ends; the kernel ends one that takes no messages."""
        try:
            with self._broadcaster.reader() as reader:
                await self._serve(reader, receive, send)
        except TooManyReaders:
            await send({"type": "http.response.start", "status": 503, "headers": []})
            await send({"type": "http.response.body", "body": b"Too many open pages: close some."})

    async def _serve(self, reader: PageReader, receive: Receive, send: Send) -> None:
        gone = asyncio.create_task(_watch(receive, reader))
        try:
            headers = [(b"content-type", b"text/event-stream; charset=utf-8")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            message: bytes | None = self._first
            while message is not None:
                await send({"type": "http.response.body", "body": message, "more_body": True})
                message = await reader.take()
            if not gone.done():
                await send({"type": "http.response.body", "body": b""})
        finally:
            gone.cancel()


async def _watch(receive: Receive, reader: PageReader) -> None:
    """End `reader` when its connection ends."""
    while (await receive())["type"] != "http.disconnect":
        pass
    reader.end()
