"""What every test in the guest begins with: commands, links and nodes by their units, rows to the host."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable
from math import ceil
from pathlib import Path

from tests.benchmarks.row import Row

HOST = Path("/host")
"""The folder shared with the host."""
UNITS = Path("/opt/golfbench/systemd")
SYSTEM = Path("/etc/systemd/system")
CONFIGURATIONS = Path("/etc/golfbench")
NODES = "golfbench-nodes"
NODES_FOLDER = Path("/run/golfbench-nodes")
CARDS = ("can0", "can1", "can2")
"""Interfaces of the bench, of the nodes, and of the witness or a babbling node: one wire."""
DRIVER_OF_CARDS, PLACE = Path("/sys/bus/pci/drivers/kvaser_pci"), "0000:00:10.0"
"""The kernel's driver, and where the bench's card sits (`machine.CARDS`)."""
GREATEST_SHARE = 70.0
"""% of the processor."""
SYNC, COMMAND, POSITIONS, EMERGENCY = 0x80, 0x20A, (0x281, 0x282, 0x283), 0x08A
OTHERS = (0x000, 0x18A, 0x28A, 0x38A, 0x701, 0x702, 0x703, 0x70A, 0x77F, 0x081, 0x082, 0x083, EMERGENCY)
SUPPLY = 0x01
"""Bit of the switches in byte 6 of a command."""

_PLANT_RATE = 4000.0
"""Hz of the plant's internal steps."""
_LOOK = 0.05
_CONFIG = """base = "shipped"
[loop]
rate_hz = {rate!r}
realtime = "require"
[driver]
name = "canopen"
[canopen]
channel = "{channel}"
sdo_timeout = 1.0
sync_timeout = {sync_timeout!r}
[lifecycle]
local_reset = true
[envelope]
encoder_timeout = {encoder_timeout!r}
[plant]
substeps = {substeps}
"""
_NODES = f"""[Unit]
Description=Simulated devices of a golf bench
[Service]
ExecStart=/opt/golfbench/bin/golfbench --config {CONFIGURATIONS}/nodes.toml nodes --folder {NODES_FOLDER}
RuntimeDirectory={NODES}
Environment=NUMBA_CACHE_DIR=/var/cache/golfbench PYTHONUNBUFFERED=1 HOME=/root
LimitRTPRIO=98
LimitMEMLOCK=infinity
"""


def run(*command: str) -> str:
    """Run a command and return its output; RuntimeError when it fails."""
    done = subprocess.run(command, check=False, text=True, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.returncode} {done.stdout}{done.stderr}")
    return done.stdout.strip()


def wait_until(holds: Callable[[], bool], what: str, longest: float = 120.0) -> float:
    """Wait until `holds()` and return the seconds it took; RuntimeError naming `what` after `longest`."""
    start = time.monotonic()
    while not holds():
        if time.monotonic() - start > longest:
            raise RuntimeError(f"not within {longest:g} s: {what}")
        time.sleep(_LOOK)
    return time.monotonic() - start


def say(text: str) -> None:
    """Print the progress of the test."""
    print(f"{time.monotonic():.1f} s: {text}", flush=True)


def keep(rows: list[Row]) -> None:
    """Give rows to the host."""
    with (HOST / "rows").open("a") as file:
        for row in rows:
            file.write(json.dumps(row._asdict()) + "\n")


def keep_journal() -> None:
    """Give the host the journal of all units."""
    (HOST / "journal").write_text(run("journalctl", "--no-pager", "--output=short-monotonic"))


def configuration(rate: float, channel: str) -> str:
    """Return the configuration of a bench of `rate` Hz on `channel`."""
    return _CONFIG.format(
        rate=rate,
        channel=channel,
        sync_timeout=0.5 / rate,
        encoder_timeout=max(0.0045, 2.5 / rate),
        substeps=ceil(_PLANT_RATE / rate - 1e-9),
    )


def bring_links_up(interface: str) -> tuple[str, str, str]:
    """Bring the links up, cards by their units; return those of bench, nodes and witness."""
    if interface == "vcan":
        run("modprobe", "vcan")
        run("ip", "link", "add", "vcan0", "type", "vcan")
        run("ip", "link", "set", "vcan0", "up")
        return "vcan0", "vcan0", "vcan0"
    CONFIGURATIONS.mkdir(exist_ok=True)
    shutil.copy(UNITS / "golfbench-can@.service", SYSTEM)
    for card in CARDS:
        shutil.copy(UNITS / "can0.env", CONFIGURATIONS / f"{card}.env")
    run("systemctl", "daemon-reload")
    run("systemctl", "start", *(f"golfbench-can@{card}" for card in CARDS))
    return CARDS


def start_nodes(rate: float, channel: str) -> None:
    """Start the simulated nodes and wait until they live."""
    CONFIGURATIONS.mkdir(exist_ok=True)
    (CONFIGURATIONS / "nodes.toml").write_text(configuration(rate, channel))
    (Path("/run/systemd/system") / f"{NODES}.service").write_text(_NODES)
    run("systemctl", "daemon-reload")
    run("systemctl", "start", NODES)
    wait_until(lambda: "live on" in run("journalctl", "-u", NODES, "--output=cat"), "the nodes on the bus")


def busy_time() -> float:
    """Return s for which the processor ran anything since the start, exactly.

    The ticks of /proc/stat are samples, and a loop in step with them is seen always or never.
    """
    for line in Path("/proc/schedstat").read_text().splitlines():
        if line.startswith("cpu0 "):
            return 1e-9 * int(line.split()[7])
    raise RuntimeError("this kernel does not count the time of its processors")
