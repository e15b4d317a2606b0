"""Who may do what on the page: certificates, tokens, and addresses that are refused."""

from __future__ import annotations

import ssl
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from bench.base.address import free_port
from bench.base.errors import BenchError, Refused
from bench.web import _page_service
from bench.web.page_access import (
    MAX_SESSIONS,
    SESSION,
    PageAccess,
    PageAddress,
    PageRole,
    RequestFilter,
    checked_address,
    read_tokens,
)
from bench.web.page_server import page_application
from tests.bench.certified import Folder
from tests.bench.fake_bench_service import RunningPlane
from tests.bench.web.running_page import RunningPage, running_page

OPERATOR, VIEWER = "o" * 24, "v" * 24


def token_file(folder: Path, text: str, mode: int = 0o600) -> Path:
    file = folder / "tokens"
    file.write_text(text)
    file.chmod(mode)
    return file


def both(folder: Path) -> Path:
    return token_file(folder, f"# who\noperator {OPERATOR}\n\nviewer {VIEWER}\n")


# Addresses -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.0.2.1", "fe80::1"])  # noqa: S104
def test_checked_address_non_loopback_needs_tls(host: str, tmp_path: Path) -> None:
    for tokens in (None, both(tmp_path)):
        with pytest.raises(Refused, match=r"without TLS.*readable on the network"):
            checked_address(PageAddress(host, tokens=tokens))


def test_checked_address_host_name_is_refused() -> None:
    with pytest.raises(BenchError, match="an IP address"):
        checked_address(PageAddress("localhost"))


def test_checked_address_missing_identity_is_refused(tmp_path: Path) -> None:
    folder = Folder(tmp_path / "certificates")
    identity = folder.add("bench1")
    assert "127.0.0.1:8600" in checked_address(PageAddress("0.0.0.0", identity=identity))  # noqa: S104
    with pytest.raises(BenchError, match=r"network\.identity"):
        checked_address(PageAddress(identity=str(tmp_path / "none")))


def test_checked_address_lists_loopback_names() -> None:
    assert checked_address(PageAddress(port=81)) == ("127.0.0.1:81", "[::1]:81", "localhost:81")
    assert "localhost" in checked_address(PageAddress(port=80))
    assert "[::1]:81" in checked_address(PageAddress("::1", 81))


def test_page_server_address_in_use_is_refused(running: RunningPlane, page: RunningPage) -> None:
    with pytest.raises(AssertionError, match="in use"), running_page(running.configuration, page.address):
        pass


# Tokens ----------------------------------------------------------------------------------------------


def test_read_tokens_returns_roles(tmp_path: Path) -> None:
    assert read_tokens(both(tmp_path)) == {OPERATOR: PageRole.OPERATOR, VIEWER: PageRole.VIEWER}


@pytest.mark.parametrize(
    ("text", "mode", "found"),
    [
        (f"operator {OPERATOR}", 0o640, "mode 640"),
        ("operator short", 0o600, "line 1"),
        (f"admin {OPERATOR}", 0o600, "line 1"),
        ("# nothing\n", 0o600, "no token"),
    ],
)
def test_read_tokens_invalid_file_is_refused(tmp_path: Path, text: str, mode: int, found: str) -> None:
    with pytest.raises(BenchError, match=found):
        read_tokens(token_file(tmp_path, text, mode))


def test_read_tokens_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="no such file"):
        read_tokens(tmp_path / "none")


def test_page_access_sessions_expire_and_are_bounded() -> None:
    now = [0.0]
    access = PageAccess(tokens={OPERATOR: PageRole.OPERATOR}, clock=lambda: now[0])
    assert access.role("", "") is None
    assert access.sign_in("x" * 24) is None
    first = access.sign_in(OPERATOR) or ""
    assert access.role("", first) is PageRole.OPERATOR
    now[0] = SESSION
    assert access.role("", first) is None
    sessions = [access.sign_in(OPERATOR) or "" for _ in range(MAX_SESSIONS + 1)]
    assert access.role("", sessions[0]) is None
    assert access.role("", sessions[-1]) is PageRole.OPERATOR


def test_page_access_certificate_name_gives_role() -> None:
    access = PageAccess(["vera"], ["otto"], closed=True)
    assert [access.role(name, "") for name in ("vera", "otto", "nora", "")] == [
        PageRole.VIEWER,
        PageRole.OPERATOR,
        PageRole.STOPPER,
        None,
    ]


def test_page_sign_in_token_opens_session_with_role(
    running: RunningPlane, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_page_service, "_GUESS_TIME", 0.01)
    address = PageAddress(port=free_port(), tokens=both(tmp_path))
    with running_page(running.configuration, address) as page:
        assert page.ask("GET", "/").status == 200
        assert page.ask("GET", "/api/stream").status == 401
        assert page.post("/api/stop/stop", {}).status == 401
        assert page.post("/api/sign-in", {"token": "guessed" * 5}).status == 401
        roles, ticket, session = {}, "", ""
        for token in (VIEWER, OPERATOR):
            answer = page.post("/api/sign-in", {"token": token})
            cookie = answer.headers["set-cookie"]
            assert "HttpOnly" in cookie
            assert "samesite=strict" in cookie.lower()
            session = cookie.partition(";")[0]
            with page.stream(cookie=session) as following:
                roles[token] = following("you")["role"]
            taken = page.post("/api/lease", {"action": "take", "holder": "Ann"}, cookie=session)
            assert taken.status == (403 if token == VIEWER else 200), taken.body
            assert page.post("/api/stop/stop", {}, cookie=session).status == 200
            ticket = taken.content.get("ticket", "")
        assert roles == {VIEWER: "viewer", OPERATOR: "operator"}
        assert page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket).status == 401
        page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket, cookie=session)


# Certificates ----------------------------------------------------------------------------------------


def client_context(folder: Folder, identity: str) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(folder.path / "authority.pem"))
    if identity:
        context.load_cert_chain(f"{identity}.pem", f"{identity}.key")
    return context


def test_page_client_certificate_gives_role(running: RunningPlane, tmp_path: Path) -> None:
    folder = Folder(tmp_path / "certificates")
    stranger = Folder(tmp_path / "strange")
    network = replace(running.configuration.network, viewers=("vera",), operators=("otto",))
    configuration = replace(running.configuration, network=network)
    address = PageAddress(port=free_port(), identity=folder.add("bench1"))
    with running_page(configuration, address) as page:
        roles = {}
        for name in ("vera", "otto", "nora"):
            page.tls = client_context(folder, folder.add(name))
            roles[name] = page.ask("GET", "/api/you").content["role"]
            taken = page.post("/api/lease", {"action": "take", "holder": name})
            assert taken.status == (200 if name == "otto" else 403), taken.body
            if name == "otto":
                ticket = taken.content["ticket"]
                page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)
            if name == "nora":
                assert page.ask("GET", "/api/stream").status == 403
            assert page.post("/api/stop/stop", {}).status == 200
        assert roles == {"vera": "viewer", "otto": "operator", "nora": "stopper"}
        for identity in ("", stranger.add("otto")):
            page.tls = client_context(folder, identity)
            with pytest.raises((ssl.SSLError, ConnectionError)):
                page.ask("GET", "/")


# Every path ------------------------------------------------------------------------------------------

FILLED = {
    "name": "reset",
    "plan": "two-balls",
    "campaign": "x-1",
    "form": "air",
    "commissioning": "x-1",
    "kind": "report",
    "search": "x",
}
OPEN = {"/", "/static/{name}", "/api/you"}
"""Paths without data of the bench."""


def paths() -> dict[str, str]:
    """Return the method of each path of the page."""
    nothing = MagicMock()
    application = page_application(nothing, nothing, nothing, nothing, "http", ())
    assert isinstance(application, RequestFilter)
    routes = application._application.routes  # type: ignore[attr-defined]
    return {route.path: "POST" if route.methods == {"POST"} else "GET" for route in routes}


def test_page_every_path_requires_role(running: RunningPlane, tmp_path: Path) -> None:
    address = PageAddress(port=free_port(), tokens=both(tmp_path))
    with running_page(running.configuration, address) as page:
        cookie = page.post("/api/sign-in", {"token": VIEWER}).headers["set-cookie"].partition(";")[0]
        running.service.requests.clear()
        body = {"number": "number-of-all", "seen": time.monotonic(), "by": "Eve", "holder": "Eve"}
        for path, method in paths().items():
            if path in OPEN | {"/api/sign-in", "/api/stop/{name}", "/api/stream"}:
                continue
            where = path.format(**FILLED)
            if method == "GET":
                own = {"sec-fetch-site": "same-origin"}
                assert page.ask("GET", where, None, own).status == 401, path
                looked = page.ask("GET", where, None, own | {"cookie": cookie}).status
                assert looked == 403 if path == "/viewer" else looked in (200, 404, 409), (path, looked)
            else:
                assert page.post(where, body).status == 401, path
                assert page.post(where, body, cookie=cookie).status == 403, path
        assert running.service.requests == []
        assert running.plane.lease() is None
