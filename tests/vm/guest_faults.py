"""Faults in the middle of a swing: the time to the reaction at the valve node, and what each ended in."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bench.base.errors import BenchError
from bench.base.lifecycle import Cause, Phase, Reaction, State
from tests.benchmarks.row import Row
from tests.vm.guest import COMMAND, DRIVER_OF_CARDS, EMERGENCY, PLACE, SUPPLY, run, wait_until
from tests.vm.guest_bench import RATE, GuestBench
from tests.vm.guest_bus import Listener, send, switch_link

TITLE = "faults in mid-swing, to the reaction at the valve node"
CARD = "can0"
"""The bench's; the nodes are on can1, the witness and babbling nodes on can2."""
_SETTLING = 0.5
"""s after a mend: removal of a queueing discipline may itself lose frames."""
_NEWS = 1.2
"""s after which the status has the driver's counters; it gets them once a second."""
_HEALTHY = ("frames", "syncs", "positions", "inputs", "pressures", "heartbeats", "services")
_AT_REST = 0.05
"""rad/s."""

Bring = Callable[[], float]
"""Brings a fault and returns the instant from which on it stood."""


class Fault(NamedTuple):
    """Something that goes wrong."""

    bring: Bring
    mend: Callable[[], object]
    longest_ms: float | None
    """To the reaction; None: there must be none, the swing completes."""


def provoke_all(bench: GuestBench, names: Sequence[str]) -> list[Row]:
    """Bring each fault as the robot passes through its downswing; faults without a reset come first."""
    rows = []
    for name in names or FAULTS:
        try:
            rows += provoke(bench, name, FAULTS[name])
        except (RuntimeError, OSError, BenchError) as error:  # the next ones are still worth a look
            print(f"{name}: {error}", flush=True)
            rows.append(Row(TITLE, name, float("nan"), "", str(error), at_most=0))
    return [
        *rows,
        Row(TITLE, "energy at a stop, all of it", 100 * bench.stop_share(), "% of its rating", at_most=100),
        Row(TITLE, "pressure of a chamber", 100 * bench.pressure_share(), "% of its rating", at_most=100),
    ]


def provoke(bench: GuestBench, name: str, fault: Fault) -> list[Row]:
    """Swing, bring one fault, watch to the end, mend it."""
    bench.take_address()
    time.sleep(0.5)
    before = bench.client.status()["device"]["counters"]
    witness = Listener("can2", (COMMAND, EMERGENCY))
    bench.swing()
    bench.wait_phase(Phase.DOWNSWING)
    bench.ring.read()
    try:
        return _watch(bench, name, fault, witness, before)
    finally:
        witness.close()
        fault.mend()
        time.sleep(_SETTLING)


def _watch(
    bench: GuestBench, name: str, fault: Fault, witness: Listener, before: dict[str, int]
) -> list[Row]:
    """`before` are the driver's counters before the swing."""
    begun = fault.bring()
    time.sleep(0.3)
    frames = [frame for frame in witness.frames() if frame.time > begun - 0.02]
    cycles = bench.ring.read()
    reacting = cycles[cycles["reaction"] > Reaction.COMPLETE]
    decided = float(reacting["time"][0]) if len(reacting) else float("inf")
    reacted = min(
        (
            frame.time
            for frame in frames
            if frame.time > begun
            and (
                (frame.identifier == EMERGENCY and frame.data[:2] != b"\0\0")
                or (frame.identifier == COMMAND and (frame.time > decided or not frame.data[6] & SUPPLY))
            )
        ),
        default=None,
    )
    ending = _ending(bench)
    later = bench.ring.read()
    time.sleep(_NEWS)
    counted = _more(bench.client.status()["device"]["counters"], before)
    cause = Cause(int(cycles["cause"][-1])).name if len(cycles) else "?"
    first = Reaction(int(reacting["reaction"][0])).name if len(reacting) else "none"
    note = f"{first}, {cause}; ended in {ending}; {counted}"
    print(f"{time.monotonic():.1f} s: {name}: {note}", flush=True)
    if fault.longest_ms is None:
        stops = float(np.any(np.concatenate([cycles, later])["reaction"] > Reaction.COMPLETE))
        return [Row(TITLE, name, stops, "reactions", note, at_most=0)]
    milliseconds = float("nan") if reacted is None else 1e3 * (reacted - begun)
    return [Row(TITLE, name, milliseconds, "ms", note, at_most=fault.longest_ms)]


def _more(counters: dict[str, int], before: dict[str, int]) -> str:
    """Return what of the driver's counters of trouble went up, by how many."""
    new = {name: count - before.get(name, 0) for name, count in counters.items() if name not in _HEALTHY}
    told = [f"{name.replace('_', ' ')} {count}" for name, count in new.items() if count]
    return ", ".join(told) or "nothing counted"


def _ending(bench: GuestBench) -> str:
    """Wait until the robot rests or holds its address; return where it ended."""

    def rests() -> bool:
        record = bench.now()
        if record["state"] in (State.SWINGING, State.RECOVERING):
            return False
        return bool(abs(bench.report()["truth"]["plant_velocity"]).max() < _AT_REST)

    took = wait_until(rests, "the robot at rest", 40.0)
    return f"{State(int(bench.now()['state'])).name} after {took:.1f} s"


# What goes wrong ---------------------------------------------------------------------------------------


def _now(do: Callable[[], object]) -> Bring:
    def bring() -> float:
        begun = time.monotonic()
        do()
        return begun

    return bring


def _then(do: Callable[[], object]) -> Bring:
    """Return a fault brought by `do`, counted from its return."""

    def bring() -> float:
        do()
        return time.monotonic()

    return bring


def _disturb(*how: str) -> Bring:
    return _then(lambda: run("tc", "qdisc", "replace", "dev", CARD, "root", "netem", *how))


def _calm() -> None:
    run("tc", "qdisc", "del", "dev", CARD, "root")


def _unplug() -> None:
    Path("/sys/class/net", CARD, "device/remove").write_text("1")


def _plug() -> None:
    Path("/sys/bus/pci/rescan").write_text("1")
    _await_link()


def _unbind() -> None:
    """Take the card from its kernel driver; the card stays where it is."""
    (DRIVER_OF_CARDS / "unbind").write_text(PLACE)


def _bind() -> None:
    (DRIVER_OF_CARDS / "bind").write_text(PLACE)
    _await_link()


def _pull() -> None:
    """Let the host pull the card out (PCI hot-plug)."""
    Path("/dev/ttyS1").write_text("pull card0\n")


def _put() -> None:
    Path("/dev/ttyS1").write_text("put card0\n")
    _await_link()


def _await_link() -> None:
    """The card is back under its name; its unit sets the link up again."""
    wait_until(lambda: Path("/sys/class/net", CARD).exists(), "the card's interface")
    run("udevadm", "settle")
    run("systemctl", "restart", f"golfbench-can@{CARD}")


def _pull_and_wait() -> float:
    _pull()
    wait_until(lambda: not Path("/sys/class/net", CARD).exists(), "the card gone")
    return time.monotonic()


class _Babble:
    """A node that sends continuously."""

    def __init__(self, identifier: int, gap: float) -> None:
        self._identifier, self._gap = identifier, gap
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self) -> float:
        command = [
            "cangen",
            "can2",
            "-I",
            f"{self._identifier:03X}",
            "-L",
            "4",
            "-D",
            "00000000",
            "-g",
            f"{self._gap:g}",
            "-i",
        ]
        begun = time.monotonic()
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        return begun

    def end(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()


def _nothing() -> None:
    pass


_FOREIGN, _AS_ENCODER = _Babble(0x555, 1.0), _Babble(0x282, 0.2)
TICKS = 2 * 1e3 / RATE
"""ms of two ticks."""
WATCHDOG = 20.0 + TICKS
"""ms in which the valve node's watchdog must have released the valves."""

FAULTS: dict[str, Fault] = {
    "frames delayed by 0.1 ms": Fault(_disturb("delay", "100us"), _calm, None),
    "every twentieth frame doubled": Fault(_disturb("duplicate", "5%"), _calm, None),
    "a frame in two hundred lost": Fault(_disturb("loss", "0.5%"), _calm, None),
    "foreign frames, 1000 a second": Fault(_FOREIGN.begin, _FOREIGN.end, None),
    "no room (ENOBUFS)": Fault(_disturb("rate", "8kbit", "limit", "1"), _calm, 2 * WATCHDOG),
    "all frames of the bench lost": Fault(_disturb("loss", "100%"), _calm, WATCHDOG),
    "frames delayed by 5 ms and reordered": Fault(
        _disturb("delay", "5ms", "2ms", "reorder", "30%"), _calm, 3 * WATCHDOG
    ),
    # On the guest's one processor nobody speaks between SYNC and answers: all of it is told apart. What
    # follows where a wrong sample gets through is seen in step: `tests.benchmarks canopen_reactions`.
    "a node babbles as an encoder": Fault(_AS_ENCODER.begin, _AS_ENCODER.end, None),
    "driver unbound from the card, then bound again": Fault(_now(_unbind), _bind, WATCHDOG),
    "card taken out by the kernel, then found again": Fault(_now(_unplug), _plug, WATCHDOG),
    "card pulled out, then put back": Fault(_pull_and_wait, _put, WATCHDOG),
    "bus-off, an error frame": Fault(_now(lambda: send(CARD, 0x20000040, bytes(8))), _nothing, TICKS),
    "link down, then up": Fault(
        _now(lambda: switch_link(CARD, up=False)), lambda: switch_link(CARD, up=True), WATCHDOG
    ),
}

USUAL = ("bus-off, an error frame", "link down, then up", "card pulled out, then put back")
"""Those that every run brings."""
