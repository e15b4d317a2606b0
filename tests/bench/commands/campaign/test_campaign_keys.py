"""The key that marks a shot: comments are typed during the series, and none is lost."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bench.base.errors import ExitCode, Refused
from bench.campaign.plan.plan_file import load_plan
from bench.campaign.run.runner_control import new_entry
from bench.commands.campaign.campaign_run import _local_store, _marker
from bench.commands.campaign.campaign_terminal import HINT, CampaignBar, MarkLine, mark_keys
from bench.config import database_url, load_configuration
from bench.store.campaigns import CampaignStore
from bench.store.database import open_database
from bench.store.rows import MAX_COMMENT_LENGTH, CampaignState, ShotNote
from tests.waiting import wait_until

NOW = datetime(2026, 11, 23, 12, 0, tzinfo=UTC)


def note(shot: int, text: str) -> ShotNote:
    return ShotNote(shot, NOW, "ann", text)


@pytest.mark.parametrize(
    ("keys", "found"),
    [
        ("ma gust\r", [note(7, "a gust")]),
        ("m\n", [note(7, "")]),
        ("Mgusr\x7ft\n", [note(7, "gust")]),
        ("mwrong\x15low spin\n", [note(7, "low spin")]),
        ("mno\x1b", []),
        ("mnach\x1b[D\x1bOAher\n", [note(7, "nachher")]),
        ("mKühler 打\tx\n", [note(7, "Kühler 打x")]),
        ("q\n x", []),
        ("mone\nmtwo\n", [note(7, "one"), note(7, "two")]),
        (f"m{'x' * 999}\n", [note(7, "x" * MAX_COMMENT_LENGTH)]),
    ],
)
def test_mark_line_keys_edit_comment(keys: str, found: list[ShotNote]) -> None:
    assert MarkLine("ann").feed(keys, 7, NOW) == found
    line = MarkLine("ann")
    assert [
        mark for key in (keys if "\x1b[" not in keys else [keys]) for mark in line.feed(key, 7, NOW)
    ] == found


def test_mark_line_keeps_shot_of_key_press() -> None:
    line = MarkLine("ann")
    assert line.feed("m", 0, NOW) == []
    assert line.shown == HINT
    line.feed("m", 7, NOW)
    line.feed("a gu", 8, NOW)
    assert line.shown.startswith("mark shot 7 (")
    assert line.feed("st\n", 9, NOW) == [note(7, "a gust")]
    assert line.finish() == []


@dataclass
class Desk:
    """A terminal, a bar on it, and the shots that are stored."""

    master: int
    terminal: int
    out: StringIO = field(default_factory=StringIO)
    progress: dict[str, Any] = field(default_factory=lambda: {"last_shot": None})
    stored: int = 0
    notes: list[ShotNote] = field(default_factory=list)

    def store(self, mark: ShotNote) -> None:
        if mark.shot > self.stored:
            raise Refused("campaign x", f"no shot {mark.shot}", "another", "Name another one.")
        self.notes.append(mark)

    def echoes(self) -> bool:
        return bool(termios.tcgetattr(self.terminal)[3] & termios.ECHO)


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    master, slave = pty.openpty()
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        yield Desk(master, slave)
    os.close(master)


@contextmanager
def keys_of(service: Desk, *, terminal: bool = True) -> Iterator[Any]:
    console = Console(file=service.out, force_terminal=terminal)
    bar = CampaignBar(console=console, disable=not terminal, auto_refresh=False)
    with mark_keys(bar, "ann", lambda: service.progress, service.store) as keys:
        yield keys


def test_mark_keys_terminal_without_echo_restores_echo(service: Desk) -> None:
    left = termios.tcgetattr(service.terminal)
    left[3] &= ~(termios.ICANON | termios.ECHO)
    termios.tcsetattr(service.terminal, termios.TCSANOW, left)
    with keys_of(service) as keys:
        wait_until(lambda: keys._before is not None)
        assert not service.echoes()
        keys.pause()
        assert service.echoes(), "a prompt reads lines"
        keys.resume()
        wait_until(lambda: not service.echoes())
    assert service.echoes()
    assert termios.tcgetattr(service.terminal)[3] & termios.ICANON


def test_mark_keys_store_mark_after_shot_is_stored(service: Desk) -> None:
    with keys_of(service) as keys:
        wait_until(lambda: not service.echoes())
        service.progress["last_shot"] = {"shot": 3}
        os.write(service.master, b"ma gust\r")
        wait_until(lambda: service.out.getvalue() or not service.notes)
        assert service.notes == []
        service.stored = 3
        wait_until(lambda: service.notes)
        keys.pause()
        assert service.echoes(), "a prompt reads lines"
        keys.mark("typed at a prompt")
        keys.resume()
        wait_until(lambda: len(service.notes) == 2 and not service.echoes())
        os.write(service.master, b"mhalf of i")
        wait_until(lambda: "half of i" in keys._line.shown)
    assert service.echoes()
    assert [(mark.shot, mark.by, mark.text) for mark in service.notes] == [
        (3, "ann", "a gust"),
        (3, "ann", "typed at a prompt"),
        (3, "ann", "half of i"),
    ]
    assert "shot 3 marked: a gust" in service.out.getvalue()


def test_mark_keys_unknown_shot_reports_mark_not_stored(service: Desk) -> None:
    service.progress["last_shot"] = {"shot": 9}
    with keys_of(service) as keys:
        keys.mark("lost")
    assert "The mark of shot 9 was not stored: lost" in service.out.getvalue()


def test_mark_keys_without_terminal_are_disabled(service: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    with keys_of(service, terminal=False) as keys:
        assert keys is None
        assert service.echoes()
    with open(os.devnull) as nothing:
        monkeypatch.setattr("sys.stdin", nothing)
        with keys_of(service) as keys:
            assert keys is None


def test_local_store_without_campaign_database_returns_none(tmp_path: Path) -> None:
    shipped = load_configuration(Path("shipped"))
    configuration = replace(shipped, bench=replace(shipped.bench, data_dir=tmp_path / "data"))
    with ExitStack() as stack:
        assert _local_store(stack, configuration.bench, "two-1") is None
        assert not (tmp_path / "data").exists(), "a machine that only watches gets no database"
        entry = new_entry(load_plan(Path("two-balls"), shipped), shipped, NOW, simulated=True)
        with open_database(database_url("", tmp_path / "data")) as engine:
            CampaignStore(engine).begin(entry)
        assert _local_store(stack, configuration.bench, "two-1") is None
        store = _local_store(stack, configuration.bench, entry.id)
        assert store is not None
        with pytest.raises(Refused, match="a shot, once there is one"):
            _marker(store, entry.id)(note(1, "too early"))


PLAN = """
[campaign]
name = "keys"
[design]
balls = ["tour", "range"]
blocks = 400
[warm_up]
at_most = 0
[ball_handling]
hits = 999
[gate]
reference = "planned"
"""


def start(folder: Path, terminal: int) -> subprocess.Popen[bytes]:
    (folder / "bench.toml").write_text(f'base = "shipped"\n[bench]\ndata_dir = "{folder / "data"}"\n')
    (folder / "plan.toml").write_text(PLAN)
    command = [sys.executable, "-m", "bench", "--config", str(folder / "bench.toml"), "campaign"]
    return subprocess.Popen(
        [*command, "run", str(folder / "plan.toml"), "--sim"],
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
    )


@pytest.mark.live
@pytest.mark.paced
@pytest.mark.timeout(300)
def test_campaign_run_stores_typed_mark_and_sigterm_stops_campaign(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    process = start(tmp_path, slave)
    try:
        with open_database(database_url("", tmp_path / "data")) as engine:
            store = CampaignStore(engine)
            deadline = time.monotonic() + 200.0
            while not (found := store.entries()) or not found[0][2]:
                assert time.monotonic() < deadline
                assert process.poll() is None, _drain(master)
                time.sleep(0.05)
            campaign = found[0][0].id
            os.write(master, b"ma gust\r")
            while not store.notes(campaign):
                assert time.monotonic() < deadline
                _drain(master)
                time.sleep(0.05)
            process.send_signal(signal.SIGTERM)
            while process.poll() is None:
                _drain(master)
                time.sleep(0.05)
            assert process.returncode == ExitCode.TERMINATED
            ((mark,), standing) = store.notes(campaign), store.standing(campaign)
            assert mark.text == "a gust"
            assert standing.state is CampaignState.STOPPED
            assert "SIGTERM" in standing.reason
            assert [event.kind for event in store.events(campaign)] == ["stopped"]
            assert termios.tcgetattr(slave)[3] & termios.ECHO
    finally:
        process.kill()
        process.wait()
        os.close(master)
        os.close(slave)


def _drain(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65536)
    except BlockingIOError:
        return b""
