"""Server-sent events to one reader: the newest messages as fast as it takes them."""

from __future__ import annotations

import asyncio
from typing import Any

from bench.page.broadcaster import PageBroadcaster, PageReader, TooManyReaders, event_text
from bench.page.request_filter import Receive, Scope, Send

SEND_TIME = 10.0
"""Max time for a reader to take a message, s; then its connection ends."""


class EventStream:
    """The response to one reader: an ASGI application."""

    def __init__(self, broadcaster: PageBroadcaster, first: Any) -> None:
        """`first` is the content of the first message, on topic "you"."""
        self._broadcaster, self._first = broadcaster, event_text("you", first)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send until the reader goes, stops taking messages, or the server ends."""
        try:
            with self._broadcaster.reader() as reader:
                await self._serve(reader, receive, send)
        except TooManyReaders:
            await send({"type": "http.response.start", "status": 503, "headers": []})
            await send({"type": "http.response.body", "body": b"Too many open pages: close some."})
        except TimeoutError:
            scope.get("state", {}).get("abort", lambda: None)()

    async def _serve(self, reader: PageReader, receive: Receive, send: Send) -> None:
        gone = asyncio.create_task(_watch(receive, reader))
        try:
            headers = [(b"content-type", b"text/event-stream; charset=utf-8")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            message: bytes | None = self._first
            while message is not None:
                async with asyncio.timeout(SEND_TIME):
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
