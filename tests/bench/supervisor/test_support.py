from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bench.supervisor.child_process import Child, Condition, HeartbeatSender, ManagedProcess

pytestmark = pytest.mark.live

SLEEP = "import time; time.sleep(60)"


class Nursery:
    """Starts children that do nothing, and beats their heart for them."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.syspath_prepend(str(folder))
        (folder / "sleeper.py").write_text(SLEEP)
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
