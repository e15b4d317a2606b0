"""`golfbench doctor`, and its checks of hardware: CAN link, interrupt threads, cores.

The kernel states its settings in files below /sys and /proc; bit timing and error counters come from `ip`.
Like `bench.commands.machine.doctor`, nothing here raises or changes the machine.
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bench.commands.common import Json, Session, exit_unless, progress_bar, show_result
from bench.commands.machine.doctor import (
    ItemResult,
    Probe,
    examine,
    limited,
    missing,
    ok,
    probes,
    report,
    small_text,
    table,
    usable,
)

if TYPE_CHECKING:
    from bench.config import Configuration
    from drivers.canopen.settings import CanopenSettings

_LINK_TIME_LIMIT = 5.0
"""Time-out of `ip`, s."""
MIN_QUEUE = 64
"""Min frames in the link's send queue: several ticks' commands, SYNC and heartbeats."""
SAMPLE_POINT = (0.75, 0.9)
"""Range of the sample point: CiA 301 recommends 0.875."""
_WARNING = 96
"""CAN's error counters from which a node is in the state error warning."""
_RT_PRIORITY = 40 - 3
"""Place of the real-time priority in /proc/PID/stat behind the name, which is its second field."""

Ask = Callable[[str], str]


def doctor(context: typer.Context, json_: Json = False) -> None:
    """Check this machine: packages, real time, memory, CAN, tools.

    With hardware in the configuration also its CAN link, interrupt thread and core.
    Exits with 1 if something is missing that the simulation needs.
    """
    configuration = context.ensure_object(Session).configuration()
    planned = (*probes(configuration.bench.data_dir), *bench_probes(configuration))
    findings = []
    with progress_bar() as progress:
        task = progress.add_task(f"examining {planned[0].group}", total=len(planned))
        for finding, following in zip(examine(planned), (*planned[1:], planned[-1]), strict=True):
            findings.append(finding)
            progress.update(task, advance=1, description=f"examining {following.group}")
    show_result(json_, report(findings), table(findings))
    exit_unless(usable(findings))


def bench_probes(
    configuration: Configuration, root: Path = Path("/"), ask: Ask | None = None
) -> tuple[Probe, ...]:
    """Return what to look at for the hardware of `configuration`; nothing if it has none.

    `root` stands for the machine's root folder, `ask` returns what `ip` says of a link, as JSON.
    """
    name, loop = configuration.driver.name, configuration.loop
    if name not in ("canopen", "daq"):
        return ()
    found = [Probe("this bench", "core of the loop", partial(loop_core, root, loop.cpu))]
    if name == "canopen" and configuration.canopen.interface == "socketcan":
        link = configuration.canopen.channel
        if not (root / "sys/class/net" / link).exists():
            set_up = f"ip link set {link} up type can bitrate {configuration.canopen.bitrate} restart-ms 100"
            advice = f"attach the card, load its driver, then {set_up}; or correct canopen.channel"
            return (*found, Probe("this bench", link, lambda: missing("no such link", advice)))
        said: Callable[[], Any] = cache(lambda: json.loads((ask or _ip)(link))[0])
        found += [
            Probe("this bench", f"{link}: bit timing", lambda: bit_timing(configuration.canopen, said())),
            Probe("this bench", f"{link}: errors", lambda: errors(link, said(), root)),
            Probe("this bench", f"{link}: send queue", partial(send_queue, link, root)),
            Probe("this bench", f"{link}: card", partial(card, link, root)),
            Probe(
                "this bench",
                f"{link}: interrupt thread",
                partial(interrupt_thread, link, loop.priority, loop.cpu, root),
            ),
        ]
    return tuple(found)


def loop_core(root: Path, cpu: int) -> ItemResult:
    """Look whether the core of the loop (-1: any) is kept free of everything else."""
    isolated = _cores(small_text(root / "sys/devices/system/cpu/isolated"))
    quiet = _cores(small_text(root / "sys/devices/system/cpu/nohz_full"))
    if cpu < 0:
        free = min(isolated, default=1)
        boot = "" if isolated else f", and boot with isolcpus={free} nohz_full={free} rcu_nocbs={free}"
        return limited("any: other programs share it", f"set loop.cpu = {free}{boot}")
    absent = [
        f"{word}={cpu}" for word, cores in (("isolcpus", isolated), ("nohz_full", quiet)) if cpu not in cores
    ]
    if absent:
        advice = f"boot with {' '.join(absent)}"
        return limited(f"{cpu}, shared with others", advice)
    return ok(f"{cpu}, isolated, without the kernel's own tick")


def bit_timing(settings: CanopenSettings, link: Mapping[str, Any]) -> ItemResult:
    """Look whether the link has the bit rate of the configuration and a usual sample point."""
    facts = _info(link)
    timing = facts.get("bittiming") or {}
    rate, point = int(timing.get("bitrate", 0)), float(timing.get("sample_point", 0.0))
    set_up = f"ip link set {settings.channel} down; ip link set {settings.channel} up type can bitrate "
    if not rate:
        return missing("no bit rate is set", f"{set_up}{settings.bitrate}")
    value = f"{rate} bit/s, sample point {point:.3f}"
    if rate != settings.bitrate:
        advice = f"{set_up}{settings.bitrate}, or correct canopen.bitrate"
        return missing(f"{value}, not {settings.bitrate}", advice)
    if not SAMPLE_POINT[0] <= point <= SAMPLE_POINT[1]:
        advice = f"{set_up}{rate} sample-point 0.875; long lines fail first otherwise"
        return limited(value, advice)
    if not facts.get("restart_ms"):
        advice = f"{set_up}{rate} restart-ms 100"
        return limited(f"{value}, stays off after bus-off", advice)
    return ok(value)


def errors(channel: str, link: Mapping[str, Any], root: Path) -> ItemResult:
    """Check state and error counters of the link; errors indicate a wiring fault."""
    facts, seen = _info(link), link.get("linkinfo", {}).get("info_xstats", {})
    state, counter = str(facts.get("state", "unknown")), facts.get("berr_counter", {})
    sent, received = int(counter.get("tx", 0)), int(counter.get("rx", 0))
    value = f"{state}, counters {sent} sending, {received} receiving"
    if seen.get("bus_off"):
        value += f", {seen['bus_off']} times bus-off"
    if state == "STOPPED":
        return missing(value, f"ip link set {channel} up")
    if state == "BUS-OFF" or sent >= _WARNING:
        advice = (
            "no node acknowledges, or the line is shorted or open: measure 60 ohms between CAN_H and CAN_L "
            "with power off (120: one terminator is missing, 40: one too many), then the nodes' bit rate"
        )
        return limited(value, advice)
    dropped = int(small_text(root / f"sys/class/net/{channel}/statistics/rx_over_errors") or 0)
    if dropped:
        advice = "the card's buffer overflows: raise its interrupt thread's priority, or use another card"
        return limited(f"{value}, {dropped} frames lost in the card", advice)
    if received or seen.get("error_passive") or seen.get("bus_off"):
        advice = (
            "frames are disturbed: check both terminators (60 ohms with power off), stubs below 0.3 m, the "
            "shield's one ground, and a node with another bit rate"
        )
        return limited(value, advice)
    return ok(value)


def send_queue(channel: str, root: Path) -> ItemResult:
    """Look at the length of the link's send queue: the kernel's 10 frames do not hold a busy tick."""
    length = int(small_text(root / f"sys/class/net/{channel}/tx_queue_len") or 0)
    if length < MIN_QUEUE:
        advice = f"ip link set {channel} txqueuelen {4 * MIN_QUEUE}"
        return limited(f"{length} frames", advice)
    return ok(f"{length} frames")


def card(channel: str, root: Path) -> ItemResult:
    """Look how the card is attached: the firmware of one on USB holds frames back for up to a millisecond."""
    device = root / f"sys/class/net/{channel}/device"
    bus, driver = (_target(device / name) for name in ("subsystem", "driver"))
    value = f"{driver or 'no driver'}, on {bus or 'no bus: a virtual link'}"
    if bus == "usb":
        advice = "its firmware and USB add up to 1 ms, a whole tick: use a card on PCIe, or loop.rate = 500"
        return limited(value, advice)
    if not bus:
        return limited(value, "attach a card to run hardware")
    return ok(value)


def interrupt_thread(channel: str, priority: int, cpu: int, root: Path) -> ItemResult:
    """Look whether the link's interrupt thread can run while the loop (`priority`, on `cpu`) does."""
    threads = [*_interrupt_threads(channel, root)]
    if not threads:
        return limited(
            "none of that name",
            "boot a PREEMPT_RT kernel, or with threadirqs: interrupts then have priorities",
        )
    pid, number, found = min(threads, key=lambda thread: thread[2])
    cores = _cores(small_text(root / f"proc/irq/{number}/smp_affinity_list"))
    value = f"irq {number} with priority {found}, the loop has {priority}"
    if found > priority or (cpu >= 0 and cores and cpu not in cores):
        return ok(value)
    advice = f"frames wait behind the loop: chrt -f -p {min(99, priority + 5)} {pid}"
    if cpu >= 0:
        advice += f", or keep it off core {cpu}: /proc/irq/{number}/smp_affinity_list"
    return limited(value, advice)


def _interrupt_threads(channel: str, root: Path) -> Iterator[tuple[int, int, int]]:
    """Yield process id, interrupt number and priority of the threads named irq/NUMBER-CHANNEL."""
    for folder in sorted((root / "proc").glob("[0-9]*")):
        number, _, name = small_text(folder / "comm").removeprefix("irq/").partition("-")
        if name == channel and number.isdigit():
            fields = small_text(folder / "stat").rpartition(")")[2].split()
            yield int(folder.name), int(number), int(fields[_RT_PRIORITY])


def _info(link: Mapping[str, Any]) -> Mapping[str, Any]:
    found: Mapping[str, Any] = link.get("linkinfo", {}).get("info_data", {})
    return found


def _ip(channel: str) -> str:
    command = ["ip", "-details", "-statistics", "-json", "link", "show", channel]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_LINK_TIME_LIMIT)
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or f"ip ended with {done.returncode}")
    return done.stdout


def _cores(text: str) -> set[int]:
    """Return the cores of a list such as 1,4-6."""
    spans = (part.partition("-") for part in text.split(",") if part.strip() and part[0].isdigit())
    return {core for first, _, last in spans for core in range(int(first), int(last or first) + 1)}


def _target(path: Path) -> str:
    return path.resolve().name if path.exists() else ""
