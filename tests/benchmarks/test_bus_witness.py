"""What the witness of a bus counts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.can_bus import FRAME, LocalSocketBus
from tests.benchmarks.bus_witness import COMMAND, MARK, POSITIONS, SYNC, Witness, count
from tests.benchmarks.can_bits import bits_of


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[LocalSocketBus]:
    with LocalSocketBus(tmp_path / "can") as joined:
        yield joined


def test_frames_between_two_marks_are_counted(bus: LocalSocketBus, tmp_path: Path) -> None:
    with Witness(tmp_path / "can") as witness:
        for identifier in (SYNC, MARK, SYNC, *POSITIONS, COMMAND, SYNC, POSITIONS[0], MARK, COMMAND):
            bus.send_frame(FRAME.pack(identifier, 4, bytes(8)))
        told = count(witness)
    assert told["frames"] == {SYNC: 2, POSITIONS[0]: 2, POSITIONS[1]: 1, POSITIONS[2]: 1, COMMAND: 1}
    assert told["bits"] == sum(bits_of(i, bytes(4)) for i in (SYNC, *POSITIONS, COMMAND, SYNC, POSITIONS[0]))
    third = told["third"]
    assert isinstance(third, dict)
    assert third["count"] == 1
    assert third["max_us"] > 0.0
