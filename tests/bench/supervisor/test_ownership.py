from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from bench.base.errors import BenchError, Refused
from bench.supervisor import ownership
from bench.supervisor.ownership import MEMORY, NoBenchFolder, adopt, bench_folder, take_bench

DAEMON = """
import sys
from pathlib import Path
from bench.supervisor.ownership import take_bench
bench = take_bench("a", Path(sys.argv[1]))
(bench.folder / "ring").write_text("shared")
print("taken", flush=True)
sys.stdin.read()
bench.leave()
"""

SUPERVISOR = """
import subprocess, sys
from pathlib import Path
from bench.supervisor.ownership import take_bench
bench = take_bench("a", Path(sys.argv[1]))
(bench.folder / "ring").write_text("shared")
program = [sys.executable, "-c", sys.argv[2], str(bench.descriptor)]
loop = subprocess.Popen(program, pass_fds=[bench.descriptor])
if "note" in sys.argv:
    bench.note_loop(loop.pid)
print(loop.pid, flush=True)
sys.stdin.read()
bench.leave()
loop.wait()
"""

LOOP = """
import sys
from bench.supervisor.ownership import adopt
bench = adopt(int(sys.argv[1]))
print("adopted", flush=True)
sys.stdin.read()
bench.leave()
"""

Start = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    return tmp_path


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Return a function that starts a Python program with the folder and further arguments."""
    started: list[subprocess.Popen[str]] = []

    def start(program: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", program, str(tmp_path), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        for stream in (process.stdin, process.stdout):
            if stream:
                stream.close()


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def end(process: subprocess.Popen[str]) -> None:
    """Let the process and all who share its standard input end as they should."""
    assert process.stdin is not None
    process.stdin.close()
    process.wait(10)


def wait_for_death(pid: int) -> None:
    """Wait until a killed process holds nothing any more, buried or not."""
    deadline = time.monotonic() + 10
    with suppress(FileNotFoundError, ProcessLookupError):
        while Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < deadline
            time.sleep(0.005)


def free(memory: Path) -> bool:
    """Take the bench, release it and return whether nothing is left behind."""
    with take_bench("a", memory) as bench:
        assert os.listdir(bench.folder) == ["owner"], "files of the dead one are gone"
    return not bench_folder("a", memory).exists()


# The folder ------------------------------------------------------------------------------------------


def test_bench_folder_ignores_runtime_directory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/x")  # a service's own, where nobody else would look
    assert bench_folder("a") == MEMORY / "golfbench-a" == Path("/dev/shm/golfbench-a")  # noqa: S108


@pytest.mark.parametrize("bench_id", ["", "..", "a/b", "a\0", "a" * 64, "a\n"])
def test_take_bench_invalid_id_is_refused(bench_id: str, memory: Path) -> None:
    with pytest.raises(BenchError, match=r"bench\.id"):
        take_bench(bench_id, memory)


def test_take_bench_folder_is_private_and_removed_on_leave(memory: Path) -> None:
    with take_bench("a", memory) as bench:
        assert bench.folder == bench_folder("a", memory)
        assert bench.folder.stat().st_mode & 0o777 == 0o700
        assert (bench.folder / "owner").stat().st_mode & 0o777 == 0o600
        assert not os.get_inheritable(bench.descriptor)
        (bench.folder / "ring").write_text("shared")
    assert not bench.folder.exists()
    bench.leave()


def test_take_bench_two_ids_use_separate_folders(memory: Path) -> None:
    with take_bench("a", memory) as one, take_bench("b", memory) as other:
        assert one.folder != other.folder


def test_take_bench_unusable_parent_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NoBenchFolder, match="no parent folder"):
        take_bench("a", tmp_path / "missing")
    (tmp_path / "file").touch()
    with pytest.raises(NoBenchFolder, match="Not a directory"):
        take_bench("a", tmp_path / "file")


# Not ours --------------------------------------------------------------------------------------------


def test_take_bench_symbolic_link_is_refused(memory: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    (elsewhere / "precious").touch()
    bench_folder("a", memory).symlink_to(elsewhere)
    with pytest.raises(Refused, match="golfbench-a: found a symbolic link"):
        take_bench("a", memory)
    assert os.listdir(elsewhere) == ["precious"]


def test_take_bench_file_or_folder_open_to_others_is_refused(memory: Path) -> None:
    bench_folder("a", memory).touch()
    with pytest.raises(Refused, match="golfbench-a: found a file"):
        take_bench("a", memory)
    bench_folder("a", memory).unlink()
    bench_folder("a", memory).mkdir()
    bench_folder("a", memory).chmod(0o770)
    with pytest.raises(Refused, match=r"open to others \(mode 0770\)"):
        take_bench("a", memory)


def test_take_bench_folder_of_other_user_is_refused(memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench_folder("a", memory).mkdir(mode=0o700)
    owner, stranger = os.geteuid(), 54321
    monkeypatch.setattr(os, "geteuid", lambda: stranger)
    with pytest.raises(
        Refused, match=rf"found a folder of user .*uid {owner}\)?, expected .* uid {stranger}"
    ):
        take_bench("a", memory)


def test_take_bench_owner_symbolic_link_is_not_followed(memory: Path, tmp_path: Path) -> None:
    bench_folder("a", memory).mkdir(mode=0o700)
    (tmp_path / "precious").write_text("text")
    (bench_folder("a", memory) / "owner").symlink_to(tmp_path / "precious")
    with pytest.raises(NoBenchFolder, match="symbolic links"):
        take_bench("a", memory)
    assert (tmp_path / "precious").read_text() == "text"


# One at a time ---------------------------------------------------------------------------------------


@pytest.mark.live
def test_take_bench_second_daemon_is_refused_with_first_pid(start: Start, memory: Path) -> None:
    daemon = start(DAEMON)
    assert line(daemon) == "taken"
    with pytest.raises(Refused, match=f"bench a: found it run by process {daemon.pid}.*kill {daemon.pid}"):
        take_bench("a", memory)
    assert (bench_folder("a", memory) / "ring").exists(), "the first one's files stay"
    end(daemon)
    assert not bench_folder("a", memory).exists()
    assert free(memory)


@pytest.mark.live
def test_take_bench_after_killed_daemon_succeeds(start: Start, memory: Path) -> None:
    daemon = start(DAEMON)
    assert line(daemon) == "taken"
    daemon.kill()
    daemon.wait()
    (bench_folder("a", memory) / "deeper").mkdir()
    assert free(memory)


@pytest.mark.live
def test_take_bench_zombie_daemon_counts_as_dead(start: Start, memory: Path) -> None:
    supervisor = start(SUPERVISOR, LOOP)
    loop = int(line(supervisor))
    assert line(supervisor) == "adopted"
    supervisor.kill()
    os.waitid(os.P_PID, supervisor.pid, os.WEXITED | os.WNOWAIT)
    with pytest.raises(
        Refused, match=rf"daemon \(process {supervisor.pid}\) dead, but its loop \(a process\)"
    ):
        take_bench("a", memory)
    os.kill(loop, signal.SIGKILL)


@pytest.mark.parametrize("content", [b"", b"garbage", b"[]", b"[1, 2]", b'["a", [1, 2], 3]', b"\xff" * 600])
def test_take_bench_locked_unreadable_owner_is_refused(content: bytes, memory: Path) -> None:
    with take_bench("a", memory) as bench:
        (bench.folder / "owner").write_bytes(content)
        with pytest.raises(Refused, match="owner locked by an unnamed process"):
            take_bench("a", memory)


def test_take_bench_garbage_from_dead_owner_succeeds(memory: Path) -> None:
    bench_folder("a", memory).mkdir(mode=0o700)
    (bench_folder("a", memory) / "owner").write_bytes(b"garbage")
    assert free(memory)


# Supervisor and loop ---------------------------------------------------------------------------------


@pytest.mark.live
def test_ownership_supervisor_killed_loop_keeps_bench(start: Start, memory: Path) -> None:
    supervisor = start(SUPERVISOR, LOOP, "note")
    loop = int(line(supervisor))
    assert line(supervisor) == "adopted"
    with pytest.raises(Refused, match=f"run by process {supervisor.pid}"):
        take_bench("a", memory)
    supervisor.kill()
    supervisor.wait()
    with pytest.raises(
        Refused, match=rf"daemon \(process {supervisor.pid}\) dead, but its loop \(process {loop}\) .*kill -9"
    ):
        take_bench("a", memory)
    assert supervisor.stdin is not None
    supervisor.stdin.close()  # shared with the loop, which now ends
    wait_for_death(loop)
    assert not bench_folder("a", memory).exists(), "the last to leave removes the folder"


@pytest.mark.live
def test_ownership_supervisor_and_loop_killed_frees_bench(start: Start, memory: Path) -> None:
    supervisor = start(SUPERVISOR, LOOP, "note")
    loop = int(line(supervisor))
    assert line(supervisor) == "adopted"
    for pid in (supervisor.pid, loop):
        os.kill(pid, signal.SIGKILL)
    supervisor.wait()
    wait_for_death(loop)
    assert free(memory)


@pytest.mark.live
def test_ownership_loop_killed_supervisor_keeps_bench(start: Start, memory: Path) -> None:
    supervisor = start(SUPERVISOR, LOOP, "note")
    loop = int(line(supervisor))
    assert line(supervisor) == "adopted"
    os.kill(loop, signal.SIGKILL)
    wait_for_death(loop)
    with pytest.raises(Refused, match=f"run by process {supervisor.pid}"):
        take_bench("a", memory)
    end(supervisor)
    assert not bench_folder("a", memory).exists()


@pytest.mark.live
def test_ownership_leave_in_any_order_removes_folder(start: Start, memory: Path) -> None:
    for _ in range(3):  # both see their input end at the same time
        supervisor = start(SUPERVISOR, LOOP, "note")
        line(supervisor)
        assert line(supervisor) == "adopted"
        end(supervisor)
        assert not bench_folder("a", memory).exists()


def test_adopt_loop_leaves_supervisor_keeps_bench(memory: Path) -> None:
    with take_bench("a", memory) as bench:
        loop = adopt(os.dup(bench.descriptor))
        assert loop.owner == bench.owner
        loop.leave()
        assert bench.folder.exists()
        with pytest.raises(Refused, match=f"run by process {os.getpid()}"):
            take_bench("a", memory)


def test_adopt_unlocked_descriptor_is_refused(memory: Path, tmp_path: Path) -> None:
    with take_bench("a", memory) as bench:
        unlocked = os.open(bench.folder / "owner", os.O_RDONLY)
        elsewhere = os.open(tmp_path, os.O_RDONLY)
        for descriptor in (-1, 999, unlocked, elsewhere):
            with pytest.raises(Refused, match="no locked bench"):
                adopt(descriptor)
        os.close(unlocked)
        os.close(elsewhere)


@pytest.mark.live
def test_take_bench_concurrent_starts_have_one_owner(start: Start, memory: Path) -> None:
    program = """
import sys, time
from pathlib import Path
from bench.base.errors import Refused
from bench.supervisor.ownership import take_bench
taken = 0
for _ in range(150):
    try:
        with take_bench("a", Path(sys.argv[1])) as bench:
            (bench.folder / "alone").touch(exist_ok=False)
            (bench.folder / "alone").unlink()
            taken += 1
    except Refused:
        pass
print(taken)
"""
    processes = [start(program) for _ in range(3)]
    taken = [int(line(process)) for process in processes]
    assert all(process.wait(10) == 0 for process in processes)
    assert all(taken), taken
    assert free(memory)


def test_leave_with_bench_taken_meanwhile_keeps_folder_of_next_owner(
    memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between opening and locking the owner file another process leaves, and a third takes the bench."""
    first, lock, later = take_bench("a", memory), ownership.try_lock, list[ownership.Ownership]()

    def taken_meanwhile(descriptor: int) -> bool:
        monkeypatch.setattr(ownership, "try_lock", lock)
        (first.folder / ownership.OWNER).unlink()
        first.folder.rmdir()
        later.append(take_bench("a", memory))
        (later[0].folder / "ring").write_text("shared")
        return lock(descriptor)

    monkeypatch.setattr(ownership, "try_lock", taken_meanwhile)
    first.leave()
    assert sorted(os.listdir(first.folder)) == ["owner", "ring"]
    later[0].leave()
    assert free(memory)
