from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import ABSENT, CHAMBERS, PASSIVE, Command, Readings, device_limited
from drivers.base.compiled import new_record
from drivers.base.records import (
    COMMAND,
    READINGS,
    pack_command,
    pack_readings,
    unpack_command,
    unpack_readings,
)

number = st.floats(allow_nan=False)
triple = st.tuples(number, number, number)
switch = st.booleans()
count = st.integers(-(2**63), 2**63 - 1)
readings = st.builds(
    Readings,
    time=number,
    encoder_count=st.tuples(count, count, count),
    encoder_time=triple,
    encoder_valid=st.tuples(switch, switch, switch),
    encoder_age=triple,
    emergency_stop_clear=switch,
    guard_closed=switch,
    guard_locked=switch,
    supply_pressure=number,
    local_reset=switch,
    ball_present=switch,
    chamber_pressure=st.tuples(*(number,) * 6),
    vent_open=st.tuples(number, number),
    shut_off_open=number,
    spool_position=triple,
)
commands = st.builds(Command, triple, *(switch,) * 5)


@given(readings)
def test_pack_readings_round_trip_preserves_values(value: Readings) -> None:
    record = new_record(READINGS)
    pack_readings(value, record)
    back = unpack_readings(record)
    assert back == value
    assert repr(back) == repr(value)  # the same plain types, too


@given(commands)
def test_pack_command_round_trip_preserves_values(value: Command) -> None:
    record = new_record(COMMAND)
    pack_command(value, record)
    assert unpack_command(record) == value
    assert repr(unpack_command(record)) == repr(value)


def test_record_dtypes_match_field_names() -> None:
    assert READINGS.names == Readings._fields
    assert COMMAND.names == Command._fields


def test_pack_readings_absent_channel_stays_absent() -> None:
    record = new_record(READINGS)
    value = Readings(
        0.0,
        (1, 2, 3),
        (ABSENT,) * 3,
        (False,) * 3,
        (ABSENT,) * 3,
        True,
        True,
        True,
        ABSENT,
        True,
        True,
        (ABSENT,) * 6,
    )
    pack_readings(value, record)
    back = unpack_readings(record)
    assert math.isnan(back.supply_pressure)
    assert len(back.chamber_pressure) == len(CHAMBERS)
    assert all(map(math.isnan, back.chamber_pressure))


def test_pack_wrong_value_raises() -> None:
    record = new_record(READINGS)
    with pytest.raises((TypeError, ValueError, OverflowError)):
        pack_readings(Readings(*("x",) * 12), record)  # type: ignore[arg-type]
    with pytest.raises((TypeError, ValueError)):
        pack_command(Command(valve=(0.0, 0.0)), new_record(COMMAND))  # type: ignore[arg-type]


def test_passive_command_has_no_energy() -> None:
    assert Command() == PASSIVE
    assert PASSIVE.valve == (0.0, 0.0, 0.0)
    assert PASSIVE.guard_lock
    assert not any((PASSIVE.supply_enable, PASSIVE.exhaust_closed, PASSIVE.beacon, PASSIVE.tee))


@given(commands)
def test_device_limited_clips_valves_or_returns_passive(command: Command) -> None:
    applied = device_limited(command)
    if all(map(math.isfinite, command.valve)):
        assert applied.valve == tuple(np.clip(command.valve, -1.0, 1.0).tolist())
        assert applied[1:] == command[1:]
    else:
        assert applied == PASSIVE
