"""The lock on a commissioning's folder: one process moves its robot."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.base.errors import Refused
from bench.supervisor.ownership import try_lock

_FILE = "process"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock on `folder`, which is made if it is missing.

    Raises:
        Refused: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / _FILE).open("a+", encoding="ascii") as file:
        if not try_lock(file.fileno()):
            found = f"process {_owner(folder)}, which commissions there"
            raise Refused(str(folder), found, "no other process", "Wait for it, or name another folder.")
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def commissioning_process(folder: Path) -> int | None:
    """Return the id of the process that commissions in `folder`; None without one."""
    try:
        with (folder / _FILE).open("rb") as file:  # the lock needs no right to write
            return None if try_lock(file.fileno()) else _owner(folder)
    except OSError:
        return None


def _owner(folder: Path) -> int | None:
    text = (folder / _FILE).read_text(encoding="ascii").strip()
    return int(text) if text.isdecimal() else None
