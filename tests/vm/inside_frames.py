"""The driver alone on the emulated card, in the guest: `python -m tests.vm.inside_frames`.

A loop of nothing but the driver's tick, in real-time scheduling, against the simulated nodes in a
separate process on another card: losses, answer times, and the reaction of the valve node to each fault of
the bus. Rows go to /host/rows, one JSON a line. Nothing is imported here that is not needed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drivers.canopen.driver import CanopenDriver
from drivers.canopen.frames import bus_load
from drivers.canopen.settings import CanopenSettings
from tests.benchmarks.row import Row
from tests.drivers.canopen.frame_classes import CLASSES
from tests.vm.can_bits import bits_of
from tests.vm.driver_loop import DriverLoop, in_real_time, times
from tests.vm.guest import (
    COMMAND,
    DRIVER_OF_CARDS,
    EMERGENCY,
    GREATEST_SHARE,
    OTHERS,
    PLACE,
    POSITIONS,
    SUPPLY,
    SYNC,
    bring_links_up,
    busy_time,
    keep,
    keep_journal,
    run,
    say,
    start_nodes,
    wait_until,
)
from tests.vm.guest_bus import Frame, Listener, interface_counters, matches, send, switch_link

WATCHDOG = 0.02
LOST = 24.0
"""ms in which the valve node's watchdog must have released the valves: its own 20, and two ticks."""
HELD_UP = 5e-4
"""s by which no tick may begin late: nothing else runs here for so long, unless the kernel does."""
TOLD = 4.0
"""ms in which the driver must have sent the passive command when the interface reports the fault."""

# Load --------------------------------------------------------------------------------------------------


def measure(title: str, loop: DriverLoop, seconds: float, wire: str, ends: tuple[str, ...]) -> list[Row]:
    """Run for `seconds`; `wire` is where all frames are seen, `ends` the bench's and the nodes' interface."""
    counter = Listener(wire, (SYNC, COMMAND, *POSITIONS, *OTHERS), 4096)
    _reopen(loop)  # while nothing ran the node's watchdog has struck
    loop.run(200)  # everything has been called
    loop.forget()
    before = {name: getattr(loop.driver.counters, name) for name in (*CLASSES, "frames", "syncs", "missing")}
    links, seen, busy = interface_counters(*ends, wire), matches(wire), busy_time()
    ticks, begun = round(seconds / loop.period), time.monotonic()
    loop.run(ticks)
    lasted, used = time.monotonic() - begun, busy_time() - busy
    links_after, seen_after = interface_counters(*ends, wire), matches(wire)
    new = {name: getattr(loop.driver.counters, name) - before[name] for name in before}
    frames = {i: seen_after.get(i, 0) - seen.get(i, 0) for i in (SYNC, COMMAND, *POSITIONS, *OTHERS)}
    more = {name: {w: links_after[name][w] - links[name][w] for w in links[name]} for name in links}
    counter.close()
    return [
        Row(title, "loop", 1.0 / loop.period, "Hz", f"{ticks} ticks in {lasted:.2f} guest seconds"),
        Row(
            title,
            "processor of the guest",
            100.0 * used / lasted,
            "%",
            "1 GIPS; loop and nodes",
            at_most=GREATEST_SHARE,
        ),
        times(title, "wake-up", loop.lateness),
        Row(
            title,
            f"ticks started over {1e3 * HELD_UP:g} ms late",
            sum(late > HELD_UP for late in loop.lateness),
            f"of {ticks}",
            at_most=0,
        ),
        times(title, "read: SYNC out, three positions in", loop.reading),
        times(title, "write: command out", loop.writing),
        Row(title, "ticks without all three positions", loop.old, f"of {ticks}", at_most=0),
        *_sums(title, ticks, new, frames, more, wire, ends),
    ]


def _sums(
    title: str,
    ticks: int,
    new: dict[str, int],
    frames: dict[int, int],
    links: dict[str, dict[str, int]],
    wire: str,
    ends: tuple[str, ...],
) -> list[Row]:
    positions = sum(frames[i] for i in POSITIONS)
    classes = sum(new[name] for name in CLASSES)
    rows = [
        Row(
            title,
            "driver: frames less those of its classes",
            new["frames"] - classes,
            f"of {new['frames']}",
            f"positions {new['positions']}, heartbeats {new['heartbeats']}, inputs {new['inputs']}, "
            f"pressures {new['pressures']}",
            0,
            0,
        ),
        Row(title, "samples missing or late", new["missing"] + new["late"], f"of {3 * ticks}", "", 0, 0),
        Row(title, "wire: SYNCs less ticks", frames[SYNC] - ticks, f"of {ticks}", "", 0, 0),
        Row(title, "wire: commands less ticks", frames[COMMAND] - ticks, f"of {ticks}", "", 0, 0),
        Row(
            title,
            "wire: positions less three for each SYNC",
            positions - 3 * frames[SYNC],
            f"of {positions}",
            "",
            0,
            0,
        ),
    ]
    return rows + (_kernel_sums(title, links, wire, ends, sum(frames.values())) if len(ends) == 2 else [])


def _kernel_sums(
    title: str, links: dict[str, dict[str, int]], wire: str, ends: tuple[str, ...], seen: int
) -> list[Row]:
    """Return the sums of the kernel's counters; `seen` frames were identified on the wire."""
    (bench, nodes), dropped = ends, 0
    for link in links.values():
        dropped += sum(link[what] for what in link if what not in ("tx_packets", "rx_packets"))
    sent, answered = links[bench]["tx_packets"], links[nodes]["tx_packets"]
    return [
        Row(
            title,
            "kernel: frames lost, bench to nodes",
            sent - links[nodes]["rx_packets"],
            f"of {sent}",
            "",
            0,
            0,
        ),
        Row(
            title,
            "kernel: frames lost, nodes to bench",
            answered - links[bench]["rx_packets"],
            f"of {answered}",
            "",
            0,
            0,
        ),
        Row(
            title,
            "kernel: frames seen less those sent",
            links[wire]["rx_packets"] - sent - answered,
            f"of {sent + answered}",
            f"and {seen} by identifier",
            0,
            0,
        ),
        Row(title, "kernel: dropped, overruns, errors", dropped, "", "", 0, 0),
    ]


def look_at_wire(title: str, loop: DriverLoop, seconds: float, wire: str) -> list[Row]:
    """Look at each frame for a while: load, answers by the kernel's stamps, how true a sample's time is."""
    _reopen(loop)
    listener = Listener(wire)
    loop.forget()
    loop.run(round(seconds / loop.period))
    frames = list(listener.frames())
    listener.close()
    settings = loop.driver.settings
    load = 100.0 * sum(bits_of(f.identifier, f.data) for f in frames) / seconds / settings.bitrate
    most = 100.0 * bus_load(settings, loop.period, WATCHDOG)
    syncs = np.array([f.time for f in frames if f.identifier == SYNC])
    thirds = _thirds(frames)
    nearest = np.abs(np.subtract.outer(np.array(loop.sampled), syncs)).argmin(axis=1)
    errors = 1e6 * (np.array(loop.sampled) - syncs[nearest])
    return [
        Row(
            title,
            "bus load, frames really sent",
            load,
            "%",
            f"{len(frames) / seconds:.0f} frames a second, stuff bits counted",
            at_most=most,
        ),
        times(title, "SYNC to the third position, on the wire", thirds),
        Row(
            title,
            "a sample's time less its SYNC's, spread",
            float(np.std(errors)),
            "us",
            f"mean {np.mean(errors):+.1f}, from {errors.min():+.1f} to {errors.max():+.1f} us",
            at_most=2.0,
        ),
    ]


def _thirds(frames: list[Frame]) -> list[float]:
    found, start, seen = [], 0.0, 0
    for frame in frames:
        if frame.identifier == SYNC:
            start, seen = frame.time, 0
        elif start and frame.identifier in POSITIONS:
            seen += 1
            if seen == len(POSITIONS):
                found.append(frame.time - start)
    return found


# Faults ------------------------------------------------------------------------------------------------


class Prepared:
    """A command that waits, so that starting it takes no time from the loop."""

    def __init__(self, *command: str) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def prepare(self) -> None:
        """Start the shell that waits."""
        script = f"read -r go; exec {' '.join(self._command)}"
        self._process = subprocess.Popen(["bash", "-c", script], stdin=subprocess.PIPE)

    def go(self) -> None:
        """Let it run."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.write(b"\n")
            self._process.stdin.close()

    @property
    def done(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def end(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


class Fault(NamedTuple):
    """A fault: brought at once, or by a separate command."""

    at_once: Callable[[], object] | None
    command: Prepared | None
    mend: Callable[[], object]
    longest_ms: float | None
    """To the reaction at the valve node; None: there must be none."""


def _nothing() -> None:
    pass


def _netem(*how: str) -> Prepared:
    return Prepared("tc", "qdisc", "replace", "dev", "can0", "root", "netem", *how)


def _calm() -> None:
    run("tc", "qdisc", "del", "dev", "can0", "root")


def _plug() -> None:
    Path("/sys/bus/pci/rescan").write_text("1")
    _link_back()


def _bind() -> None:
    (DRIVER_OF_CARDS / "bind").write_text(PLACE)
    _link_back()


def _put() -> None:
    Path("/dev/ttyS1").write_text("put card0\n")
    _link_back()


def _link_back() -> None:
    wait_until(Path("/sys/class/net/can0").exists, "the card's interface")
    run("udevadm", "settle")
    run("systemctl", "restart", "golfbench-can@can0")


def _babble(identifier: int, gap_ms: float) -> Prepared:
    return Prepared(
        "cangen", "can2", "-I", f"{identifier:03X}", "-L", "4", "-D", "00000000", "-g", f"{gap_ms:g}", "-i"
    )


FAULTS: dict[str, Fault] = {
    "every frame 0.1 ms later": Fault(None, _netem("delay", "100us"), _calm, None),
    "every twentieth frame doubled": Fault(None, _netem("duplicate", "5%"), _calm, None),
    "a frame in a hundred lost": Fault(None, _netem("loss", "1%"), _calm, None),
    "reordered, a fifth 0.3 ms later": Fault(None, _netem("delay", "300us", "reorder", "80%"), _calm, None),
    "a node babbles, 1000 foreign frames a second": Fault(None, _babble(0x555, 1.0), _nothing, None),
    "a node babbles as an encoder": Fault(None, _babble(0x282, 0.5), _nothing, None),
    "bus-off, an error frame": Fault(lambda: send("can0", 0x20000040, bytes(8)), None, _nothing, TOLD),
    "link down, then up": Fault(
        lambda: switch_link("can0", up=False), None, lambda: switch_link("can0", up=True), LOST
    ),
    "no room any more (ENOBUFS)": Fault(None, _netem("rate", "8kbit", "limit", "1"), _calm, 2 * LOST),
    "all frames of the bench lost": Fault(None, _netem("loss", "100%"), _calm, LOST),
    "every frame 30 ms later": Fault(None, _netem("delay", "30ms"), _calm, 2 * LOST),
    "driver unbound from the card, then bound again": Fault(
        None, Prepared("echo", PLACE, f">{DRIVER_OF_CARDS / 'unbind'}"), _bind, LOST
    ),
    "card taken out by the kernel, then found again": Fault(
        None, Prepared("echo", "1", ">/sys/class/net/can0/device/remove"), _plug, LOST
    ),
    "card pulled out of its slot, then put back": Fault(
        None, Prepared("echo", "pull", "card0", ">/dev/ttyS1"), _put, LOST
    ),
}
_TAKEN = (_bind, _plug, _put)
"""Mends of a card that is removed with a delay: counted from the last command on the wire."""
BEFORE, AFTER = 0.1, 0.4
"""s of ticks before a fault and after it."""


def provoke(loop: DriverLoop, name: str, fault: Fault) -> Row:
    """Bring one fault while the valves are open, record the valve node's reaction, mend it, open anew."""
    driver, begun = loop.driver, [0.0]
    counters = driver.counters
    if fault.command is not None:
        fault.command.prepare()
    _reopen(loop)
    witness = Listener("can2", (COMMAND, EMERGENCY))
    lost = {n: getattr(counters, n) for n in ("missing", "late", "duplicates", "foreign", "no_room")}
    loop.run(round(BEFORE / loop.period))

    def each(tick: int) -> None:
        if tick == 0:
            begun[0] = time.monotonic()
            if fault.at_once is not None:
                fault.at_once()
            if fault.command is not None:
                fault.command.go()
        elif fault.command is not None and begun[0] and not fault.command.done and fault.mend is _calm:
            begun[0] = time.monotonic()  # counted from when tc has ended

    loop.forget()
    loop.run(round((AFTER if fault.mend not in _TAKEN else 3.0) / loop.period), each)
    frames, lateness = list(witness.frames()), loop.lateness
    witness.close()
    device_fault, operational = driver.fault, driver.operational
    if fault.command is not None:
        fault.command.end()
    fault.mend()
    first = _reaction(frames, begun[0])
    start = begun[0]
    if fault.mend in _TAKEN:
        commands = [f.time for f in frames if f.identifier == COMMAND and f.data[6] & SUPPLY]
        start = commands[-1] if commands else start
    again = _reopen(loop)
    counts = ", ".join(
        f"{n} {getattr(counters, n) - lost[n]}" for n in lost if getattr(counters, n) - lost[n]
    )
    what = "" if first is None else "passive command; " if first.identifier == COMMAND else "node by itself; "
    held_up = 1e3 * max(lateness)
    note = f"{what}{device_fault or 'operational'}; {counts or 'nothing counted'}; {again}"
    if held_up > 1e3 * loop.period:
        note += f"; the loop was held up for {held_up:.1f} ms"
    if fault.longest_ms is None:
        return Row(_FAULTS, name, float(first is not None or not operational), "reactions", note, at_most=0)
    milliseconds = float("nan") if first is None else 1e3 * (first.time - start)
    return Row(_FAULTS, name, milliseconds, "ms", note, at_most=fault.longest_ms)


_FAULTS = "faults, ms to the reaction at the valve node"


def _reaction(frames: list[Frame], after: float) -> Frame | None:
    """Return the first frame that indicates closed valves: a passive command, or the node's own emergency."""
    for frame in frames:
        passive = frame.identifier == COMMAND and not frame.data[6] & SUPPLY
        if frame.time > after and (passive or (frame.identifier == EMERGENCY and frame.data[:2] != b"\0\0")):
            return frame
    return None


def _reopen(loop: DriverLoop) -> str:
    """Close and open the driver as a reset does; return how that went."""
    driver = loop.driver
    driver.close()
    deadline = time.monotonic() + 10.0
    while True:
        try:
            driver.open()
            break
        except Exception as error:  # nodes find their own bus again within a second
            if time.monotonic() > deadline:
                return f"not opened again: {error}"
            time.sleep(0.2)
    loop.run(20)
    return "opened again" if driver.operational else f"opened again, then {driver.fault}"


# The whole ---------------------------------------------------------------------------------------------


def main() -> int:
    """Set up, measure, provoke."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rate", type=float, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--interface", choices=("can", "vcan"), required=True)
    parser.add_argument("--faults", nargs="*", default=list(FAULTS))
    options = parser.parse_args()
    try:
        bench, nodes, wire = bring_links_up(options.interface)
        start_nodes(options.rate, nodes)
        say("nodes live")
        settings = CanopenSettings("socketcan", bench, sync_timeout=0.5 / options.rate, sdo_timeout=1.0)
        driver = CanopenDriver(settings, period=1.0 / options.rate, watchdog=WATCHDOG)
        driver.open()
        in_real_time()
        loop, is_card = DriverLoop(driver), options.interface == "can"
        ends = (bench, nodes) if is_card else ()
        title = f"driver and nodes on {'emulated CAN cards' if is_card else 'vcan'}, virtual time"
        keep(measure(title, loop, options.seconds, wire, ends))
        say("load measured")
        keep(look_at_wire(title, loop, min(3.0, options.seconds), wire))
        say("wire looked at")
        for name in options.faults if is_card else ():
            keep([provoke(loop, name, FAULTS[name])])
            say(name)
        driver.close()
    except Exception:
        traceback.print_exc()
        return 1
    finally:
        keep_journal()
    return 0


if __name__ == "__main__":
    sys.exit(main())
