from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.base.errors import ExitCode
from bench.supervisor.child_process import (
    FOR_PARENT,
    Child,
    Condition,
    HeartbeatSender,
    ManagedProcess,
    NotStarted,
)

# Child -----------------------------------------------------------------------------------------------

pytestmark = pytest.mark.live

TOLD = """
import sys, time
from bench.supervisor.child_process import read_plan, send_event
plan = read_plan()
"""

Start = Callable[..., Child]


@dataclass(frozen=True)
class Plan:
    """Data sent to the child; larger than the capacity of a pipe."""

    data: bytes = bytes(1 << 20)


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Return a function that starts a child which runs `body` after it has read its plan."""
    monkeypatch.syspath_prepend(str(tmp_path))
    children: list[Child] = []

    def start(body: str, plan: object = "plan", *, before: str = "") -> Child:
        name = f"child_{len(children)}"
        (tmp_path / f"{name}.py").write_text(before + TOLD + body)
        children.append(Child.start("child", name, plan))
        return children[-1]

    yield start
    for child in children:
        child.kill()


def test_child_start_receives_plan_and_reports_ready(start: Start) -> None:
    child = start("send_event('ready', plan=plan); sys.stdin.read(); time.sleep(60)", {"rate": 1000})
    assert child.wait_until_ready(30.0)["plan"] == {"rate": 1000}
    assert child.alive
    assert child.ending == ""
    child.end(10.0)
    assert child.ending == "was killed by SIGTERM"


def test_child_start_slow_reader_returns_at_once(start: Start) -> None:
    begin = time.monotonic()
    child = start(
        "send_event('ready', size=len(plan))", bytes(1 << 22), before="import time; time.sleep(3)\n"
    )
    assert time.monotonic() - begin < 2.0
    assert child.wait_until_ready(30.0)["size"] == 1 << 22


def test_child_output_without_event_is_ignored(start: Start) -> None:
    body = "print('warning'); print('[1]'); print('{}', flush=True); "
    body += "send_event('ready'); send_event('more', a=1)"
    child = start(body)
    child.wait_until_ready(30.0)
    child.process.wait(30.0)
    assert child.take_events() == [{"event": "more", "a": 1}]
    assert child.take_events() == []


def test_child_failed_event_raises_with_exit_code(start: Start) -> None:
    child = start("send_event('failed', location='p', found='f', expected='e', action='c', exit_code=2)")
    with pytest.raises(NotStarted, match=r"p: found f, expected e. c") as caught:
        child.wait_until_ready(30.0)
    assert caught.value.exit_code is ExitCode(2)


@pytest.mark.parametrize(
    ("body", "ending"),
    [("sys.exit(3)", "ended with exit code 3"), ("send_event('', a=1); 1 / 0", "exit code 1")],
)
def test_child_exit_before_ready_raises_not_started(start: Start, body: str, ending: str) -> None:
    with pytest.raises(NotStarted, match=ending):
        start(body).wait_until_ready(30.0)


def test_child_not_ready_raises_after_timeout(start: Start) -> None:
    with pytest.raises(NotStarted, match=r"not ready after 0\.3 s"):
        start("time.sleep(60)").wait_until_ready(0.3)


def test_child_compiling_event_restarts_ready_timeout(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    body = "for n in range(8): send_event('compiling', text=f'{n} functions'); time.sleep(0.5)\n"
    start(body + "send_event('ready'); time.sleep(60)", before="# nothing\n").wait_until_ready(3.0)
    assert "7 functions" in capsys.readouterr().err


def test_child_ignoring_sigterm_is_killed(start: Start) -> None:
    child = start(
        "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); send_event('ready'); time.sleep(60)"
    )
    child.wait_until_ready(30.0)
    child.end(0.2)
    assert child.ending == "was killed by SIGKILL"


def test_child_stopped_by_sigstop_counts_as_alive(start: Start) -> None:
    child = start("send_event('ready'); time.sleep(60)")
    child.wait_until_ready(30.0)
    child.process.send_signal(signal.SIGSTOP)
    assert child.alive
    child.kill()
    assert not child.alive


def await_import(child: Child) -> None:
    assert child.process.stdout is not None
    assert select.select([child.process.stdout], [], [], 10.0)[0]


def test_child_signals_for_parent_during_import_are_ignored(start: Start) -> None:
    slow = "import os, time\nos.write(1, b'importing\\n')\ntime.sleep(0.5)\n"
    listen = "from bench.supervisor.child_process import Parent\nParent().listen()\nsend_event('ready')\n"
    child = start(listen + "time.sleep(60)", before=slow)
    await_import(child)
    for number in FOR_PARENT:
        os.kill(child.pid, number)
    child.wait_until_ready(30.0)
    os.kill(child.pid, signal.SIGINT)
    time.sleep(0.1)
    assert child.alive


def test_child_sigterm_during_import_terminates_at_once(start: Start) -> None:
    child = start("", before="import os, time\nos.write(1, b'importing\\n')\ntime.sleep(60)\n")
    await_import(child)
    child.end(10.0)
    assert child.ending == "was killed by SIGTERM"


def test_child_start_keeps_parent_signal_mask(start: Start) -> None:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    start("")
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


# ManagedProcess --------------------------------------------------------------------------------------


class Nursery:
    """Starts children that do nothing, and beats their heart for them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(str(folder))
        (folder / "sleeper.py").write_text("import time; time.sleep(60)")
        self.folder = folder
        self.children: list[Child] = []

    def start(self) -> Child:
        self.children.append(Child.start("sleeper", "sleeper", None))
        return self.children[-1]


@pytest.fixture
def nursery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Nursery]:
    made = Nursery(tmp_path, monkeypatch)
    yield made
    for child in made.children:
        child.kill()


@pytest.fixture
def supporter(nursery: Nursery) -> Iterator[ManagedProcess]:
    made = ManagedProcess("sleeper", nursery.folder, nursery.start)
    yield made
    for child in nursery.children:
        child.kill()
    made.end()


@pytest.fixture
def beat(supporter: ManagedProcess, nursery: Nursery) -> Iterator[Callable[[float, Condition], None]]:
    heart = HeartbeatSender(nursery.folder, "sleeper")
    yield heart.beat
    heart.close()


def is_ready(supporter: ManagedProcess) -> bool:
    return supporter.ready


def is_starting(supporter: ManagedProcess) -> bool:
    return supporter.starting


Beat = Callable[[float, Condition], None]


def test_managed_process_follows_heartbeat_condition(supporter: ManagedProcess, beat: Beat) -> None:
    supporter.turn(0.0)
    assert not is_ready(supporter)
    assert supporter.note == "starting"
    assert is_starting(supporter)
    beat(0.1, Condition.WORKING)
    supporter.turn(0.1)
    assert is_ready(supporter)
    assert not is_starting(supporter)
    beat(0.2, Condition.FAULT)
    supporter.turn(0.2)
    assert supporter.note == "fault"


def test_managed_process_silent_is_reported_and_replaced(
    supporter: ManagedProcess, beat: Beat, nursery: Nursery
) -> None:
    supporter.turn(0.0)
    beat(0.0, Condition.WORKING)
    supporter.turn(0.1)
    supporter.turn(4.0)
    assert is_ready(supporter)
    supporter.turn(6.0)
    assert supporter.note.startswith("silent for 5.9 s")
    assert nursery.children[0].alive
    supporter.turn(12.5)
    supporter.turn(12.6)
    supporter.turn(14.0)
    assert [child.alive for child in nursery.children] == [False, True]


def test_managed_process_dead_restarts_after_pause(
    supporter: ManagedProcess, beat: Beat, nursery: Nursery
) -> None:
    supporter.turn(0.0)
    beat(0.0, Condition.WORKING)
    supporter.turn(0.1)
    nursery.children[0].process.kill()
    nursery.children[0].process.wait()
    supporter.turn(0.2)
    assert supporter.note == "dead, restarting"
    supporter.turn(0.5)
    assert len(nursery.children) == 1
    supporter.turn(1.5)
    assert len(nursery.children) == 2
    assert supporter.note == "starting"
    beat(1.6, Condition.WORKING)
    supporter.turn(1.6)
    assert is_ready(supporter)


def test_managed_process_stop_restarting_starts_no_child(supporter: ManagedProcess, nursery: Nursery) -> None:
    supporter.turn(0.0)
    supporter.stop_restarting()
    nursery.children[0].process.kill()
    nursery.children[0].process.wait()
    for now in (1.0, 2.0, 3.0):
        supporter.turn(now)
    assert len(nursery.children) == 1


def test_managed_process_end_returns_promptly(supporter: ManagedProcess) -> None:
    supporter.turn(0.0)
    begin = time.monotonic()
    supporter.end()
    assert time.monotonic() - begin < 10.0
