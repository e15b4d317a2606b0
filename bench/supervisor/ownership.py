"""Ownership of a bench on this machine: a folder in shared memory, and the lock on the file `owner` in it.

The daemon takes the bench before anything moves and passes the locked descriptor to its loop, so the bench
stays taken while one of the two runs. The kernel releases the lock when both have ended for any reason; the
next owner removes files left by killed processes. The folder holds the files that the daemon's processes
share.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

from bench.base.address import BENCH_ID
from bench.base.errors import BenchError, ExitCode, Refused


def try_lock(descriptor: int) -> bool:
    """Lock the open file for this process and those that inherit it; False if locked by another."""
    import fcntl  # on Unix only; this module is imported on every system

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


MEMORY = Path("/dev/shm")  # noqa: S108 - the folder made in it is checked to be ours alone
"""Folder of shared memory, unless systemd provides another one."""


def bench_folder(bench_id: str, memory: Path = MEMORY) -> Path:
    """Return the folder in `memory` of bench `bench_id`, which exists while the bench runs.

    A service and a bench started by hand use the same folder, so that they exclude each other.

    Raises:
        BenchError: `bench_id` does not match BENCH_ID.
    """
    if not re.fullmatch(BENCH_ID, bench_id):
        raise BenchError(
            "bench.id", repr(bench_id), "letters, digits, - and _, at most 63", "Give the bench another id."
        )
    return memory / f"golfbench-{bench_id}"


OWNER = "owner"
"""Name of the locked file."""

_SIZE = 512
"""Fixed size of that file in bytes, so that a concurrent reader finds it complete."""
_ATTEMPTS, _PAUSE = 20, 0.01
"""Number and period (s) of retries while another process is just leaving."""


class NoBenchFolder(BenchError):
    """The bench's folder in shared memory cannot be created or used."""

    exit_code = ExitCode.FILE


class Process(NamedTuple):
    """A process, identified by its number and start time, as numbers are reused."""

    pid: int
    start: int
    """Start time in clock ticks since boot."""

    @property
    def lives(self) -> bool:
        """Whether it is still running."""
        return _start_of(self.pid) == self.start


class Owner(NamedTuple):
    """Content of the file `owner`."""

    bench_id: str
    supervisor: Process
    loop: Process | None = None


class Ownership:
    """Ownership of a bench until `leave`, held by supervisor and loop."""

    def __init__(self, owner: Owner, folder: Path, descriptor: int) -> None:
        """Hold `descriptor`, the locked file `owner` in `folder`; see `take_bench` and `adopt`."""
        self.owner = owner
        self.folder = folder
        """Folder of the files shared by the processes of the bench."""
        self.descriptor = descriptor
        """Locked descriptor; pass it only to the loop process (`pass_fds`), which calls `adopt` with it."""

    def note_loop(self, pid: int) -> None:
        """Record `pid`, a child that inherits the lock, as the loop."""
        self.owner = self.owner._replace(loop=Process(pid, _start_of(pid) or 0))
        _write(self.descriptor, self.owner)

    def leave(self) -> None:
        """Release the bench; the last process to leave removes the folder. May be called twice."""
        if self.descriptor < 0:
            return
        os.close(self.descriptor)
        self.descriptor = -1
        with suppress(OSError):  # gone already
            descriptor = os.open(self.folder / OWNER, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if try_lock(descriptor) and _is_current(descriptor, self.folder):
                    _clear(self.folder, but="")
                    self.folder.rmdir()
            finally:
                os.close(descriptor)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.leave()


def take_bench(bench_id: str, memory: Path = MEMORY) -> Ownership:
    """Take the bench for this process; files left by a killed daemon are removed.

    Raises:
        Refused: another process owns it (named), or the folder of that name is unsafe: a symbolic link,
            another user's, or open to others.
        NoBenchFolder: memory's file system is missing, read-only or full.
    """
    path = bench_folder(bench_id, memory)
    found: Owner | None = None
    for attempt in range(_ATTEMPTS):
        if attempt:
            time.sleep(_PAUSE)
        try:
            taken = _try_to_take(bench_id, path)
        except FileNotFoundError:
            if path.parent.is_dir():
                continue  # the last owner is just removing it
            raise NoBenchFolder(
                str(path), "no parent folder", "an existing parent folder", "Mount /dev/shm, then retry."
            ) from None
        except OSError as error:
            raise NoBenchFolder(
                str(path),
                error.strerror or str(error),
                "a folder in memory of this user's, with space left",
                "Make it writable or free some memory.",
            ) from error
        if isinstance(taken, Ownership):
            return taken
        found = taken
        if found and (found.supervisor.lives or (found.loop and found.loop.lives)):
            break
    raise _refusal(bench_id, path, found)


def adopt(descriptor: int) -> Ownership:
    """Return the bench inherited with the locked `descriptor`; for the loop.

    The bench stays taken while this process runs, even if its parent ends.

    Raises:
        Refused: `descriptor` is not the locked file of a bench.
    """
    try:
        owner = _read(descriptor)
        ours = owner is not None and try_lock(descriptor)
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
    except OSError:
        owner, ours, path = None, False, Path()
    if owner is None or not ours or path.name != OWNER:
        raise Refused(
            f"file descriptor {descriptor}",
            "no locked bench",
            "the descriptor that the supervisor holds",
            "Let `golfbench run` start the loop.",
        )
    os.set_inheritable(descriptor, False)
    return Ownership(owner, path.parent, descriptor)


def _try_to_take(bench_id: str, path: Path) -> Ownership | Owner | None:
    """Return the bench, or its owner (None if not yet written).

    Raises FileNotFoundError if the folder is removed meanwhile, OSError, and Refused.
    """
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    _require_private(path)
    descriptor = os.open(path / OWNER, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        if not try_lock(descriptor):
            return _read(descriptor)
        if not _is_current(descriptor, path):
            raise FileNotFoundError
        _require_private(path)  # again: while it is locked none of this user's processes removes it
        _clear(path, but=OWNER)
        pid = os.getpid()
        ownership = Ownership(Owner(bench_id, Process(pid, _start_of(pid) or 0)), path, descriptor)
        _write(descriptor, ownership.owner)
        descriptor = -1  # now the ownership's
        return ownership
    finally:
        if descriptor >= 0:
            os.close(descriptor)


def _is_current(descriptor: int, folder: Path) -> bool:
    """Return whether the locked file is still the one in `folder`, not that of an owner that has left."""
    return os.path.samestat(os.fstat(descriptor), os.stat(folder / OWNER, follow_symlinks=False))


def _require_private(path: Path) -> None:
    """Refuse the folder `path` unless it belongs to this user alone.

    Any user may create files in /dev/shm: with a prepared folder another user could read and control the
    bench. While its owner file is locked no folder of this user is replaced by another: /dev/shm is sticky.
    """
    status = path.lstat()
    if stat.S_ISLNK(status.st_mode):
        unsafe = "a symbolic link"
    elif not stat.S_ISDIR(status.st_mode):
        unsafe = "a file"
    elif status.st_uid != os.geteuid():
        unsafe = f"a folder of user {_user(status.st_uid)}"
    elif status.st_mode & 0o077:
        unsafe = f"a folder open to others (mode {stat.S_IMODE(status.st_mode):04o})"
    else:
        return
    raise Refused(
        str(path),
        unsafe,
        f"none, or a folder of user {_user(os.geteuid())} with mode 0700",
        "Run as that user if the bench is theirs; otherwise find out who created it, then remove it.",
    )


def _refusal(bench_id: str, path: Path, owner: Owner | None) -> Refused:
    free = "a bench that is not running"
    location = f"bench {bench_id}"
    if owner and owner.supervisor.lives:
        pid = owner.supervisor.pid
        action = f"End it first (kill {pid}), or give this bench another id."
        return Refused(location, f"it run by process {pid}", free, action)
    if owner:
        loop = f"process {owner.loop.pid}" if owner.loop and owner.loop.lives else "a process"
        return Refused(
            location,
            f"its daemon (process {owner.supervisor.pid}) dead, but its loop ({loop}) still running",
            free,
            "Wait until the loop has stopped the robot and ends. If it hangs, kill -9 it, which leaves "
            f"the valves to the device's watchdog; fuser -v {path / OWNER} shows it.",
        )
    return Refused(
        location, f"{path / OWNER} locked by an unnamed process", free, f"Find it: fuser -v {path / OWNER}"
    )


def _write(descriptor: int, owner: Owner) -> None:
    os.pwrite(descriptor, json.dumps(owner).ljust(_SIZE - 1).encode() + b"\n", 0)


def _read(descriptor: int) -> Owner | None:
    """Return the owner in the file, None if not yet written."""
    try:
        bench_id, supervisor, loop = json.loads(os.pread(descriptor, _SIZE, 0))
        return Owner(
            str(bench_id), Process(*map(int, supervisor)), Process(*map(int, loop)) if loop else None
        )
    except (ValueError, TypeError):
        return None


def _clear(folder: Path, but: str) -> None:
    """Remove the files in `folder`, `owner` last, all but the one named."""
    for name in sorted(set(os.listdir(folder)) - {but}, key=OWNER.__eq__):
        try:
            os.unlink(folder / name)
        except IsADirectoryError:
            shutil.rmtree(folder / name)


def _start_of(pid: int) -> int | None:
    """Return the start time of process `pid` (clock ticks since boot), None if it is dead."""
    try:
        state, *fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except (OSError, ValueError):
        return None
    return None if state in "ZX" else int(fields[18])


def _user(uid: int) -> str:
    import pwd  # not everywhere, see `try_lock`

    try:
        return f"{pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"with uid {uid}"
