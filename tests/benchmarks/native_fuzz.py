"""Random and mutated frames at compiled CANopen ticks and at those in Python: they do the same.

Nothing may escape, move or go uncounted.

    python -m tests.benchmarks native_fuzz --frames 250000 --seed 1

Both drivers are on separate sockets and get the same frames, as the kernel gives them: proper ones,
frames with bits turned, wrong lengths, extended identifiers, remote and error frames, random bytes, and reads
that are cut short. In some episodes a fault latches, in the others it is forgotten, so that compiled code is
reached again. Commands are the passive one, or others until the fault.
"""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from drivers.base import PASSIVE, Command
from drivers.can_bus import FRAME
from tests.benchmarks.frame_fuzz import make_frame
from tests.benchmarks.row import Row, numbers
from tests.drivers.canopen.frame_classes import CLASSES
from tests.drivers.canopen.socket_rig import MOVING, NODE, SETTINGS, Found, Rig, found

_PATIENT = replace(SETTINGS, sync_timeout=0.25)
"""An answer is missing because it was not sent, not because this machine is busy."""
_TICKS = 150
"""Ticks of an episode."""
_MISSING = 0.0002
"""Share of positions that are not sent."""
_CUT = 0.002
"""Share of frames that the kernel cuts short."""


@dataclass
class NativeFuzz:
    """Result of a run."""

    frames: int = 0
    """Given to each driver."""
    ticks: int = 0
    declined: int = 0
    """Calls that compiled code left to Python."""
    latched: int = 0
    """Episodes that ended with a fault."""
    differences: list[str] = field(default_factory=list)
    escaped: list[str] = field(default_factory=list)
    motions: int = 0
    """Command frames other than passive where nothing else was commanded, or after a fault."""
    uncounted: int = 0
    """Frames in no class."""
    duration: float = 0.0


def make_ticks(chance: random.Random, count: int, odd: float) -> list[list[bytes]]:
    """Return the frames that follow each SYNC; `odd` of them on average are not proper."""
    ticks = []
    for k in range(count):
        frames = [
            FRAME.pack(0x280 + node, 4, chance.randrange(2**17).to_bytes(4, "little"))
            for node in SETTINGS.encoders.nodes
            if chance.random() >= _MISSING
        ]
        if k % 20 == 0:
            frames += [FRAME.pack(0x700 + node, 1, b"\x05") for node in (*SETTINGS.encoders.nodes, NODE)]
        if k % 10 == 5:
            frames.append(FRAME.pack(0x180 + NODE, 1, chance.randbytes(1)))
            frames.append(FRAME.pack(0x280 + NODE, 8, chance.randbytes(8)))
            frames.append(FRAME.pack(0x380 + NODE, 6, chance.randbytes(6)))
        while chance.random() < odd / (1.0 + odd):
            whole = make_frame(chance)
            frames.append(whole[: chance.randrange(1, FRAME.size)] if chance.random() < _CUT else whole)
        chance.shuffle(frames)
        ticks.append(frames)
    return ticks


def fuzz(frames: int, seed: int) -> NativeFuzz:
    """Run episodes until so many frames were given to each of the two drivers."""
    chance, result = random.Random(seed), NativeFuzz()
    start = time.perf_counter()
    while result.frames < frames and len(result.differences) < 5:
        ticks = make_ticks(chance, _TICKS, chance.choice((0.01, 0.1, 1.0, 8.0)))
        _run_episode(ticks, result, latching=chance.random() < 0.5, command=chance.choice((PASSIVE, MOVING)))
    result.duration = time.perf_counter() - start
    return result


def _run_episode(ticks: list[list[bytes]], result: NativeFuzz, *, latching: bool, command: Command) -> None:
    both: list[Found] = []
    for native in (True, False):
        rig = Rig(lambda k: ticks[k] if k < len(ticks) else [], native=native, settings=_PATIENT)
        passive = rig.driver._passive_frame
        try:
            for _ in ticks:
                if not latching:
                    rig.driver.fault = ""
                before = len(rig.nodes.heard)
                rig.tick(command)
                rig.nodes.wait_for_command(before)
                if command is PASSIVE or rig.driver.fault:
                    commands = [one for one in rig.nodes.heard[before:] if one[:4] == passive[:4]]
                    result.motions += commands != [passive]
            both.append(found(rig))
            result.uncounted += abs(
                rig.driver.counters.frames - sum(getattr(rig.driver.counters, name) for name in CLASSES)
            )
            result.declined += len(rig.declined) if native else 0
        except Exception as error:  # what this is about
            result.escaped.append(f"{'compiled' if native else 'Python'}: {error!r}")
        finally:
            rig.end()
    result.ticks += len(ticks)
    result.frames += sum(map(len, ticks))
    if len(both) == 2:
        ours, theirs = both
        result.latched += bool(ours.fault)
        result.differences += [
            f"{name}: compiled {getattr(ours, name)!r:.300}, Python {getattr(theirs, name)!r:.300}"
            for name in Found._fields
            if getattr(ours, name) != getattr(theirs, name)
        ]


def run(arguments: Sequence[str]) -> list[Row]:
    """Fuzz and return the results."""
    chosen = numbers("native_fuzz", arguments, frames=250_000, seed=1)
    result = fuzz(chosen.frames, chosen.seed)
    title = f"{result.frames} frames at compiled ticks and at Python's, seed {chosen.seed}"
    compiled = 1.0 - result.declined / (2 * result.ticks)
    return [
        Row(title, "differences", len(result.differences), "", "; ".join(result.differences[:3]), at_most=0),
        Row(title, "exceptions", len(result.escaped), "", "; ".join(result.escaped[:3]), at_most=0),
        Row(title, "commands other than passive", result.motions, "", "", at_most=0),
        Row(title, "frames in no class", result.uncounted, "", "", at_most=0),
        Row(title, "calls done by compiled code", 100.0 * compiled, "%", f"of {2 * result.ticks}"),
        Row(title, "episodes that latched", result.latched, "", f"of {result.ticks // _TICKS}"),
        Row(title, "frames a second", result.frames / result.duration, ""),
    ]
