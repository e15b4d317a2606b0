"""Checks that run in a separate process, because they change the process or may end it.

`python -m bench.commands.machine.probe realtime` tries the loop's settings at the kernel and prints JSON.
`python -m bench.commands.machine.probe can` asks python-can's backends for attached channels and prints JSON.
`python -m bench.commands.machine.probe daq` asks NI's driver for its version and its cards and prints JSON.
`python -m bench.commands.machine.probe cache` prints the folder of compiled code as JSON.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

from bench.base.clock import GridClock
from bench.supervisor.real_time import real_time

PERIOD_NS = 1_000_000
TICKS = 500


def wake_up_latencies(ticks: int = TICKS, period_ns: int = PERIOD_NS) -> list[float]:
    """Return how late (s, ascending) the loop's clock wakes on its grid."""
    clock = GridClock(period_ns)
    latencies = []
    for _ in range(ticks):
        clock.wait()
        latencies.append((clock.woke - clock.due) * 1e-9)
    return sorted(latencies)


def realtime() -> dict[str, Any]:
    """Return the real-time settings the kernel grants, and the wake-up latency (us) under them."""
    with real_time("prefer") as granted:
        late = wake_up_latencies()
    quantiles = {"p50_us": 0.5, "p99_us": 0.99, "max_us": 1.0}
    return {
        **granted,
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


def daq_cards() -> dict[str, Any]:
    """Return `package` and `runtime`, versions of what drives NI's cards ("" when missing), and `cards`.

    `fault` says what NI's own driver says where it does not answer.
    """
    from importlib.metadata import version

    from drivers.base import DriverError
    from drivers.daq.watchdog import error_text, load_nidaqmx

    found: dict[str, Any] = {"package": "", "runtime": "", "cards": [], "fault": ""}
    try:
        nidaqmx = load_nidaqmx()
        found["package"] = version("nidaqmx")
        system = nidaqmx.system.System.local()
        found["runtime"] = ".".join(map(str, system.driver_version))
        found["cards"] = [f"{card.name} ({card.product_type})" for card in system.devices]
    except DriverError as error:
        found["fault"] = str(error)
    except Exception as error:  # NI's own, of which nothing can be imported where it is missing
        found["fault"] = error_text(error)
    return found


def compiled_code() -> dict[str, Any]:
    """Return the folder in which this installation keeps its machine code, and the functions it has there."""
    from drivers.base.machine_code import cache_folder, module_digests

    folder = cache_folder()
    versions = [folder / module / digest for module, digest in module_digests().items()]
    return {"folder": str(folder), "functions": sum(1 for one in versions for _ in one.rglob("*.nbc"))}


QUESTIONS: dict[str, Callable[[], Any]] = {
    "realtime": realtime,
    "can": can_channels,
    "daq": daq_cards,
    "cache": compiled_code,
}

if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in QUESTIONS:
        sys.exit(__doc__)
    print(json.dumps(QUESTIONS[sys.argv[1]]()))
