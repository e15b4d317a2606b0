from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.records.telemetry.cycle_record import CYCLE, FIELDS, arrow_schema, from_arrow, to_arrow
from drivers.base.records import COMMAND, READINGS

Cycles = np.ndarray[Any, Any]


def test_cycle_dtype_is_aligned_with_unique_columns() -> None:
    assert CYCLE.isalignedstruct
    assert CYCLE.names == tuple(field.name for field in FIELDS)
    columns = [column for field in FIELDS for column in field.columns]
    assert len(columns) == len(set(columns))
    assert arrow_schema().names == columns


def test_cycle_dtype_vectors_have_no_booleans() -> None:
    assert all(field.dtype != "?" for field in FIELDS if field.components)


def test_cycle_dtype_covers_readings_and_command_types() -> None:
    renamed = {"valve": "applied_valve"}
    for contract in (READINGS, COMMAND):
        for name in contract.names or ():
            if name in ("time", "encoder_time"):  # the loop's own clock: tick, time and encoder_age hold it
                continue
            if name == "search_index":  # state, phase and the configuration's homing.method hold it
                continue
            assert CYCLE[renamed.get(name, name)] == contract[name], name


def test_arrow_schema_columns_have_unit_and_description() -> None:
    for column in arrow_schema():
        assert column.metadata[b"unit"], column.name
        assert column.metadata[b"description"], column.name
    assert arrow_schema().field("plant_effort_shoulder").metadata[b"unit"] == b"N m"
    assert arrow_schema().field("plant_effort_arm").metadata[b"unit"] == b"N"


def test_from_arrow_restores_swing_bit_for_bit(make_swing: Callable[[int], Cycles]) -> None:
    cycles = make_swing(1)
    assert from_arrow(to_arrow(cycles)).tobytes() == cycles.tobytes()


@given(st.lists(st.binary(min_size=8, max_size=8), min_size=1, max_size=4))
def test_from_arrow_restores_any_float_bit_pattern(words: list[bytes]) -> None:
    cycles = np.zeros(len(words), CYCLE)
    cycles["plant_effort"][:, 1] = np.frombuffer(b"".join(words), "f8")
    assert from_arrow(to_arrow(cycles)).tobytes() == cycles.tobytes()


def test_from_arrow_empty_table_gives_no_cycles() -> None:
    assert from_arrow(to_arrow(np.zeros(0, CYCLE))).shape == (0,)


def test_from_arrow_missing_column_error_names_column() -> None:
    table: pa.Table = to_arrow(np.zeros(2, CYCLE)).drop_columns(["velocity_arm"])
    with pytest.raises(KeyError, match="velocity_arm"):
        from_arrow(table)
