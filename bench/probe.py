"""What is tried in a process of its own, because it changes the process or may end it.

`python -m bench.probe imports MODULE...` imports each module and prints `module TAB answer`.
`python -m bench.probe realtime` asks the kernel for what the loop needs and prints JSON.
`python -m bench.probe can` asks python-can's backends for attached channels and prints JSON.
`python -m bench.probe cache` prints the folder of compiled code as JSON.
"""

from __future__ import annotations

import ctypes
import importlib
import json
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

PRIORITY = 80
"""SCHED_FIFO priority asked for: above the kernel's threaded interrupts (50), below its watchdogs (99)."""

PERIOD_NS = 1_000_000
TICKS = 500

_MCL_CURRENT, _MCL_FUTURE = 1, 2
_PR_GET_TIMERSLACK = 30


def imports(modules: Sequence[str]) -> None:
    """Import each of `modules` and print `module TAB ok` or `module TAB error`, one line each."""
    answers, sys.stdout = sys.stdout, sys.stderr  # a chatty import must not look like an answer
    for module in modules:
        try:
            importlib.import_module(module)
            answer = "ok"
        except BaseException as error:  # SystemExit at import is an answer, too
            answer = f"{type(error).__name__}: {error}".replace("\n", " ").replace("\t", " ")
        print(module, answer, sep="\t", file=answers, flush=True)


def wake_up_latencies(ticks: int = TICKS, period_ns: int = PERIOD_NS) -> list[float]:
    """Return how late (s, ascending) a sleeper wakes on an absolute grid of `period_ns`."""
    latencies = []
    due = time.monotonic_ns() + period_ns
    for _ in range(ticks):
        time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
        now = time.monotonic_ns()
        latencies.append((now - due) * 1e-9)
        due += period_ns * max(1, -(-(now - due) // period_ns))  # skip missed ticks, never catch up
    return sorted(latencies)


def _policy() -> str:
    """Ask for SCHED_FIFO and return what the kernel then says: 'FIFO 80', or the reason why not."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return f"refused: {error.strerror}"
    granted = os.sched_getscheduler(0) == os.SCHED_FIFO
    return (
        f"FIFO {os.sched_getparam(0).sched_priority}" if granted else "refused: not in force after the call"
    )


def _memory_lock() -> str:
    """Ask for mlockall and return 'locked' with the kernel's count, or the reason why not."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        return f"refused: {os.strerror(ctypes.get_errno())}"
    with open("/proc/self/status", encoding="ascii") as status:
        locked = next((line.split()[1] for line in status if line.startswith("VmLck")), "0")
    return f"locked {int(locked) // 1024} MiB" if int(locked) else "refused: nothing locked after the call"


def realtime() -> dict[str, Any]:
    """Return what the kernel grants: policy, memory lock, timer slack (ns), wake-up latency (us)."""
    slack = ctypes.CDLL(None).prctl(_PR_GET_TIMERSLACK, 0, 0, 0, 0)
    policy, memory = _policy(), _memory_lock()
    late = wake_up_latencies()
    quantiles = {"p50_us": 0.5, "p99_us": 0.99, "max_us": 1.0}
    return {
        "policy": policy,
        "memory": memory,
        "timer_slack_ns": slack,
        "latency": {
            name: round(late[min(int(q * len(late)), len(late) - 1)] * 1e6, 1)
            for name, q in quantiles.items()
        },
    }


def can_channels() -> list[str]:
    """Return the attached CAN channels as `interface:channel`; no network is searched."""
    import can

    attached = can.VALID_INTERFACES - {"virtual", "udp_multicast", "socketcand"}
    found = can.detect_available_configs(sorted(attached))
    return [f"{config['interface']}:{config['channel']}" for config in found]


def compiled_code_folder() -> str:
    """Return the folder in which this installation keeps its machine code."""
    from sim.compiled import cache_folder

    return str(cache_folder())


if __name__ == "__main__":
    if sys.argv[1:2] == ["imports"]:
        imports(sys.argv[2:])
    elif sys.argv[1:] == ["realtime"]:
        print(json.dumps(realtime()))
    elif sys.argv[1:] == ["can"]:
        print(json.dumps(can_channels()))
    elif sys.argv[1:] == ["cache"]:
        print(json.dumps(compiled_code_folder()))
    else:
        sys.exit(__doc__)
