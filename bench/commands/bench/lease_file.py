"""Storage of the lease between commands, in a file only its user can read."""

from __future__ import annotations

import fcntl
import json
import os
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import IO

from bench.base.errors import BenchError
from bench.network.client import HeldLease


def lease_folder(environment: Mapping[str, str], home: Path) -> Path:
    """Return the folder of stored leases: in the login session's folder, or else the user's state folder."""
    if runtime := environment.get("XDG_RUNTIME_DIR"):
        return Path(runtime) / "golfbench"
    state = environment.get("XDG_STATE_HOME")
    return (Path(state) if state else home / ".local" / "state") / "golfbench"


class LeaseFile:
    """The open and locked lease file of one bench; its lease may have expired."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def read(self) -> HeldLease | None:
        """Return the stored lease; None if there is none or it is unreadable."""
        self._file.seek(0)
        try:
            match json.loads(self._file.read(4096) or "null"):
                case {
                    "version": 1,
                    "holder": str(holder),
                    "key": str(key),
                    "seconds": float(seconds),
                    "sequence": int(sequence),
                }:
                    return HeldLease(holder, key, seconds, sequence)
        except ValueError:
            pass
        return None

    def write(self, lease: HeldLease | None) -> None:
        """Store `lease`, or none."""
        self._file.seek(0)
        self._file.truncate()
        if lease is not None:
            json.dump({"version": 1, **asdict(lease)}, self._file)
        self._file.flush()


@contextmanager
def open_lease_file(folder: Path, bench: str) -> Iterator[LeaseFile]:
    """Yield the file of `bench` in `folder`, made if needed; a second command waits until this one is done.

    Raises:
        BenchError: the file is not its user's alone.
        OSError: it cannot be made or written.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    path = folder / f"lease-{bench}.json"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    with os.fdopen(descriptor, "r+", encoding="utf-8") as file:
        status = os.fstat(descriptor)
        if status.st_uid != os.geteuid() or stat.S_IMODE(status.st_mode) & 0o077:
            found = f"mode {stat.S_IMODE(status.st_mode):o} of user {status.st_uid}"
            expected = "mode 600 of this user: it holds the key to the bench"
            raise BenchError(str(path), found, expected, "Remove the file and take the lease again.")
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield LeaseFile(file)
