"""Random and mutated frames at the CANopen driver: nothing escapes, nothing moves, every frame is counted.

    python -m tests.benchmarks frame_fuzz --frames 1000000 --seed 1

Frames of the bench with bits turned, lengths changed, identifiers swapped, and frames of random bytes come
between and instead of the nodes' own. The driver, commanded passive, must send the passive command and
nothing else, raise nothing, return readings that fit the record, and count each frame in one class.
"""

from __future__ import annotations

import errno
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

from drivers.base import PASSIVE
from drivers.base.compiled import new_record
from drivers.base.records import READINGS, pack_readings
from drivers.can_bus import FRAME
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings
from tests.benchmarks.row import Row, numbers
from tests.drivers.canopen.frame_classes import CLASSES

PERIOD = 0.001
_KNOWN = (
    *(*range(0x281, 0x284), 0x18A, 0x28A, 0x38A, *range(0x701, 0x704), 0x70A, *range(0x81, 0x84), 0x8A),
    *(0x581, 0x58A, 0x000, 0x080, 0x20A, 0x60A),
)
_FLAGS = (0, 0, 0, 0, 0, 0x20000000, 0x40000000, 0x80000000, 0xE0000000)
_FAILURES = 0.001
"""Share of calls to the interface that fail."""


@dataclass
class Result:
    """Result of a run."""

    frames: int = 0
    """Given to the driver, the proper answers among them."""
    ticks: int = 0
    counted: int = 0
    classes: dict[str, int] = field(default_factory=dict)
    escaped: list[str] = field(default_factory=list)
    """Exceptions."""
    motions: int = 0
    """Command frames other than the passive one."""
    duration: float = 0.0


def make_frame(chance: random.Random) -> bytes:
    """Return a frame as the kernel might give it, proper or not."""
    way = chance.random()
    if way < 0.2:  # anything at all
        return chance.randbytes(FRAME.size)
    length = chance.choice((0, 1, 2, 4, 7, 8, 8, chance.randrange(256)))
    whole = bytearray(FRAME.pack(chance.choice(_KNOWN) | chance.choice(_FLAGS), length, chance.randbytes(8)))
    if way < 0.5:
        for _ in range(chance.randrange(1, 4)):
            whole[chance.randrange(len(whole))] ^= 1 << chance.randrange(8)
    return bytes(whole)


class FuzzedLink:
    """A wire on which a few frames come in every tick, made from `random`."""

    def __init__(self, source: random.Random, frames: int) -> None:
        self._random, self.left = source, frames
        self.given = 0
        self.commands: set[bytes] = set()
        self._waiting: list[bytes] = []

    def send_frame(self, whole: bytes) -> float:
        identifier, chance = FRAME.unpack(whole)[0], self._random
        if chance.random() < _FAILURES:
            raise OSError(chance.choice((errno.ENOBUFS, errno.ENETDOWN, errno.EIO)), "fuzz")
        if identifier == 0x80:
            answers = [number for number in (1, 2, 3) if chance.random() < 0.9]
            self._waiting += [FRAME.pack(0x280 + number, 4, chance.randbytes(2)) for number in answers]
            count = min(self._random.randrange(0, 12), self.left)
            self.left -= count
            self._waiting += [make_frame(chance) for _ in range(count)]
            chance.shuffle(self._waiting)
        elif identifier == 0x20A:
            self.commands.add(whole)
        return 0.0

    def receive_frame(self, timeout: float) -> bytes | None:
        if self._random.random() < _FAILURES:
            raise OSError(errno.ENETDOWN, "fuzz")
        if not self._waiting or (timeout and self._random.random() < 0.1):
            return None
        self.given += 1
        return self._waiting.pop()

    def sync_time(self, sent: float) -> float:
        return sent

    def shutdown(self) -> None:
        self._waiting.clear()


class FuzzedDriver(CanopenDriver):
    """The driver on a wire without nodes to set up."""

    def _begin(self) -> None:
        self._listening = True


def fuzz(frames: int, seed: int, *, listening: bool = True) -> Result:
    """Give the driver so many frames; `listening` False forgets trouble, so that all stays operational."""
    link, result = FuzzedLink(random.Random(seed), frames), Result()
    driver = FuzzedDriver(
        CanopenSettings(interface="local_socket"), period=PERIOD, open_bus=lambda *_: link, clock=lambda: 0.0
    )
    driver.open()
    record, passive = new_record(READINGS), driver._passive_frame
    start = time.perf_counter()
    while link.left or link._waiting:
        now = result.ticks * PERIOD
        result.ticks += 1
        if not listening:
            driver.fault = ""
        try:
            readings = driver.read(now)
            pack_readings(readings, record)
            if driver.write(PASSIVE) != PASSIVE:
                raise ValueError("it applied more than the passive command")
        except Exception as error:  # what this is about
            result.escaped.append(repr(error))
    result.duration = time.perf_counter() - start
    result.motions = len(link.commands - {passive})
    result.classes = {name: getattr(driver.counters, name) for name in CLASSES}
    result.counted = sum(result.classes.values())
    result.frames = link.given
    driver.close()
    return result


def run(arguments: Sequence[str]) -> list[Row]:
    """Fuzz and return the results."""
    chosen = numbers("frame_fuzz", arguments, frames=1_000_000, seed=1)
    title, rows = f"{chosen.frames} frames at the CANopen driver, seed {chosen.seed}", []
    for name, listening in (("latching", True), ("never latched", False)):
        result = fuzz(chosen.frames // 2, chosen.seed + (not listening), listening=listening)
        note = ", ".join(f"{kind} {count}" for kind, count in result.classes.items())
        wrong = "; ".join(result.escaped[:3])
        rows += [
            Row(title, f"{name}: frames in no class", result.frames - result.counted, "", note, 0, 0),
            Row(title, f"{name}: exceptions", len(result.escaped), "", wrong, at_most=0),
            Row(title, f"{name}: commands other than passive", result.motions, "", at_most=0),
            Row(
                title,
                f"{name}: frames a second",
                result.frames / result.duration,
                "",
                f"{result.ticks} ticks",
            ),
        ]
    return rows
