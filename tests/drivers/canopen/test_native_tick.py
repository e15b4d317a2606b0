"""Compiled ticks of the CANopen driver on a socket against those in Python: same frames, readings, counts.

Echoes with time stamps, which only SocketCAN has, are put into the kernel's structures by hand.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numba
import pytest

from drivers.base import Command
from drivers.base.compiled import new_record
from drivers.can_bus import ERROR
from drivers.canopen._native_tick import IS_SUPPORTED, LINK_STATE, _take_batch, prepare
from drivers.canopen.settings import CanopenSettings
from tests.drivers.canopen.socket_rig import NODE, SETTINGS, Found, Frames, Rig, found

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT) or not IS_SUPPORTED, reason="nothing is compiled"
)


def positions(k: int, joints: tuple[int, ...] = (0, 1, 2)) -> Frames:
    return [
        (0x280 + SETTINGS.encoders.nodes[joint], (1000 * joint + 7 * k).to_bytes(4, "little"))
        for joint in joints
    ]


def heartbeats() -> Frames:
    return [(0x700 + node, b"\x05") for node in (*SETTINGS.encoders.nodes, NODE)]


PRESSURES = [(0x280 + NODE, b"\x10\x27\xff\x7f\x00\x80\xf0\xd8"), (0x380 + NODE, b"\x10\x20\x01\x00\x02\x00")]
SPOOLS = [(0x480 + NODE, b"\x10\x27\x00\x80\xff\x7f")]
ODD: dict[int, Frames] = {
    2: [(0x180 + NODE, b"\x0f")],
    4: heartbeats(),
    5: PRESSURES,
    6: [*SPOOLS, (0x480 + NODE, b"\x10\x27")],
    7: [(0x280 + SETTINGS.encoders.nodes[1], b"\1\2\3")],
    8: [(0x333, b"foreign")],
    10: [(0x80 + SETTINGS.encoders.nodes[0], bytes([0, 0x50, 1, 0, 0, 0, 0, 0]))],
    12: [(0x80 + SETTINGS.encoders.nodes[0], bytes(8))],
    14: [(0x04 | ERROR, bytes([0, 1, 0, 0, 0, 0, 0, 0]))],
    15: positions(3, (1,)),
    16: [(0x580 + NODE, bytes(8))],
    18: [(0x180 + NODE, b"\xff"), *PRESSURES[:1], *SPOOLS, *heartbeats()],
    19: SPOOLS,
    20: [(0x180 + NODE, b"")],
    21: [(0x280 + SETTINGS.encoders.nodes[0], b"\xff\xff\xff\xff")],
}


def before_and_after(k: int) -> Frames:
    """Odd frames before the positions in even thousands of ticks, after them in odd ones."""
    odd = ODD.get(k % 24, [])
    answers = positions(k, (0, 2)) if k % 24 == 13 else positions(k)
    return [*odd, *answers] if k % 48 < 24 else [*answers, *odd]


@pytest.fixture(params=["six pressures", "none", "spools too"])
def configured(request: pytest.FixtureRequest) -> CanopenSettings:
    if request.param == "spools too":
        return replace(SETTINGS, valve_node=replace(SETTINGS.valve_node, spool_positions=(8, 10, 9)))
    if request.param == "six pressures":
        return SETTINGS
    node = replace(SETTINGS.valve_node, supply_pressure=0, chamber_pressures=(0,) * 6)
    return replace(SETTINGS, valve_node=node)


@pytest.fixture
def rigs() -> Iterator[Callable[..., Rig]]:
    made: list[Rig] = []

    def make(*arguments: Any, **options: Any) -> Rig:
        made.append(Rig(*arguments, **options))
        return made[-1]

    yield make
    for rig in made:
        rig.end()


def commands(k: int) -> Command:
    if k % 9 == 4:
        return Command((float("nan"), 0.0, 0.0), supply_enable=True)
    opening = -1.2 + 0.05 * k
    return Command((opening, -opening, 0.1), k % 2 == 0, k % 3 == 0, k % 5 == 0, k % 7 == 0, k % 4 == 0)


def test_native_tick_matches_python_frames_and_readings(
    rigs: Callable[..., Rig], configured: CanopenSettings
) -> None:
    both = [rigs(before_and_after, native=native, settings=configured) for native in (True, False)]
    for rig in both:
        rig.run(60, commands)
    ours, theirs = map(found, both)
    for name in Found._fields:
        assert getattr(ours, name) == getattr(theirs, name), name
    assert len(both[0].declined) < 60  # the first tick, and those with odd frames
    assert len(both[1].declined) == 120


def test_native_tick_handles_usual_ticks(rigs: Callable[..., Rig]) -> None:
    rig = rigs(lambda k: [*positions(k), *(heartbeats() if k % 10 == 0 else [])], native=True)
    rig.run(50)
    assert rig.declined == [(0, "read"), (0, "write")]
    assert rig.driver.counters.positions == 150
    assert rig.driver.applied == rig.applied[-1]


@pytest.mark.parametrize(
    "last",
    [
        [(0x700 + NODE, b"\x00")],
        [(0x700 + SETTINGS.encoders.nodes[2], b"\x7f")],
        [(0x80 + NODE, bytes([0x10, 0x81, 1, 0, 0, 0, 0, 0]))],
        [(0x40 | ERROR, bytes(8))],
        [b"\x81\x02\x00\x00\x04"],
    ],
    ids=["restarted", "left", "emergency", "bus off", "cut short"],
)
@pytest.mark.parametrize("first", [True, False], ids=["before", "between"])
def test_native_tick_fault_occurs_in_same_tick_as_python(
    rigs: Callable[..., Rig], last: Frames, first: bool
) -> None:
    def script(k: int) -> Frames:
        answers = positions(k)
        if k != 10:
            return answers
        return [*last, *answers] if first else [*answers[:2], *last, *answers[2:]]

    both = [rigs(script, native=native) for native in (True, False)]
    for rig in both:
        rig.run(14)
    ours, theirs = map(found, both)
    assert ours == theirs
    assert ours.fault
    assert ours.applied[9] != ours.applied[10] == Command()


def test_native_tick_silence_faults_in_same_tick_as_python(rigs: Callable[..., Rig]) -> None:
    settings = replace(SETTINGS, heartbeat=0.005, interlock_period=0.004)
    both = [rigs(positions, native=native, settings=settings) for native in (True, False)]
    for rig in both:
        rig.run(25)
    ours, theirs = map(found, both)
    assert ours == theirs
    assert "interlocks" in ours.fault


def test_native_tick_failed_send_counts_once(rigs: Callable[..., Rig]) -> None:
    both = [rigs(positions, native=native) for native in (True, False)]
    for rig in both:
        rig.run(5)
        rig.nodes.ours.shutdown(socket.SHUT_RD)
        rig.tick()
        assert "sending failed" in rig.driver.fault
    ours, theirs = map(found, both)
    assert ours.counters == theirs.counters
    assert ours.applied == theirs.applied


def test_take_batch_echo_sets_sync_time() -> None:
    state = new_record(LINK_STATE)
    prepare(state)
    s = state[0]
    s["count"] = 2
    stamp = time.time_ns()
    ahead = stamp - time.monotonic_ns()
    for k in range(2):
        s["headers"][8 * k + 5 : 8 * k + 8] = 32, 0x800 if k == 0 else 0, 16
        s["control"][4 * k : 4 * k + 4] = 32, 1 | 35 << 32, stamp // 10**9, stamp % 10**9
    s["nodes"], s["awaited"], s["in_time"] = (1, 2, 3, 10), 7, 1
    s["frames"][2:4] = 0x281 | 4 << 32, 99
    s["counts_per_revolution"], s["range"] = 2**17, 2**17
    assert _take_batch(state, state.ctypes.data, 64, False) == 1
    assert s["echoed"] == pytest.approx(1e-9 * (stamp - ahead), abs=1e-3)
    assert s["awaited"] == 6
    assert s["counts"][0] == 99
