"""Preset and offset of encoders: read at every opening, so that the bench can compare them."""

from __future__ import annotations

from dataclasses import replace

import pytest

from drivers.base import DriverError
from sim.nodes.personality import ENCODER, ObjectChange, find_personality
from tests.drivers.canopen.test_families import PLANT_COUNTS, bus, run
from tests.drivers.canopen.test_scaling import encoder


def test_zero_shifts_default_encoders_are_zero() -> None:
    driver, _ = bus()
    assert driver.zero_shifts == ("", "", "")
    driver.open()
    assert driver.zero_shifts == ("preset 0, offset 0",) * 3


def test_zero_shifts_external_preset_shows_at_next_open() -> None:
    driver, wire = bus()
    driver.open()
    arm = wire.nodes.encoders[1]
    position = run(driver).encoder_count[1]
    driver.close()
    arm.set_data(0x6003, 0, (100).to_bytes(4, "little"), check_writable=True)
    driver.open()
    assert run(driver).encoder_count[1] == pytest.approx(100, abs=2)
    plain, moved = "preset 0, offset 0", driver.zero_shifts[1]
    assert driver.zero_shifts == (plain, moved, plain)
    assert moved.startswith("preset 100, offset -")
    assert int(moved.rsplit(" ", 1)[1]) == pytest.approx(100 - position, abs=2)


def test_zero_shifts_stored_preset_is_read_at_open() -> None:
    driver, wire = bus(encoder=find_personality("preset-17", ENCODER))
    driver.open()
    assert driver.zero_shifts == ("preset 32768, offset 32768",) * 3
    found, true = run(driver).encoder_count, wire.nodes.readings.encoder_count
    for a, b in zip(found, true, strict=True):
        assert (a - b) % PLANT_COUNTS == pytest.approx(32768, abs=2)


@pytest.mark.parametrize(
    ("absent", "told"),
    [((0x6509,), "preset 0"), ((0x6003,), "offset 0"), ((0x6003, 0x6509), "")],
    ids=["no offset", "no preset", "neither"],
)
def test_zero_shifts_absent_object_is_omitted(absent: tuple[int, ...], told: str) -> None:
    driver, _ = bus(encoder=encoder({}, absent=absent))  # type: ignore[arg-type]
    driver.open()
    assert driver.zero_shifts == (told,) * 3


def test_zero_shifts_unreadable_object_counts_as_missing() -> None:
    hidden = replace(encoder({}), objects=(ObjectChange(0x6003, 0, None, None, "wo"),))  # type: ignore[type-var]
    driver, _ = bus(encoder=hidden)  # type: ignore[arg-type]
    driver.open()
    assert driver.zero_shifts == ("offset 0",) * 3


def test_zero_shifts_silent_encoder_is_refused() -> None:
    driver, wire = bus()
    asked = bytes((0x40, 0x03, 0x60, 0))
    wire.meddle = lambda identifier, data: (
        [] if identifier == 0x582 and data[1:4] == asked[1:] else [(identifier, data)]
    )
    with pytest.raises(DriverError, match=r"node 2 .*object 6003h:0 \(preset\)"):
        driver.open()
