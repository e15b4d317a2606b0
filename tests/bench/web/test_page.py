"""The page of a bench: its data for a browser, and the commands it takes."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator

import pytest

from bench.base.lifecycle import Request, State
from bench.network.command_plane import HEARTBEAT
from bench.web._last_swing import SwingReader
from tests.bench.fake_bench_service import (
    FakeDesk,
    RunningPlane,
    loopback_configuration,
    publishing,
    running_plane,
)
from tests.bench.web.running_page import HURRY, RunningPage, running_page
from tests.waiting import wait_until

NAMES = ("index.html", "page.css", "main.js", "operate.js", "icon.svg")


@pytest.fixture(autouse=True)
def begin(running: RunningPlane) -> Iterator[None]:
    """Start in ESTOP without requests; afterwards wait until no one holds the lease."""
    running.service.state = State.ESTOP
    running.service.requests.clear()
    running.service.stops.clear()
    yield
    wait_until(lambda: running.plane.lease() is None)


@pytest.mark.parametrize("name", NAMES)
def test_static_files_have_strict_headers(page: RunningPage, name: str) -> None:
    answer = page.ask("GET", f"/static/{name}")
    assert answer.status == 200
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert "http" not in policy
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_page_loads_only_local_files_and_is_small(page: RunningPage) -> None:
    index = page.ask("GET", "/").body.decode()
    assert "<script>" not in index
    assert "style=" not in index
    assert not re.findall(r" on[a-z]+=", index)
    waiting, seen = re.findall(r'(?:src|href)="(/static/[^"]+)"', index), {"/"}
    weight = len(index)
    while waiting:
        if (path := waiting.pop()) in seen:
            continue
        seen.add(path)
        answer = page.ask("GET", path)
        assert answer.status == 200, path
        weight += len(answer.body)
        text = answer.body.decode()
        assert not re.findall(r"https?://(?!www\.w3\.org/2000/svg)", text), path
        assert not re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b", text), path
        waiting += [f"/static/{name}" for name in re.findall(r'from "\./([^"]+)"', text)]
    assert weight < 300_000
    assert len(seen) > 8


def test_page_swing_is_read_while_running_and_once_after(monkeypatch: pytest.MonkeyPatch) -> None:
    service, offered = FakeDesk(State.ARMED), list[bool]()
    monkeypatch.setattr(SwingReader, "offer_ring", lambda _, ring, *, running: offered.append(running))
    with running_plane(service, loopback_configuration()) as running, publishing(running):
        with running_page(running.configuration) as page, page.stream() as following:
            for state in (State.ARMED, State.SWINGING, State.READY):
                service.state = state
                while following("state")["state"] != state.name:
                    pass
            following("state")
    assert offered[0]
    assert offered[-1] is False
    assert offered.count(False) == 1


def test_stream_sends_state_role_and_silence_at_once(page: RunningPage, running: RunningPlane) -> None:
    with page.stream() as following:
        assert following("you") == {"role": "operator", "sign_in": False, "bench": "bench1"}
        state = following("state")
        assert state["words"] == "Stopped and latched"
        assert state["cause"]["action"] == "Reset to begin."
        assert state["accepts"] == ["access", "reset", "secure"]
        assert following("link")["silent_s"] < HURRY


def test_stream_sends_change_of_state(page: RunningPage, running: RunningPlane) -> None:
    with page.stream() as following:
        following("state")
        running.service.state = State.READY
        while following("state")["state"] != "READY":
            pass


def test_page_operator_session_sends_commands_until_release(page: RunningPage, running: RunningPlane) -> None:
    ticket = page.take_lease()
    for name in ("reset", "home", "arm", "tee", "swing"):
        answer = page.command(name, ticket)
        assert answer.status == 200, answer.body
    asked = [Request.RESET, Request.HOME, Request.ARM, Request.TEE, Request.SWING]
    assert running.service.requests == asked
    assert page.post("/api/lease", {"action": "renew"}, golfbench_ticket=ticket).content == {"seconds": 15.0}
    released = page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)
    assert released.content == {"seconds": 0.0}
    assert page.command("home", ticket).status == 409


def test_page_refusal_uses_operator_words(page: RunningPage) -> None:
    ticket = page.take_lease()
    answer = page.command("arm", ticket)
    assert answer.status == 409
    assert answer.content["what"] == "Not possible in this state."
    assert answer.content["action"]
    page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)


def test_page_lease_belongs_to_one_tab(page: RunningPage, running: RunningPlane) -> None:
    ticket = page.take_lease("Ann")
    for other in ("", "guessed", ticket[:-1], ticket + "x"):
        assert page.command("reset", other).status == 409
    taken = page.post("/api/lease", {"action": "take", "holder": "Bob"})
    assert taken.status == 409
    assert "Ann" in taken.content["what"]
    assert running.service.requests == []
    page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)


def test_page_stop_needs_no_lease_number_or_valid_body(page: RunningPage, running: RunningPlane) -> None:
    for name, body in (("stop", b"{}"), ("stop", b""), ("estop", b"\xff{[")):
        answer = page.ask("POST", f"/api/stop/{name}", body, page.own())
        assert answer.status == 200, answer.body
    assert [what for what, _ in running.service.stops] == ["stop", "stop", "estop"]


def test_page_stop_overtakes_waiting_command(running: RunningPlane, page: RunningPage) -> None:
    ticket = page.take_lease()
    running.service.free.clear()
    connection = page.connection()
    try:
        headers = page.own() | {"golfbench-ticket": ticket}
        body = f'{{"number": "waiting-1", "seen": {time.monotonic()}}}'
        connection.request("POST", "/api/command/reset", body, headers)
        wait_until(lambda: running.service.requests)
        assert page.post("/api/stop/stop", {}).status == 200
        assert len(running.service.stops) == 1
    finally:
        running.service.free.set()
        connection.getresponse().read()
        connection.close()
    page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)


def test_page_command_repeated_or_stale_is_refused(page: RunningPage, running: RunningPlane) -> None:
    ticket = page.take_lease()
    content = {"number": "the-same-click", "seen": time.monotonic()}
    assert page.post("/api/command/reset", content, golfbench_ticket=ticket).status == 200
    again = page.post("/api/command/reset", content, golfbench_ticket=ticket)
    assert (again.status, again.content["what"]) == (
        409,
        "Command: received twice; expected each click once.",
    )
    for seen in (time.monotonic() - 60.0, time.monotonic() + 60.0):
        assert page.command("home", ticket, seen=seen).status == 409
    assert running.service.requests == [Request.RESET]
    page.post("/api/lease", {"action": "release"}, golfbench_ticket=ticket)


def test_stream_script_shows_silence_within_two_seconds(page: RunningPage) -> None:
    script = page.ask("GET", "/static/stream.js").body.decode()
    silent, look = (float(re.findall(rf"const {name} = ([0-9.]+)", script)[0]) for name in ("SILENT", "LOOK"))
    assert silent + 1e-3 * look + HEARTBEAT <= 2.0  # silence begins after the last state


@pytest.mark.slow
def test_stream_silent_bench_reports_silence() -> None:
    with (
        running_plane(FakeDesk(), loopback_configuration()) as running,
        publishing(running) as speaking,
        running_page(running.configuration) as page,
        page.stream() as following,
    ):
        following("state")
        speaking.clear()
        silences = [following("link")["silent_s"] for _ in range(5)]
        assert max(s for s in silences if s is not None) > 1.5


def test_page_started_before_bench_connects_later() -> None:
    configuration = loopback_configuration()
    with running_page(configuration) as page:
        with page.stream() as following:
            assert following("link") == {"silent_s": None}
        answer = page.post("/api/stop/stop", {})
        assert answer.status == 504
        assert "does not answer" in answer.content["what"]
        with running_plane(FakeDesk(), configuration) as running, publishing(running):
            with page.stream() as following:
                assert following("state")["state"] == "ESTOP"
            assert page.post("/api/stop/stop", {}).status == 200


def test_page_small_answers_are_sent_without_delay(page: RunningPage) -> None:
    """Nagle's algorithm keeps a body until the peer acknowledges the head: 40 ms for each file."""
    connection = page.connection()
    try:
        times = []
        for _ in range(40):
            began = time.monotonic()
            connection.request("GET", "/static/dom.js")
            connection.getresponse().read()
            times.append(time.monotonic() - began)
    finally:
        connection.close()
    assert (
        sorted(times)[5] < 0.03
    )  # of the quickest: processors may be busy; the kernel's delay is in nearly all
