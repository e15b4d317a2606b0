"""Lock of the memory that a tick may use, so that no tick waits for a page.

Everything that is resident is locked, every other mapping is paged in and locked, and so is all memory mapped
later. More than half is left out, as no tick uses it: the compiler and the matrix library, whose clean pages
return to the system, and reserves, of which hardly anything was ever used (each copy of OpenBLAS maps work
buffers of 32 MB). Their pages are locked when they are used again.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

NOT_IN_TICKS = ("libllvmlite", "openblas")
"""Parts of the names of libraries that only preparations call: all code is compiled before the first tick."""

_RESERVE, _USED = 16 << 20, 0.25
"""Min size (bytes) of a reserve, and the fraction of it that is resident at most."""
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_MADV_DONTNEED = 4
_HEAD = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \d+ *(.*)")
_KIBIBYTE = 1024


@dataclass
class MemoryMapping:
    """One mapping of this process, sizes in bytes."""

    start: int
    size: int
    access: str
    """As the kernel writes it, `rw-p`."""
    name: str
    """File, kernel's name, or empty."""
    resident: int = 0
    private: int = 0
    """Resident bytes that no file holds."""
    is_locked: bool = False

    @property
    def is_lockable(self) -> bool:
        """Whether it has pages of memory: not the kernel's, nor a guard."""
        return not self.access.startswith("---") and self.name not in {"[vvar]", "[vsyscall]", "[vdso]"}

    @property
    def is_of_preparations(self) -> bool:
        """Whether it is of a library that no tick calls."""
        return any(part in os.path.basename(self.name) for part in NOT_IN_TICKS)

    @property
    def is_reserve(self) -> bool:
        """Whether hardly anything of it was ever used."""
        return not self.name and self.size >= _RESERVE and self.resident < _USED * self.size

    @property
    def is_for_ticks(self) -> bool:
        """Whether a tick may use it."""
        return self.is_lockable and not self.is_of_preparations and not self.is_reserve


def memory_mappings(path: Path = Path("/proc/self/smaps")) -> Iterator[MemoryMapping]:
    """Yield the mappings of this process; takes some 10 ms."""
    mapping = None
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        if head := _HEAD.fullmatch(line):
            if mapping is not None:
                yield mapping
            first, end = int(head[1], 16), int(head[2], 16)
            mapping = MemoryMapping(first, end - first, head[3], head[4])
        elif mapping is not None:
            name, _, value = line.partition(":")
            if name == "Rss":
                mapping.resident = int(value.split()[0]) * _KIBIBYTE
            elif name == "Anonymous":
                mapping.private = int(value.split()[0]) * _KIBIBYTE
            elif name == "VmFlags":
                mapping.is_locked = "lo" in value.split()
    if mapping is not None:
        yield mapping


def drop_preparations() -> None:
    """Return the clean pages of libraries that only preparations call; a later call reads them again."""
    for mapping in list(memory_mappings()):
        # Relocated pages are this process' own: dropping them would lose them.
        if mapping.is_of_preparations and not mapping.private and "w" not in mapping.access:
            with suppress(OSError):
                call_library("madvise", mapping.start, mapping.size, _MADV_DONTNEED)


def lock_memory() -> None:
    """Lock the memory that ticks may use, now and later, after all preparations.

    Raises:
        OSError: it is not allowed; nothing is locked.
    """
    drop_preparations()
    call_library("mlockall", _MCL_CURRENT | _MCL_ONFAULT)
    for mapping in list(memory_mappings()):
        if mapping.is_for_ticks:
            try:
                call_library("mlock", mapping.start, mapping.size)
            except OSError as error:
                if error.errno != errno.ENOMEM:  # unmapped since it was read, or longer than its file
                    unlock_memory()
                    raise
    call_library("mlockall", _MCL_FUTURE)


def unlock_memory() -> None:
    """Unlock all memory."""
    call_library("munlockall")


def locked_memory() -> tuple[int, int, bool]:
    """Return locked and resident memory (bytes), and whether the memory of ticks is resident and locked."""
    mappings = list(memory_mappings())
    wanted = [mapping for mapping in mappings if mapping.is_for_ticks]
    held = sum(mapping.resident for mapping in wanted if mapping.is_locked)
    return (
        sum(mapping.resident for mapping in mappings if mapping.is_locked),
        sum(mapping.resident for mapping in mappings),
        held >= 0.9 * sum(mapping.size for mapping in wanted) > 0,  # a file may end before its mapping
    )


def call_library(name: str, *arguments: int) -> int:
    """Call `name` of the C library; raise OSError if it returns -1."""
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    result = int(function(*map(ctypes.c_ulong, arguments)))
    if result == -1:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
