"""The kept lease: only its user reads it, one command at a time uses it, rubbish is no lease."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.commands.bench.operate import lease_folder, open_lease_file
from bench.network.client import HeldLease

LEASE = HeldLease("Ann", "k" * 22, 30.0, 7)


def test_lease_file_keeps_lease_between_commands(tmp_path: Path) -> None:
    with open_lease_file(tmp_path / "new", "bench1") as file:
        assert file.read() is None
        file.write(LEASE)
    with open_lease_file(tmp_path / "new", "bench1") as file:
        assert file.read() == LEASE
        file.write(None)
        assert file.read() is None
    with open_lease_file(tmp_path / "new", "bench2") as file:
        assert file.read() is None


def test_lease_file_is_readable_only_by_user(tmp_path: Path) -> None:
    with open_lease_file(tmp_path / "new", "bench1"):
        pass
    path = tmp_path / "new" / "lease-bench1.json"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    path.chmod(0o644)
    with pytest.raises(BenchError, match="mode 644"), open_lease_file(path.parent, "bench1"):
        pass


def test_lease_file_symlink_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lease-bench1.json").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="lease-bench1"), open_lease_file(tmp_path, "bench1"):
        pass
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"version": 2}', "\x00" * 5000, '{"version": 1, "key": 3}']
)
def test_lease_file_invalid_content_reads_as_no_lease(text: str, tmp_path: Path) -> None:
    path = tmp_path / "lease-bench1.json"
    path.write_text(text)
    path.chmod(0o600)
    with open_lease_file(tmp_path, "bench1") as file:
        assert file.read() is None
        file.write(LEASE)
        assert file.read() == LEASE


def test_lease_file_second_command_waits_for_first(tmp_path: Path) -> None:
    seen: list[HeldLease | None] = []

    def second() -> None:
        with open_lease_file(tmp_path, "bench1") as file:
            seen.append(file.read())

    thread = threading.Thread(target=second)
    with open_lease_file(tmp_path, "bench1") as file:
        thread.start()
        thread.join(0.1)
        assert seen == []
        file.write(LEASE)
    thread.join()
    assert seen == [LEASE]


def test_lease_folder_follows_environment() -> None:
    home = Path("/home/ann")
    assert lease_folder({"XDG_RUNTIME_DIR": "/run/user/1"}, home) == Path("/run/user/1/golfbench")
    assert lease_folder({"XDG_STATE_HOME": "/state"}, home) == Path("/state/golfbench")
    assert lease_folder({}, home) == Path("/home/ann/.local/state/golfbench")
