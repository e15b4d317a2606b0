"""Requests that are not the page's own: refused, nothing moved, and a stop still gets through."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import NamedTuple

import pytest

from bench.base.lifecycle import State
from bench.web import page_access
from bench.web._bench_link import MAX_READERS
from tests.bench.fake_bench_service import RunningPlane
from tests.bench.web.running_page import HURRY, RunningPage
from tests.bench.web.test_access import FILLED, paths

GOOD = json.dumps({"number": "an-attack-01", "seen": 0.0}).encode()
ARM = "/api/command/arm"
START = "/api/plan/two-balls/start"
PLAN = json.dumps(
    {"number": "an-attack-02", "seen": 0.0, "by": "Eve", "digest": "0" * 16, "units": "si"}
).encode()
SCRIPT = "<script>alert(1)</script>"


class Attack(NamedTuple):
    method: str
    path: str
    headers: dict[str, str | None]
    """Added to the page's own; None: without it."""
    body: bytes
    status: set[int]


ATTACKS = {
    "origin with another port": Attack("POST", ARM, {"origin": "http://127.0.0.1:1"}, GOOD, {403}),
    "origin of another scheme": Attack("POST", ARM, {"origin": "https://127.0.0.1"}, GOOD, {403}),
    "rebound name": Attack(
        "POST", ARM, {"host": "evil.example", "origin": "http://evil.example"}, GOOD, {421}
    ),
    "rebound name reads": Attack("GET", "/api/stream", {"host": "evil.example"}, b"", {421}),
    "rebound name with our port": Attack("GET", "/api/stream", {"host": "evil.example:8600"}, b"", {421}),
    "cross-site fetch": Attack("GET", "/api/stream", {"sec-fetch-site": "cross-site"}, b"", {403}),
    "same site, other origin": Attack("POST", ARM, {"sec-fetch-site": "same-site"}, GOOD, {403}),
    "cross-site frame": Attack(
        "GET",
        "/",
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "iframe"},
        b"",
        {403},
    ),
    "no number": Attack("POST", ARM, {}, b"{}", {400}),
    "a number of another type": Attack("POST", ARM, {}, b'{"number": 1, "seen": 1}', {400}),
    "not a time": Attack("POST", ARM, {}, b'{"number": "12345678", "seen": NaN}', {400}),
    "an infinite time": Attack("POST", ARM, {}, b'{"number": "12345678", "seen": 1e999}', {400}),
    "no ticket": Attack("POST", ARM, {}, GOOD, {409}),
    "a long ticket": Attack("POST", ARM, {"golfbench-ticket": "x" * 8000}, GOOD, {409}),
    "an unknown command": Attack("POST", "/api/command/explode", {}, GOOD, {404}),
    "a command by its Python name": Attack("POST", "/api/command/__class__", {}, GOOD, {404}),
    "another method": Attack("DELETE", "/", {}, b"", {405}),
    "preflight": Attack("OPTIONS", "/api/command/arm", {"origin": "http://evil.example"}, b"", {405}),
    "a lease without a name": Attack("POST", "/api/lease", {}, b'{"action": "take"}', {400}),
    "a lease with control characters": Attack(
        "POST", "/api/lease", {}, b'{"action": "take", "holder": "a\\u0007b"}', {400}
    ),
    "a lease for a long name": Attack(
        "POST", "/api/lease", {}, json.dumps({"action": "take", "holder": "x" * 65}).encode(), {400}
    ),
    "traversal": Attack("GET", "/static/../page_server.py", {}, b"", {404}),
    "traversal, encoded": Attack("GET", "/static/..%2f..%2fpage_server.py", {}, b"", {404}),
    "traversal, encoded twice": Attack("GET", "/static/%252e%252e%252fpage_server.py", {}, b"", {404}),
    "traversal by backslash": Attack("GET", "/static/..\\page_server.py", {}, b"", {404}),
    "an absolute path": Attack("GET", "//etc/passwd", {}, b"", {404}),
    "a path with NUL": Attack("GET", "/static/main.js%00.html", {}, b"", {404}),
    "script in a path": Attack("GET", f"/static/{SCRIPT.replace(' ', '')}", {}, b"", {404}),
    # In one segment: what comes after the refusal resets the connection.
    "a head too long": Attack("GET", "/", {"x": "y" * 20_000}, b"", {400, 431}),
    "an upgrade": Attack("GET", "/nothing", {"connection": "upgrade", "upgrade": "websocket"}, b"", {404}),
    "a start without a digest": Attack("POST", START, {}, GOOD, {400}),
    "a start with an option for a digest": Attack(
        "POST", START, {}, PLAN.replace(b"0" * 16, b"--config=/x"), {400}
    ),
    "a start with other units": Attack("POST", START, {}, PLAN.replace(b'"si"', b'"ells"'), {400}),
    "a start without a name": Attack("POST", START, {}, PLAN.replace(b'"Eve"', b'" "'), {400}),
    "a start from an old screen": Attack("POST", START, {}, PLAN, {409}),
    "an unknown plan": Attack("POST", "/api/plan/none/check", {}, b"{}", {409}),
    "a plan above": Attack("POST", "/api/plan/../check", {}, b"{}", {404, 409}),
    "a plan above, encoded": Attack("POST", "/api/plan/..%2f..%2fsecret/check", {}, b"{}", {404}),
    "a plan by its path": Attack("POST", "/api/plan/%2fetc%2fpasswd/check", {}, b"{}", {404}),
    "a plan called an option": Attack("POST", "/api/plan/--help/check", {}, b"{}", {409}),
    "a plan with NUL": Attack("POST", "/api/plan/two-balls%00/check", {}, b"{}", {409}),
    "script for a plan": Attack(
        "POST", f"/api/plan/{SCRIPT.replace('/', '%2f')}/check", {}, b"{}", {404, 409}
    ),
    "script for a plan, without a slash": Attack(
        "POST", "/api/plan/<img%20onerror=x>/check", {}, b"{}", {409}
    ),
    "the end of an unknown commissioning": Attack(
        "POST", "/api/commissioning/stop", {}, b'{"number": "an-attack-03", "name": "1"}', {409}
    ),
    "a commissioning above": Attack("GET", "/commissioning/..%2f..%2fetc/report", {}, b"", {404}),
    "an unknown form": Attack("POST", "/api/values/explode", {}, PLAN, {404}),
    "a form by its Python name": Attack("POST", "/api/values/__class__", {}, PLAN, {404}),
    "a value that is code": Attack("POST", "/api/values/air", {}, b'{"temperature": "1; reboot"}', {400}),
    "a report of no campaign": Attack("POST", "/api/campaign/..%2f..%2fx/report", {}, PLAN, {404}),
    "a report in other units": Attack(
        "POST", "/api/campaign/x/report", {}, PLAN.replace(b'"si"', b'"--help"'), {400}
    ),
    "a viewer from another site": Attack("GET", "/viewer", {"sec-fetch-site": "cross-site"}, b"", {403}),
    "a viewer from a link elsewhere": Attack(
        "GET",
        "/viewer",
        {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "document"},
        b"",
        {403},
    ),
    "a viewer by its address": Attack("GET", "/viewer", {}, b"", {403}),
    "sign-in without tokens": Attack("POST", "/api/sign-in", {}, b'{"token": "guess"}', {401}),
}


FORGERIES: dict[str, tuple[dict[str, str | None], bytes, set[int]]] = {
    "another site": ({"origin": "http://evil.example"}, b"{}", {403}),
    "no origin": ({"origin": None}, b"{}", {403}),
    "origin null": ({"origin": "null"}, b"{}", {403}),
    "a form's type": ({"content-type": "text/plain"}, b"{}", {415}),
    "no type": ({"content-type": None}, b"{}", {415}),
    "oversized": ({}, b" " * 5000, {413}),
    "oversized by its word": ({"content-length": "9" * 30}, b"{}", {400, 413}),
    "negative length": ({"content-length": "-1"}, b"{}", {400}),
}
"""Requests that change nothing on any path: changed headers, body and status."""
CHANGES = [path for path, method in paths().items() if method == "POST"]


@pytest.fixture(autouse=True)
def nothing_moves(running: RunningPlane, page: RunningPage) -> Iterator[None]:
    running.service.state = State.READY
    running.service.requests.clear()
    running.service.stops.clear()
    yield
    assert running.service.requests == []
    assert running.plane.lease() is None


@pytest.mark.parametrize("name", ATTACKS)
def test_page_forged_request_is_refused(page: RunningPage, running: RunningPlane, name: str) -> None:
    attack = ATTACKS[name]
    given = page.own() if attack.method == "POST" else {}
    headers = {n: v for n, v in (given | attack.headers).items() if v is not None}
    answer = page.ask(attack.method, attack.path, attack.body, headers)
    assert answer.status in attack.status, answer.body
    assert SCRIPT.encode() not in answer.body
    assert "access-control-allow-origin" not in answer.headers
    assert running.service.stops == []


@pytest.mark.parametrize("path", CHANGES)
def test_page_forged_change_is_refused_on_every_path(
    page: RunningPage, running: RunningPlane, path: str
) -> None:
    where = path.format(**FILLED | {"name": "stop" if "stop" in path else "arm"})
    for name, (changed, body, status) in FORGERIES.items():
        headers = {n: v for n, v in (page.own() | changed).items() if v is not None}
        assert page.ask("POST", where, body, headers).status in status, name
    assert page.ask("GET", where).status == 405
    if path != "/api/stop/{name}":  # a stop needs no body
        for malformed in (b"\xff\x00{", b"[1, 2]", b"[" * 4000):
            assert page.ask("POST", where, malformed, page.own()).status == 400
    assert running.service.stops == []


def raw(page: RunningPage, text: bytes) -> socket.socket:
    one = socket.create_connection((page.address.host, page.address.port), timeout=HURRY)
    one.sendall(text)
    return one


def test_page_hundred_slow_readers_leave_stop_available(page: RunningPage, running: RunningPlane) -> None:
    head = f"GET /api/stream HTTP/1.1\r\nHost: {page.host}\r\n\r\n".encode()
    with ExitStack() as stack:
        readers = [stack.enter_context(raw(page, head)) for _ in range(100)]
        statuses = [one.recv(12).split()[1] for one in readers]
        assert statuses.count(b"200") <= MAX_READERS
        assert set(statuses) == {b"200", b"503"}
        assert page.post("/api/stop/stop", {}).status == 200
        assert [what for what, _ in running.service.stops] == ["stop"]
    deadline = time.monotonic() + HURRY
    while page.ask("GET", "/api/you").status == 200:  # their places are free again
        one = raw(page, head)
        status = one.recv(12).split()[1]
        one.close()
        if status == b"200":
            return
        assert time.monotonic() < deadline
        time.sleep(0.1)


def test_request_filter_unfinished_request_is_cut_off(
    page: RunningPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_access, "REQUEST_TIME", 0.2)
    head = "".join(f"{name}: {value}\r\n" for name, value in page.own().items())
    body = f"POST /api/command/arm HTTP/1.1\r\nHost: {page.host}\r\n{head}Content-Length: 100\r\n\r\n{{"
    for text in ("", "GET / HTTP/1.1\r\nHost: ", body):
        with raw(page, text.encode()) as one:
            try:
                assert one.recv(100) == b""
            except ConnectionResetError:
                pass
    with raw(page, f"GET / HTTP/1.1\r\nHost: {page.host}\r\n\r\n{body}".encode()) as one:
        try:
            while one.recv(65536):
                pass
        except ConnectionResetError:
            pass


def test_request_filter_oversized_chunked_body_is_refused(page: RunningPage) -> None:
    head = "".join(f"{name}: {value}\r\n" for name, value in page.own().items())
    text = f"POST /api/command/arm HTTP/1.1\r\nHost: {page.host}\r\n{head}Transfer-Encoding: chunked\r\n\r\n"
    with raw(page, text.encode() + (b"1000\r\n" + b" " * 0x1000 + b"\r\n") * 2) as one:
        assert one.recv(12).split()[1] == b"413"


def test_event_text_line_breaks_make_no_extra_event(page: RunningPage) -> None:
    from bench.web._bench_link import event_text

    text = event_text("state", {"club": "x\n\nevent: you\ndata: {}\n\n"}).decode()
    assert text.count("\n") == 3
