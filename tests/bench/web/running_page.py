"""The page as `golfbench page` serves it, in a thread of the test, and a client for arbitrary requests."""

from __future__ import annotations

import http.client
import json
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from bench.base.address import free_port
from bench.config import Configuration
from bench.web.page_access import PageAddress
from bench.web.page_server import serve_page

HURRY = 30.0


class PageAnswer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def content(self) -> Any:
        return json.loads(self.body)


class RunningPage:
    def __init__(self, address: PageAddress, url: str) -> None:
        self.address, self.url = address, url
        self.host = f"{address.host}:{address.port}"
        self.tls: ssl.SSLContext | None = None
        self.numbers = 0

    def connection(self) -> http.client.HTTPConnection:
        if self.tls is None:
            return http.client.HTTPConnection(self.address.host, self.address.port, timeout=HURRY)
        return http.client.HTTPSConnection(
            self.address.host, self.address.port, timeout=HURRY, context=self.tls
        )

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> PageAnswer:
        connection = self.connection()
        try:
            connection.connect()
            # Head and body together: a body that arrives after a refusal of the head resets the connection.
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 1)
            connection.request(method, path, body, dict(headers or {}))
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CORK, 0)
            response = connection.getresponse()
            found = {name.lower(): value for name, value in response.getheaders()}
            return PageAnswer(response.status, found, response.read())
        finally:
            connection.close()

    def own(self) -> dict[str, str]:
        """Return the headers that the page's own script sends."""
        return {"content-type": "application/json", "origin": self.url.rstrip("/")}

    def post(self, path: str, content: Any, **headers: str) -> PageAnswer:
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        return self.ask("POST", path, json.dumps(content).encode(), {**self.own(), **given})

    def command(self, name: str, ticket: str = "", seen: float | None = None, **headers: str) -> PageAnswer:
        self.numbers += 1
        at = time.monotonic() if seen is None else seen
        content = {"number": f"number-{self.numbers}", "seen": at}
        return self.post(f"/api/command/{name}", content, golfbench_ticket=ticket, **headers)

    def take_lease(self, holder: str = "Ann") -> str:
        answer = self.post("/api/lease", {"action": "take", "holder": holder})
        assert answer.status == 200, answer.body
        return str(answer.content["ticket"])

    @contextmanager
    def stream(self, **headers: str) -> Iterator[Callable[[str], Any]]:
        """Yield a function that waits for the next message of a topic and returns its content."""
        connection = self.connection()
        connection.request("GET", "/api/stream", headers=headers)
        response = connection.getresponse()
        assert response.status == 200, response.read()

        def following(topic: str) -> Any:
            deadline = time.monotonic() + HURRY
            while time.monotonic() < deadline:
                line = response.readline().decode().strip()
                if line == f"event: {topic}":
                    return json.loads(response.readline().decode().removeprefix("data: "))
            raise AssertionError(f"no message on {topic}")

        try:
            yield following
        finally:
            connection.close()
            response.close()


@contextmanager
def running_page(
    configuration: Configuration,
    address: PageAddress | None = None,
    golfbench: Sequence[str] = (sys.executable, "-c", "raise SystemExit(3)"),
) -> Iterator[RunningPage]:
    """Run the page; `golfbench` is its command line, by default one that refuses everything."""
    address = address or PageAddress(port=free_port())
    listening, found, failed = threading.Event(), [], []

    def ready(url: str, end: Callable[[], None]) -> None:
        found.append((url, end))
        listening.set()

    def serve() -> None:
        try:
            serve_page(configuration, address, golfbench, ready)
        except BaseException as error:
            failed.append(error)
            listening.set()

    thread = threading.Thread(target=serve, name="page")
    thread.start()
    try:
        assert listening.wait(HURRY), "the page does not listen"
        assert not failed, failed
        yield RunningPage(address, found[0][0])
    finally:
        for _, end in found:
            end()
        thread.join(HURRY)
        assert not thread.is_alive(), "the page does not end"
