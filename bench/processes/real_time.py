"""Real-time settings of the calling process: request, read back, restore at the end.

A setting counts only as read back after all were requested: a call may succeed without effect, and one
setting may change another (a SCHED_FIFO task has no timer slack). The granted settings are published and
stored with every record.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from bench.errors import Refused
from bench.processes.memory_lock import call_library, lock_memory, locked_memory, unlock_memory

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


class Setting(NamedTuple):
    """One setting as requested and as granted."""

    name: str
    asked: str
    granted: str
    """Value read back."""
    held: bool
    """Whether the requested value is in force; False if nothing was requested."""
    reason: str
    """Why it is not in force."""
    action: str
    """Action to get it granted."""
    required: bool
    """Whether mode `require` needs it; the others only reduce jitter."""


@dataclass(frozen=True)
class RealTime:
    """Settings granted by the kernel."""

    mode: Mode
    settings: tuple[Setting, ...]

    @property
    def lacking(self) -> tuple[Setting, ...]:
        """Required settings that were requested and are not in force."""
        if self.mode == "off":
            return ()
        return tuple(setting for setting in self.settings if setting.required and not setting.held)

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain values, with the settings by name."""
        return {
            "mode": self.mode,
            "held": self.mode != "off" and not self.lacking,
            "settings": {setting.name: setting._asdict() for setting in self.settings},
        }


class _Item(NamedTuple):
    name: str
    asked: str
    ask: Callable[[ExitStack], object]
    """Requests the setting and pushes its undo onto the stack; raises OSError if refused."""
    read: Callable[[], tuple[str, bool]]
    """Reads back the value in force and whether it is the requested one."""
    action: str
    required: bool = True


@contextmanager
def real_time(mode: Mode, *, priority: int = PRIORITY, cpu: int = -1) -> Iterator[RealTime]:
    """Request real-time settings, yield what was granted, and restore the previous ones at the end.

    Enter it after imports and warm-up, so that their objects are frozen and their memory is locked, and
    before the first tick. Scheduling and `cpu` (-1: any) are the calling thread's; threads and processes
    started inside run with normal scheduling. With "off" nothing is asked, only read.

    Raises:
        Refused: with "require", naming every missing setting and its action; everything is restored.
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
        granted = RealTime(
            mode, tuple(_settled(item, asked, why) for item, why in zip(items, refusals, strict=True))
        )
        if mode == "require" and granted.lacking:
            raise Refused(
                'loop.realtime = "require"',
                "; ".join(f"{s.name}: {s.reason}, {s.granted}" for s in granted.lacking),
                "; ".join(f"{s.name}: {s.asked}" for s in granted.lacking),
                "; ".join(dict.fromkeys(s.action for s in granted.lacking))
                + '; or set loop.realtime = "prefer" to run without (never with hardware)',
            )
        yield granted


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


def _settled(item: _Item, asked: bool, refusal: str) -> Setting:
    granted, as_asked = item.read()
    if not asked:
        return Setting(item.name, "nothing", granted, False, "not asked", "", item.required)
    if as_asked and not refusal:
        return Setting(item.name, item.asked, granted, True, "", "", item.required)
    reason = refusal or "not in force after the call"
    return Setting(item.name, item.asked, granted, False, reason, item.action, item.required)


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
