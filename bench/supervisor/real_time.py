"""Real-time settings of the calling process, and the lock of its memory.

So that no tick waits for a page, everything that is resident is locked, every other mapping is paged in and
locked, and so is all memory mapped later. More than half is left out, as no tick uses it: the compiler and
the matrix library, whose clean pages return to the system, and reserves, of which hardly anything was ever
used (each copy of OpenBLAS maps work buffers of 32 MB). Their pages are locked when they are used again.

A setting counts only as read back after all were requested: a call may succeed without effect, and one
setting may change another (a SCHED_FIFO task has no timer slack). The granted settings are published and
stored with every record.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NamedTuple

from bench.base.errors import Refused

if TYPE_CHECKING:  # the loop does not load it
    from bench.network.bench_service import RealTimeStatus, SettingStatus

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
    """Access as the kernel writes it, `rw-p`."""
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


Mode = Literal["off", "prefer", "require"]

PRIORITY = 80
"""Usual SCHED_FIFO priority: above the kernel's threaded interrupts (50), below its watchdogs (99)."""

SCHEDULING, MEMORY, SLACK, IDLE = "scheduling", "memory lock", "timer slack", "idle states"
HUGE_PAGES = "huge pages"
"""Names of settings used elsewhere."""

_PR_SET_TIMERSLACK, _PR_GET_TIMERSLACK = 29, 30
_PR_SET_THP_DISABLE, _PR_GET_THP_DISABLE = 41, 42
_CPU_DMA_LATENCY = "/dev/cpu_dma_latency"
_POLICIES = {os.SCHED_OTHER: "OTHER", os.SCHED_FIFO: "FIFO", os.SCHED_RR: "RR", os.SCHED_BATCH: "BATCH"}


class _Item(NamedTuple):
    name: str
    asked: str
    ask: Callable[[ExitStack], object]
    """Requests the setting and pushes its undo onto the stack; raises OSError if refused."""
    read: Callable[[], tuple[str, bool]]
    """Reads back the value in force and whether it is the requested one."""
    action: str
    required: bool = True
    """Whether mode `require` needs the setting; other settings only reduce jitter."""


@contextmanager
def real_time(mode: Mode, *, priority: int = PRIORITY, cpu: int = -1) -> Iterator[RealTimeStatus]:
    """Request real-time settings, yield the granted ones, and restore the previous ones at the end.

    Enter it after imports and warm-up, so that their objects are frozen and their memory is locked, and
    before the first tick. Scheduling and `cpu` (-1: any) are the calling thread's; threads and processes
    started inside run with normal scheduling. With "off" nothing is asked, only read.

    Raises:
        Refused: with "require", a setting is missing. The message lists each with its action; the previous
            settings are restored.
    """
    # Scheduling last: locking memory and collecting garbage take long and come before.
    items = (
        _collector(),
        _huge_pages(),
        _memory(),
        _processor(cpu),
        _timer_slack(),
        _idle_states(),
        _scheduling(priority),
    )
    with ExitStack() as undo:
        asked = mode != "off"
        refusals = [_try(item, undo) if asked else "" for item in items]
        settings = [_settled(item, asked, why) for item, why in zip(items, refusals, strict=True)]
        lacking = [s for s in settings if s["required"] and not s["held"]]
        if mode == "require" and lacking:
            raise Refused(
                'loop.realtime = "require"',
                "; ".join(f"{s['name']}: {s['reason']}, {s['granted']}" for s in lacking),
                "; ".join(f"{s['name']}: {s['asked']}" for s in lacking),
                "; ".join(dict.fromkeys(s["action"] for s in lacking))
                + '; or set loop.realtime = "prefer" to run without (never with hardware)',
            )
        held = asked and not lacking
        yield {"mode": mode, "held": held, "settings": {s["name"]: s for s in settings}}


def limit_action(limit: str, value: str) -> str:
    """Return how to give resource `limit` (`rtprio`, `memlock`) to a user, a service and a container."""
    return (
        f"give it to the user: `@golfbench - {limit} {value}` in /etc/security/limits.conf; "
        f"to a service: Limit{limit.upper()}={value}; to a container: SYS_NICE, IPC_LOCK"
    )


def _try(item: _Item, undo: ExitStack) -> str:
    """Request `item`; return why it was refused, '' if granted."""
    try:
        item.ask(undo)
    except OSError as error:
        return os.strerror(error.errno) if error.errno else str(error)
    return ""


def _settled(item: _Item, asked: bool, refusal: str) -> SettingStatus:
    granted, as_asked = item.read()
    held = asked and as_asked and not refusal
    reason = "" if held else refusal or "not in force after the call" if asked else "not asked"
    return {
        "name": item.name,
        "asked": item.asked if asked else "nothing",
        "granted": granted,
        "held": held,
        "reason": reason,
        "action": item.action if asked and not held else "",
        "required": item.required,
    }


# The settings ----------------------------------------------------------------------------------------


def _collector() -> _Item:
    def ask(undo: ExitStack) -> None:
        if gc.isenabled():
            undo.callback(gc.enable)
        undo.callback(gc.unfreeze)
        gc.collect()
        gc.freeze()
        gc.disable()

    def read() -> tuple[str, bool]:
        frozen = gc.get_freeze_count()
        return (
            f"{'on' if gc.isenabled() else 'off'}, {frozen} objects frozen",
            not gc.isenabled() and frozen > 0,
        )

    return _Item("garbage collector", "off, objects frozen", ask, read, "report it: nothing may forbid this")


def _huge_pages() -> _Item:
    # Locked memory may still move: the kernel collapses small pages into huge ones while the loop waits.
    def ask(undo: ExitStack) -> None:
        _set_to_one(_PR_GET_THP_DISABLE, _PR_SET_THP_DISABLE, undo)

    def read() -> tuple[str, bool]:
        off = call_library("prctl", _PR_GET_THP_DISABLE, 0, 0, 0, 0) != 0
        return "none" if off else "as the system has them", off

    return _Item(HUGE_PAGES, "none", ask, read, "boot with transparent_hugepage=madvise", required=False)


def _memory() -> _Item:
    def ask(undo: ExitStack) -> None:
        lock_memory()
        undo.callback(unlock_memory)

    def read() -> tuple[str, bool]:
        locked, resident, held = locked_memory()
        return f"{locked >> 20} MiB locked, {resident >> 20} MiB resident", held

    return _Item(MEMORY, "all, now and later", ask, read, limit_action("memlock", "unlimited"))


def _processor(cpu: int) -> _Item:
    def ask(undo: ExitStack) -> None:
        if cpu >= 0:
            before = os.sched_getaffinity(0)
            try:
                os.sched_setaffinity(0, {cpu})
            except (ValueError, OverflowError) as error:
                raise OSError(0, str(error)) from error
            undo.callback(os.sched_setaffinity, 0, before)

    def read() -> tuple[str, bool]:
        cores = os.sched_getaffinity(0)
        return f"core {', '.join(map(str, sorted(cores)))}", cpu < 0 or cores == {cpu}

    action = f"set loop.cpu to one of {', '.join(map(str, sorted(os.sched_getaffinity(0))))}, or -1 for any"
    return _Item("processor", "any core" if cpu < 0 else f"core {cpu}", ask, read, action)


def _timer_slack() -> _Item:
    def ask(undo: ExitStack) -> None:
        _set_to_one(_PR_GET_TIMERSLACK, _PR_SET_TIMERSLACK, undo)

    def read() -> tuple[str, bool]:
        slack = call_library("prctl", _PR_GET_TIMERSLACK, 0, 0, 0, 0)
        return f"{slack} ns", slack <= 1  # a real-time task has none at all: 0

    return _Item(SLACK, "1 ns", ask, read, "report it: nothing may forbid this")


def _idle_states() -> _Item:
    descriptors: list[int] = []

    def ask(undo: ExitStack) -> None:
        # In force while the file is open. Without it a sleeping core wakes late.
        descriptors.append(os.open(_CPU_DMA_LATENCY, os.O_RDWR))
        undo.callback(os.close, descriptors[0])
        os.write(descriptors[0], bytes(4))

    def read() -> tuple[str, bool]:
        if not descriptors:
            return "the system's own", False
        latency = int.from_bytes(os.pread(descriptors[0], 4, 0), sys.byteorder, signed=True)
        return f"{latency} µs", latency == 0

    action = f"let the user write {_CPU_DMA_LATENCY}: a udev rule, or DeviceAllow= of a service"
    return _Item(IDLE, "0 µs to wake up", ask, read, action, required=False)


def _scheduling(priority: int) -> _Item:
    def ask(undo: ExitStack) -> None:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        # Threads and processes started later do not inherit it: they would preempt the loop.
        policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        os.sched_setscheduler(0, policy, os.sched_param(priority))
        undo.callback(_restore_scheduling, *before)

    def read() -> tuple[str, bool]:
        policy, got = os.sched_getscheduler(0), os.sched_getparam(0).sched_priority
        resets = policy & os.SCHED_RESET_ON_FORK
        name = _POLICIES.get(policy & ~os.SCHED_RESET_ON_FORK, str(policy))
        return (
            f"{name} {got}" + (", reset on fork" if resets else ""),
            name == "FIFO" and got == priority and bool(resets),
        )

    action = limit_action("rtprio", str(priority))
    return _Item(SCHEDULING, f"FIFO {priority}, reset on fork", ask, read, action)


def _restore_scheduling(policy: int, parameter: os.sched_param) -> None:
    try:
        os.sched_setscheduler(0, policy, parameter)
    except PermissionError:  # without CAP_SYS_NICE the flag remains, which is harmless
        os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameter)


def _set_to_one(get: int, put: int, undo: ExitStack) -> None:
    """Set the `prctl` value of options `get` and `put` to 1, and restore it by `undo`."""
    before = call_library("prctl", get, 0, 0, 0, 0)
    call_library("prctl", put, 1, 0, 0, 0)
    undo.callback(call_library, "prctl", put, before, 0, 0, 0)
