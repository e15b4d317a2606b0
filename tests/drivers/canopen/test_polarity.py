"""Polarity and masks of the I/O node: inverted or masked channels never pass the startup unchanged."""

from __future__ import annotations

from dataclasses import replace

import pytest
from canopen.objectdictionary.datatypes import UNSIGNED8, UNSIGNED16

from drivers.base import PASSIVE, DriverError
from sim.nodes.personality import IO, ObjectChange, Personality
from tests.drivers.canopen.in_step import SETTINGS
from tests.drivers.canopen.test_families import bus, run


def node(index: int, value: int, *, access: str = "rw", subindex: int = 1) -> Personality:
    """Return a node with one more object."""
    kind = UNSIGNED16 if index in {0x6102, 0x6302, 0x6308} else UNSIGNED8
    change = ObjectChange(index, subindex, value, kind, access)
    return Personality("one", IO, "any", "any", "CiA 401", objects=(change,))


@pytest.mark.parametrize(
    ("index", "subindex", "delivered", "wanted"),
    [
        (0x6002, 1, 0x01, 0),
        (0x6102, 1, 0x0001, 0),
        (0x6202, 1, 0x02, 0),
        (0x6302, 1, 0x00FF, 0),
        (0x6208, 1, 0x00, 0xFF),
        (0x6308, 1, 0x0000, 0xFFFF),
        (0x6006, 1, 0x7F, 0xFF),
        (0x6005, 0, 0, 1),
    ],
    ids=lambda value: f"{value:04X}" if isinstance(value, int) and value > 0x6000 else "",
)
def test_polarity_object_is_set_and_stored_or_refused(
    index: int, subindex: int, delivered: int, wanted: int
) -> None:
    driver, wire = bus(io=node(index, delivered, subindex=subindex))
    driver.open()
    found = wire.nodes.valve_node
    assert found.number_at(index, subindex) == wanted
    command = PASSIVE._replace(supply_enable=True, exhaust_closed=True, beacon=True)
    run(driver, command, ticks=5)
    assert wire.in_force == command
    found.boot(wire.now)
    assert found.number_at(index, subindex) == wanted
    assert wire.in_force == PASSIVE
    driver.close()
    refusing, _ = bus(io=node(index, delivered, subindex=subindex, access="ro"))
    with pytest.raises(DriverError, match=rf"node 10 .* object {index:04X}h:{subindex} .*06010002h"):
        refusing.open()


@pytest.mark.parametrize("index", [0x6002, 0x6102])
def test_inverted_inputs_emergency_stop_never_reads_clear(index: int) -> None:
    driver, wire = bus(io=node(index, 0x01))
    wire.nodes.plant.state["emergency_stop_clear"] = False
    driver.open()
    readings = run(driver)
    assert readings.emergency_stop_clear == wire.nodes.readings.emergency_stop_clear


def test_inverted_outputs_with_watchdog_relay_are_refused() -> None:
    relay = replace(SETTINGS.valve_node, watchdog_relay="K7")
    driver, _ = bus(io=node(0x6202, 0xFF, access="ro"), settings=replace(SETTINGS, valve_node=relay))
    with pytest.raises(DriverError, match=r"6202h:1 .*inverted channels"):
        driver.open()
