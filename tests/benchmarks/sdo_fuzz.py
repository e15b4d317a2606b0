"""Startups of the CANopen driver with nodes that lie: every end is an open driver or a named refusal.

    python -m tests.benchmarks sdo_fuzz --dialogues 100000 --seed 1

Some of the nodes' answers are replaced: other objects, sizes and values, abort codes of any kind, segments
without an end, fragments, frames of other nodes, silence. The nodes are those of a predecessor's settings, so
that the startup writes all that it can write; outputs are not inverted, which a lie could hide. Nothing may
escape but a refusal that names the node, nothing may be energised, and each startup ends within a bounded
time of the bus.
"""

from __future__ import annotations

import logging
import random
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from drivers.base import PASSIVE, DriverError
from drivers.canopen.scan import scan
from sim.nodes.personality import ENCODER, IO, Personality, find_personality
from tests.benchmarks.row import Row, numbers
from tests.drivers.canopen.in_step import SETTINGS, DriverInStep, Wire, nodes_plan

_ABORTS = (
    0x05040000,
    0x06010000,
    0x06010002,
    0x06020000,
    0x06040041,
    0x06070010,
    0x06090011,
    0x06090031,
    0x08000022,
)
_LONGEST = 120.0
"""Bus time that a startup or scan may take, s."""


@dataclass
class FuzzedStartups:
    """Result of a run."""

    dialogues: int = 0
    """Answers of nodes to the driver, lies among them."""
    startups: int = 0
    opened: int = 0
    escaped: list[str] = field(default_factory=list)
    unnamed: list[str] = field(default_factory=list)
    """Refusals without the node or the interface."""
    energised: int = 0
    """Startups during which the valve node's outputs were energised."""
    slow: int = 0
    duration: float = 0.0


class LyingNodes:
    """A meddler of the wire that replaces a share of the SDO answers."""

    def __init__(self, source: random.Random, share: float) -> None:
        self._random, self._share = source, share
        self.dialogues = 0

    def __call__(self, identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if not 0x581 <= identifier <= 0x5FF:
            return [(identifier, data)]
        self.dialogues += 1
        if self._random.random() >= self._share:
            return [(identifier, data)]
        return self._lie(identifier, data)

    def _lie(self, identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        chance, location = self._random, data[1:4]
        match chance.randrange(9):
            case 0:
                return []
            case 1:
                code = chance.choice((*_ABORTS, chance.getrandbits(32)))
                return [(identifier, b"\x80" + location + code.to_bytes(4, "little"))]
            case 2:
                return [(identifier, chance.randbytes(chance.randrange(9)))]
            case 3:  # another value, in another size
                size = bytes([chance.choice((0x43, 0x47, 0x4B, 0x4F, 0x42))])
                return [(identifier, size + location + chance.randbytes(4))]
            case 4:  # segments are announced, and anything follows
                return [(identifier, bytes([chance.choice((0x40, 0x41))]) + location + chance.randbytes(4))]
            case 5:  # segments without an end
                return [(identifier, bytes([chance.choice((0x00, 0x10))]) + chance.randbytes(7))]
            case 6:
                return [(0x580 + chance.choice((1, 2, 3, 10)), data), (identifier, data)]
            case 7:
                return [(identifier, data)] * 2
            case _:
                changed = bytearray(data)
                changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
                return [(identifier, bytes(changed))]


def _inputs_inverted() -> Personality:
    inverted = find_personality("inverted-io", IO)
    return replace(inverted, objects=tuple(one for one in inverted.objects if one.index != 0x6202))


def fuzz(dialogues: int, seed: int) -> FuzzedStartups:
    """Start and scan with lying nodes until they have given `dialogues` answers."""
    source, result = random.Random(seed), FuzzedStartups()
    start = time.perf_counter()
    while result.dialogues < dialogues:
        plan = replace(
            nodes_plan(),
            encoder_personality=find_personality("reversed-17", ENCODER),
            io_personality=_inputs_inverted(),
        )
        wire = Wire(plan)
        wire.meddle = liar = LyingNodes(source, source.choice((0.001, 0.01, 0.1)))
        driver = DriverInStep(wire, SETTINGS)
        try:
            if source.random() < 0.1:
                scan(SETTINGS, 2**17, clock=lambda wire=wire: wire.now, open_bus=wire.opened)  # type: ignore[misc]
            else:
                driver.open()
                result.opened += 1
                result.energised += wire.in_force != PASSIVE
                driver.close()
        except DriverError as error:
            if "canopen: node" not in str(error) and "canopen: channel" not in str(error):
                result.unnamed.append(str(error))
        except Exception as error:  # what this is about
            result.escaped.append(f"{type(error).__name__}: {error}")
        result.dialogues += liar.dialogues
        result.startups += 1
        result.energised += driver.applied != PASSIVE
        result.slow += wire.now > _LONGEST
    result.duration = time.perf_counter() - start
    return result


def run(options: Sequence[str] = ()) -> list[Row]:
    """Return the results of a long run."""
    chosen = numbers("sdo_fuzz", options, dialogues=100_000, seed=1)
    logging.getLogger("canopen").setLevel(logging.CRITICAL + 1)  # the simulated nodes' view of lost answers
    result = fuzz(chosen.dialogues, chosen.seed)
    for text in (*result.escaped, *result.unnamed):
        print(text)
    title = "lying nodes"
    return [
        Row(title, "answers", result.dialogues, "", f"{result.startups} startups and scans"),
        Row(title, "startups that went through", result.opened, ""),
        Row(title, "exceptions", len(result.escaped), "", at_most=0),
        Row(title, "refusals without a name", len(result.unnamed), "", at_most=0),
        Row(title, "startups with energised outputs", result.energised, "", at_most=0),
        Row(title, "startups without an end", result.slow, "", at_most=0),
        Row(title, "answers a second", result.dialogues / result.duration, ""),
    ]
