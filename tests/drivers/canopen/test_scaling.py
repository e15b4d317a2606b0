"""Direction, scaling and range of encoders: a wrong one never passes the startup."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from drivers.base import DriverError
from sim.nodes.personality import ObjectChange, find_personality
from tests.drivers.canopen.test_families import PLANT_COUNTS, assert_counts_are_the_shafts, bus

PLAIN = replace(find_personality("reversed-17", "encoder"), objects=())


def encoder(
    values: Mapping[int, int],
    read_only: tuple[int, ...] = (),
    absent: tuple[int, ...] = (),
    **changes: object,
) -> object:
    """Return an encoder that is delivered with `values`."""
    places = {*values, *read_only}
    objects = tuple(
        ObjectChange(index, 0, values.get(index), None, "ro" if index in read_only else None)
        for index in sorted(places)
    )
    return replace(PLAIN, objects=objects, absent=frozenset((index, None) for index in absent), **changes)  # type: ignore[arg-type]


TAKEN: dict[str, object] = {
    "plain": encoder({}),
    "reversed": encoder({0x6000: 1}),
    "scaled": encoder({0x6000: 4, 0x6001: 4096, 0x6002: 4096}),
    "reversed and scaled": encoder({0x6000: 5, 0x6001: 3600, 0x6002: 3600}),
    "scaled whatever 6000h says": encoder({0x6001: 4096, 0x6002: 4096}, always_scaled=True),
    "6002h is the last position": encoder({}, range_is_last=True),
    "6002h is smaller than a turn": encoder({0x6000: 4, 0x6002: 1000}),
    "no operating parameters": encoder({}, absent=(0x6000,)),
    "no scaling objects": encoder({0x6000: 1}, absent=(0x6001, 0x6002)),
    "scaling fixed, one to one": encoder({0x6000: 4}, read_only=(0x6000,)),
    "multi-turn": encoder({0x6000: 5, 0x6001: 4096, 0x6002: 4096 * 16}, revolutions=16),
    "32 bits of range": encoder({}, revolutions=2**15),
    "manufacturer's bits are kept": encoder({0x6000: 0x8001}),
}


@pytest.mark.parametrize("name", TAKEN)
def test_encoder_counts_match_shaft_for_any_prior_settings(name: str) -> None:
    driver, wire = bus(encoder=TAKEN[name])  # type: ignore[arg-type]
    driver.open()
    assert_counts_are_the_shafts(driver, wire, PLANT_COUNTS)


def test_operating_parameters_manufacturer_bits_stay() -> None:
    driver, wire = bus(encoder=TAKEN["manufacturer's bits are kept"])  # type: ignore[arg-type]
    driver.open()
    assert wire.nodes.encoders[0].number_at(0x6000) == 0x8000


def test_finer_encoder_scaled_to_configured_counts_is_accepted() -> None:
    finer = encoder({0x6000: 4, 0x6001: PLANT_COUNTS, 0x6002: PLANT_COUNTS}, counts=2 * PLANT_COUNTS)
    driver, wire = bus(encoder=finer)  # type: ignore[arg-type]
    driver.open()
    assert wire.nodes.encoders[0].number_at(0x6000) == 4
    assert_counts_are_the_shafts(driver, wire, PLANT_COUNTS)


REFUSED: dict[str, tuple[object, str]] = {
    "reversed for good": (
        encoder({0x6000: 1}, read_only=(0x6000,)),
        r"object 6000h:0 .*06010002h.*Expected 0x0: counts that rise clockwise.*own tool or switches",
    ),
    "scaled for good": (
        encoder({0x6000: 4, 0x6001: 4096, 0x6002: 4096}, read_only=(0x6000, 0x6001, 0x6002)),
        r"object 6001h:0 .*06010002h",
    ),
    "units for good": (encoder({0x6001: 4096}, read_only=(0x6001,)), r"object 6001h:0 .*06010002h"),
    "scaled to another resolution": (
        encoder({0x6000: 4, 0x6001: 4096, 0x6002: 4096}, counts=2**16),
        r"6501h:0 .*found 65536, scaled to 4096 \(6000h bit 2, 6001h\), expected 131072; set plant",
    ),
    "not evenly scaled": (
        encoder({0x6000: 4, 0x6001: PLANT_COUNTS, 0x6002: PLANT_COUNTS}, counts=200_000),
        r"6501h:0 .*found 200000, scaled to 131072",
    ),
    "no resolution anywhere": (
        encoder({}, absent=(0x6501, 0x6001)),
        r"6501h:0 .*found none, and none in 6001h",
    ),
    "incremental": (encoder({0x1000: 0x00040196}), r"1000h:0 .*encoder type 4, expected an absolute"),
    "lengths": (encoder({0x1000: 0x00090196}), r"1000h:0 .*encoder type 9"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unsuitable_encoder_scaling_refusal_names_action(name: str) -> None:
    personality, told = REFUSED[name]
    driver, wire = bus(encoder=personality)  # type: ignore[arg-type]
    with pytest.raises(DriverError, match=told):
        driver.open()
    assert {device.state for device in wire.nodes.devices} == {127}


def test_encoder_setting_reverted_by_device_is_refused() -> None:
    driver, wire = bus(encoder=encoder({0x6000: 1}))  # type: ignore[arg-type]
    arm = wire.nodes.encoders[1]
    take = arm.written

    def written(index: int) -> None:
        if index == 0x6000:
            arm.put(0x6000, 0, 1)
        take(index)

    arm.written = written  # type: ignore[method-assign]
    with pytest.raises(DriverError, match=r"node 2 .* object 6000h:0 .*found 0x1, expected 0x0"):
        driver.open()


def test_encoder_position_out_of_range_is_refused() -> None:
    driver, wire = bus()
    wire.nodes.encoders[0].put(0x6004, 0, PLANT_COUNTS)
    with pytest.raises(DriverError, match=r"6004h:0 \(position\): found 131072, expected less than 131072"):
        driver.open()
