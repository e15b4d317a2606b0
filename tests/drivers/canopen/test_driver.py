"""The CANopen driver against simulated nodes, in step: a tick, its faults, and their reactions."""

from __future__ import annotations

import errno
import math
import re
import struct
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drivers.base import INVALID, PASSIVE, Command, DriverError, Readings
from drivers.canopen.driver import CanopenDriver
from tests.drivers.canopen.frame_classes import CLASSES
from tests.drivers.canopen.in_step import (
    PERIOD,
    PLANT,
    SETTINGS,
    WITH_SPOOLS,
    DriverInStep,
    Wire,
    make,
    nodes_plan,
)

MOVING = Command(valve=(0.3, -0.2, 0.1), supply_enable=True, exhaust_closed=True, beacon=True)


class Bench:
    """An open driver, its wire, and the loop's clock."""

    def __init__(self) -> None:
        self.driver, self.wire = make()
        self.driver.open()
        self.tick = 0
        self.readings: list[Readings] = []

    def run(self, ticks: int, command: Command = MOVING) -> Readings:
        """Run ticks; return the last readings."""
        for _ in range(ticks):
            self.readings.append(self.driver.read(self.tick * PERIOD))
            self.applied = self.driver.write(command)
            self.tick += 1
        return self.readings[-1]

    def counted(self) -> int:
        return sum(getattr(self.driver.counters, name) for name in CLASSES)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def emergency(code: int) -> bytes:
    return struct.pack("<HB5x", code, 0x11)


# A tick ----------------------------------------------------------------------------------------------


def test_encoder_time_includes_sync_transmit_delay(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench.wire, "sync_time", lambda sent: sent + 120e-6)
    sent = bench.run(3).time
    assert bench.run(1).encoder_time == pytest.approx([sent + PERIOD + 120e-6] * 3)


def test_tick_exchanges_sync_positions_and_command(bench: Bench) -> None:
    bench.run(1)
    bench.wire.sent.clear()
    before = bench.driver.counters.positions
    bench.run(1)
    assert [identifier for identifier, _ in bench.wire.sent] == [0x80, 0x20A]
    assert bench.driver.counters.positions == before + 3


def test_encoder_time_equals_sync_time(bench: Bench) -> None:
    readings = bench.run(5)
    assert readings.encoder_time == (readings.time,) * 3
    assert readings.encoder_age == (0.0, 0.0, 0.0)
    assert readings.encoder_valid == (True, True, True)
    assert readings.encoder_count == bench.wire.nodes.readings.encoder_count


def test_encoder_age_includes_time_for_queued_frames(bench: Bench) -> None:
    bench.run(5)  # the shut-off valve has opened: no input changes and sends a frame of its own
    bench.wire.frame_time = 1e-5
    for _ in range(7):
        bench.wire.put(0x555)
    readings = bench.run(1)
    assert readings.encoder_age == pytest.approx((-8e-5,) * 3, abs=1e-9)  # the eighth look finds nothing


def test_command_valves_become_volts_and_switches_bits(bench: Bench) -> None:
    bench.run(1, Command((1.0, -1.0, 0.0), supply_enable=True, exhaust_closed=True, tee=True))
    a, b, c, outputs = bench.wire.commands[-1]
    assert (a, b, c) == pytest.approx((10.0, 0.0, 5.0), abs=2e-4)
    assert outputs == 0b10011
    bench.run(1, Command(guard_lock=False, beacon=True))
    assert bench.wire.commands[-1][3] == 0b01100


def test_make_passive_centres_spools_and_clears_outputs(bench: Bench) -> None:
    bench.run(3)
    bench.driver.make_passive()
    *volts, outputs = bench.wire.commands[-1]
    assert volts == pytest.approx([5.0] * 3, abs=2e-4)
    assert outputs == 0
    assert bench.wire.in_force == PASSIVE


def test_first_tick_has_inputs_and_pressures(bench: Bench) -> None:
    readings = bench.run(1, PASSIVE)
    assert readings.emergency_stop_clear
    assert readings.chamber_pressure == pytest.approx((101325,) * 6, abs=60)
    assert bench.driver.counters.analogue == 0


def test_interlocks_update_on_change_and_pressures_periodically(bench: Bench) -> None:
    bench.run(20, PASSIVE)
    assert bench.readings[-1].supply_pressure == pytest.approx(101325, abs=60)
    assert bench.readings[-1].emergency_stop_clear
    bench.wire.nodes.plant.state["emergency_stop_clear"] = False
    bench.wire.nodes.plant.state["local_reset"] = True
    readings = bench.run(3, PASSIVE)
    assert not readings.emergency_stop_clear
    assert readings.local_reset
    assert bench.driver.counters.analogue == 4  # two frames every ten ticks


def test_master_heartbeat_is_sent_within_watchdog_time(bench: Bench) -> None:
    bench.wire.sent.clear()
    bench.run(100)
    beats = [data for identifier, data in bench.wire.sent if identifier == 0x700 + SETTINGS.master]
    assert set(beats) == {b"\x05"}
    assert 12 <= len(beats) <= 17


def test_counters_count_every_frame_once(bench: Bench) -> None:
    bench.run(200)
    assert bench.driver.counters.frames == bench.counted()
    assert bench.driver.counters.foreign == 0


# Samples that go wrong -------------------------------------------------------------------------------


def test_missing_position_keeps_last_count_and_ages(bench: Bench) -> None:
    bench.run(5)
    good = bench.readings[-1]
    bench.wire.meddle = lambda identifier, data: [] if identifier == 0x282 else [(identifier, data)]
    readings = bench.run(3)
    assert readings.encoder_age == pytest.approx((0.0, 3 * PERIOD, 0.0))
    assert readings.encoder_count[1] == good.encoder_count[1]
    assert readings.encoder_valid == (True, True, True)
    bench.run(1)
    assert bench.driver.counters.missing == 3
    assert bench.driver.operational


def test_missing_position_wait_ends_at_sync_timeout(bench: Bench) -> None:
    bench.run(1)
    bench.wire.meddle = lambda identifier, data: []
    before = bench.wire.now
    bench.driver.read(bench.tick * PERIOD)
    assert bench.wire.now - before == pytest.approx(PERIOD + SETTINGS.sync_timeout, abs=1e-5)


def hold_back(bench: Bench) -> list[tuple[int, bytes]]:
    """Keep the wrist's positions from the bus; return the list of those that were kept."""
    held: list[tuple[int, bytes]] = []

    def hold(identifier: int, data: bytes) -> list[tuple[int, bytes]]:
        if identifier == 0x283:
            held.append((identifier, data))
            return []
        return [(identifier, data)]

    bench.wire.meddle = hold
    return held


def test_late_position_keeps_previous_sync_time(bench: Bench) -> None:
    bench.run(5)
    held = hold_back(bench)
    bench.run(1)
    late_time = bench.readings[-1].time
    bench.wire.put(*held[0])
    readings = bench.run(1)
    assert readings.encoder_time[2] == late_time
    assert readings.encoder_age[2] == pytest.approx(PERIOD)
    assert bench.driver.counters.late == 1
    assert bench.driver.counters.missing == 0


def test_late_positions_are_not_taken_for_current_sync(bench: Bench) -> None:
    bench.run(5)
    held = hold_back(bench)
    bench.run(3)  # a node that stands still, then answers all SYNCs at once
    bench.wire.meddle = lambda identifier, data: (
        [*held, (identifier, data)] if identifier == 0x283 else [(identifier, data)]
    )
    readings = bench.run(1)
    assert readings.encoder_age == (0.0, 0.0, 0.0)
    assert readings.encoder_count == bench.wire.nodes.readings.encoder_count
    assert (bench.driver.counters.late, bench.driver.counters.duplicates) == (3, 0)


def test_lost_positions_next_answer_is_skipped(bench: Bench) -> None:
    bench.run(5)
    bench.wire.meddle = lambda identifier, data: [] if identifier == 0x282 else [(identifier, data)]
    bench.run(3)
    bench.wire.meddle = lambda identifier, data: [(identifier, data)]
    ages = [bench.run(1).encoder_age[1] for _ in range(4)]
    assert ages == pytest.approx([4 * PERIOD, 0.0, 0.0, 0.0])
    assert bench.driver.counters.missing == 4


def test_duplicate_position_is_ignored_and_counted(bench: Bench) -> None:
    bench.run(5)
    count = bench.readings[-1].encoder_count[0]
    bench.wire.put(0x281, struct.pack("<I", 7))
    readings = bench.run(1)
    assert readings.encoder_count[0] == pytest.approx(count, abs=50)
    assert bench.driver.counters.duplicates == 1


@pytest.mark.parametrize("data", [b"", b"abc", b"abcdefgh"])
def test_position_wrong_length_is_ignored(bench: Bench, data: bytes) -> None:
    bench.run(2)
    bench.wire.meddle = lambda identifier, sent: [(identifier, data if identifier == 0x281 else sent)]
    readings = bench.run(1)
    assert readings.encoder_age[0] == pytest.approx(PERIOD)
    assert bench.driver.counters.wrong_length == 1


@pytest.mark.parametrize("identifier", [0x18A, 0x28A, 0x38A, 0x701, 0x81, 0x8A])
def test_other_frame_wrong_length_is_ignored(bench: Bench, identifier: int) -> None:
    bench.run(2)
    before = bench.readings[-1]
    for data in (b"", b"\xff" * 5):
        bench.wire.put(identifier, data)
    after = bench.run(1)
    assert bench.driver.counters.wrong_length == 2
    assert bench.driver.operational
    assert after.emergency_stop_clear == before.emergency_stop_clear
    assert after.supply_pressure == pytest.approx(before.supply_pressure, rel=0.01, nan_ok=True)


def test_position_out_of_range_is_passed_on(bench: Bench) -> None:
    bench.run(2)
    bench.wire.meddle = lambda identifier, data: [(identifier, b"\xff" * 4 if identifier == 0x281 else data)]
    assert bench.run(1).encoder_count[0] == 0xFFFFFFFF


def test_lost_pressures_become_invalid(bench: Bench) -> None:
    bench.run(20)
    assert math.isfinite(bench.readings[-1].supply_pressure)
    bench.wire.meddle = lambda identifier, data: [] if identifier in (0x28A, 0x38A) else [(identifier, data)]
    readings = bench.run(45)
    assert readings.supply_pressure == INVALID
    assert readings.chamber_pressure == (INVALID,) * 6
    assert bench.driver.operational


def with_spools() -> Bench:
    bench = Bench()
    bench.wire = Wire(nodes_plan(replace(PLANT, spool_feedback=True)))
    bench.driver = DriverInStep(bench.wire, WITH_SPOOLS)
    bench.driver.open()
    return bench


def test_spool_positions_of_moving_valves_come_one_tick_late() -> None:
    bench = with_spools()
    assert bench.run(1, PASSIVE).spool_position == pytest.approx((0.0,) * 3, abs=0.006)
    true = []
    for _ in range(30):
        bench.run(1, MOVING)
        true.append(bench.wire.nodes.plant.state["spool"][0].copy())
    late = [seen.spool_position for seen in bench.readings[2:]]
    assert np.abs(np.array(late) - np.array(true[: len(late)])).max() < 0.006
    assert late[-1] == pytest.approx(MOVING.valve, abs=0.006)


def test_spool_positions_without_frames_are_invalid_within_4_ms() -> None:
    bench = with_spools()
    bench.run(20)
    bench.wire.meddle = lambda identifier, data: [] if identifier == 0x48A else [(identifier, data)]
    assert bench.run(5).spool_position == (INVALID,) * 3
    assert bench.driver.operational


def test_spool_positions_not_fitted_are_absent(bench: Bench) -> None:
    assert all(map(math.isnan, bench.run(20).spool_position))


# Encoders that tell of errors ------------------------------------------------------------------------


def test_encoder_emergency_invalidates_channel_until_cleared(bench: Bench) -> None:
    bench.run(2)
    bench.wire.nodes.plant.state["encoder_valid"] = (1, 0, 1)
    assert bench.run(3).encoder_valid == (True, False, True)
    assert bench.driver.operational
    bench.wire.nodes.plant.state["encoder_valid"] = (1, 1, 1)
    assert bench.run(3).encoder_valid == (True, True, True)
    assert bench.driver.counters.emergencies == 2


def test_encoder_error_before_open_invalidates_channel_until_cleared(bench: Bench) -> None:
    bench.driver.close()
    bench.wire.nodes.encoders[1].set_health(False)
    bench.driver.open()
    bench.wire.nodes.plant.state["encoder_valid"] = (1, 0, 1)
    assert bench.run(3).encoder_valid == (True, False, True)
    bench.wire.nodes.plant.state["encoder_valid"] = (1, 1, 1)
    assert bench.run(3).encoder_valid == (True, True, True)


# What ends in the latched safe state -----------------------------------------------------------------


def drop(*identifiers: int) -> Callable[[Bench], None]:
    def do(bench: Bench) -> None:
        bench.wire.meddle = lambda i, data: [] if i in identifiers else [(i, data)]

    return do


def put(identifier: int, data: bytes) -> Callable[[Bench], None]:
    return lambda bench: bench.wire.put(identifier, data)


def order(command: int, node: int) -> Callable[[Bench], None]:
    return lambda bench: bench.wire.order(command, node)


def refuse(number: int) -> Callable[[Bench], None]:
    def do(bench: Bench) -> None:
        bench.wire.refuse = OSError(number, "refused")

    return do


def go_deaf(bench: Bench) -> None:
    bench.wire.deaf = True


def fail_to_receive(bench: Bench) -> None:
    bench.wire.break_receiving = OSError(errno.ENETDOWN, "Network is down")


FAULTS: dict[str, tuple[Callable[[Bench], None], str, int]] = {
    "the valve node reports an error": (put(0x8A, emergency(0x2310)), "node 10 .* error 2310h", 2),
    "the valve node is silent": (drop(0x70A, 0x18A), "interlocks|node 10 .* no heartbeat", 200),
    "an encoder's heartbeat is lost": (drop(0x702), r"node 2 \(encoder of the arm\) .* no heartbeat", 200),
    "the interlocks come no more": (drop(0x18A), "interlocks have not been received", 200),
    "a node restarts": (order(129, 3), r"node 3 \(encoder of the wrist\) has restarted", 3),
    "a node is stopped by another": (order(2, 10), r"node 10 .* state 4 \(stopped\): another master", 60),
    "an encoder is made pre-operational": (
        order(128, 1),
        r"node 1 .* state 127 \(pre-operational\): another",
        60,
    ),
    "commands do not reach the node": (go_deaf, "error 8250h|node 10", 60),
    "bus-off": (put(0x20000040, bytes(8)), "bus-off", 2),
    "interface down": (refuse(errno.ENETDOWN), "sending failed", 2),
    "interface gone": (refuse(errno.ENODEV), "sending failed", 2),
    "receiving fails": (fail_to_receive, "receiving failed", 2),
    "no room for commands": (refuse(errno.ENOBUFS), "queue is full|error 8250h", 60),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_driver_fault_is_latched_until_reopened(
    bench: Bench, fault: tuple[Callable[[Bench], None], str, int]
) -> None:
    bring, reason, longest = fault
    bench.run(30)
    assert bench.driver.fault == ""
    assert bench.wire.in_force == MOVING
    bring(bench)
    bench.run(longest)
    assert not bench.driver.operational
    assert re.search(reason, bench.driver.fault), bench.driver.fault
    assert bench.applied == PASSIVE
    # Mended, it stays passive ...
    bench.wire.refuse = bench.wire.break_receiving = None
    bench.wire.deaf = False
    bench.wire.meddle = lambda identifier, data: [(identifier, data)]
    first = bench.driver.fault
    bench.run(100)
    assert bench.driver.fault == first
    assert bench.applied == PASSIVE
    assert bench.wire.in_force == PASSIVE
    # ... until it is opened again.
    bench.driver.close()
    bench.driver.open()
    bench.run(30)
    assert bench.driver.fault == ""
    assert bench.wire.in_force == MOVING


def test_valve_node_watchdog_commands_stop_falls_back(bench: Bench) -> None:
    bench.run(30)
    assert bench.wire.in_force == MOVING
    start = bench.wire.now
    while bench.wire.in_force != PASSIVE:
        bench.wire.pass_time(PERIOD)
        assert bench.wire.now < start + 1.0
    assert bench.wire.now - start == pytest.approx(bench.driver.watchdog, abs=2 * PERIOD)


def test_full_send_queue_short_counts_without_fault(bench: Bench) -> None:
    bench.run(10)
    bench.wire.refuse = OSError(errno.ENOBUFS, "No buffer space available")
    readings = bench.run(4)
    assert readings.encoder_age == pytest.approx((4 * PERIOD,) * 3)
    assert bench.applied == MOVING  # the last one sent is still in force
    bench.wire.refuse = None
    bench.run(20)
    assert bench.driver.operational
    assert bench.driver.counters.no_room == 8  # SYNCs and commands


def test_error_frames_overrun_and_passive_only_count(bench: Bench) -> None:
    for reason in (0x01, 0x02, 0x10, 0x20, 0x04):
        bench.wire.put(0x20000004, bytes([0, reason, 0, 0, 0, 0, 0, 0]))
    bench.run(2)
    counters = bench.driver.counters
    assert (counters.error_frames, counters.overruns, counters.error_passive) == (5, 2, 2)
    assert bench.driver.operational


def test_babbling_node_does_not_block_tick(bench: Bench) -> None:
    bench.run(2)
    bench.wire.frame_time = 1e-6
    for _ in range(2000):
        bench.wire.put(0x282, bytes(4))
    bench.run(1)
    assert bench.driver.counters.floods == 1
    assert len(bench.wire.queue) > 1000
    bench.run(20)
    assert bench.driver.counters.frames == bench.counted()
    assert bench.driver.operational


def test_close_stops_valve_node(bench: Bench) -> None:
    bench.run(10)
    bench.driver.close()
    assert bench.wire.in_force == PASSIVE
    assert bench.wire.nodes.valve_node.state == 4
    assert not bench.wire.open
    with pytest.raises(DriverError, match="open"):
        bench.driver.read(1.0)


def test_driver_without_settings_uses_can0() -> None:
    assert CanopenDriver().settings.channel == "can0"
