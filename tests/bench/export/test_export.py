from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv as pc
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader
from scipy.io import loadmat

from bench.export.csv_table import write_csv
from bench.export.mat_file import write_mat
from bench.export.mcap_file import write_mcap
from bench.export.record import ExportRecord, columns, read_record
from bench.export.rrd_file import write_rrd
from bench.telemetry.cycle_record import CYCLE, FIELDS, arrow_schema, from_arrow
from bench.telemetry.recorder import write_swing
from bench.telemetry.whole_file import NotStored

Cycles = np.ndarray[Any, Any]
BEGIN = "2026-11-01T09:30:00+00:00"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory, make_swing: Callable[[int], Cycles]) -> ExportRecord:
    """A record with what is awkward: no pressure sensors, large counts, numbers that do not end."""
    cycles = make_swing(3)[700:1000].copy()
    cycles["chamber_pressure"] = np.nan
    cycles["plant_pressure"][0, 0] = np.nan
    cycles["encoder_count"][0] = 2**52 + 1
    cycles["angle"][1] = [1 / 3, 1e-300, -0.0]
    path = tmp_path_factory.mktemp("records") / "007.parquet"
    write_swing(path, cycles, {"number": 7, "time_utc": BEGIN, "profile": {"name": "default"}})
    return read_record(path)


def equal(a: Cycles, b: Cycles) -> bool:
    return all(
        np.array_equal(a[f.name], b[f.name], equal_nan=f.dtype == "f8") and a[f.name].dtype == b[f.name].dtype
        for f in FIELDS
    )


def test_every_column_has_its_unit_and_its_meaning() -> None:
    units = {column.name: column.unit for column in columns()}
    assert units["angle_wrist"] == "rad"
    assert units["chamber_pressure_right_arm_b"] == "Pa"
    assert [units[f"plant_effort_{joint}"] for joint in ("shoulder", "arm", "wrist")] == ["N m", "N", "N m"]
    assert all(column.unit and column.description for column in columns())


def test_csv_reads_back_to_the_same_numbers(tmp_path: Path, record: ExportRecord) -> None:
    path, beside = write_csv(tmp_path / "007.csv", record)
    options = pc.ConvertOptions(column_types=arrow_schema(), null_values=[])
    assert equal(from_arrow(pc.read_csv(path, convert_options=options)), record.cycles)
    with path.open(newline="") as stream:
        header = next(csv.reader(stream))
    described = json.loads(beside.read_text())
    assert [column["name"] for column in described["tableSchema"]["columns"]] == header
    assert described["url"] == path.name
    by_name = {column["name"]: column for column in described["tableSchema"]["columns"]}
    assert by_name["velocity_arm"]["unit"] == "rad/s"
    assert by_name["tick"]["datatype"] == "integer"
    assert described["golfbench"] == record.metadata


def test_mat_reads_back_to_the_same_numbers(tmp_path: Path, record: ExportRecord) -> None:
    (path,) = write_mat(tmp_path / "007.mat", record)
    read = loadmat(path, simplify_cells=True)
    back = np.zeros(len(record.cycles), CYCLE)
    for field in FIELDS:
        back[field.name] = read["cycles"][field.name]
    assert equal(back, record.cycles)
    assert read["units"]["angle"] == "rad"
    assert list(read["components"]["angle"]) == ["shoulder", "arm", "wrist"]
    assert json.loads(read["metadata"]) == record.metadata


def test_mcap_reads_back_to_the_same_numbers(tmp_path: Path, record: ExportRecord) -> None:
    (path,) = write_mcap(tmp_path / "007.mcap", record)
    back, times, properties = np.zeros(len(record.cycles), CYCLE), [], {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for n, (schema, channel, message) in enumerate(reader.iter_messages()):
            assert schema is not None
            assert (schema.encoding, channel.message_encoding, channel.topic) == (
                "jsonschema",
                "json",
                "/cycle",
            )
            row, properties = json.loads(message.data), json.loads(schema.data)["properties"]
            for field in FIELDS:
                found = row[field.name] if field.components else row
                numbers = [found.get(name, np.nan) for name in field.components or (field.name,)]
                back[field.name][n] = numbers if field.components else numbers[0]
            times.append(message.log_time)
        (metadata,) = reader.iter_metadata()
    assert equal(back, record.cycles)
    assert properties["angle"]["properties"]["wrist"]["unit"] == "rad"
    assert [properties["plant_effort"]["properties"][j]["unit"] for j in ("shoulder", "arm")] == ["N m", "N"]
    assert {key: json.loads(value) for key, value in metadata.metadata.items()} == record.metadata
    assert times[0] == 1793525400 * 10**9
    steps = np.diff(times) - np.round(np.diff(record.cycles["time"]) * 1e9)
    assert np.abs(steps).max() <= 1


def test_rrd_holds_every_field_as_it_was(tmp_path: Path, record: ExportRecord) -> None:
    (path,) = write_rrd(tmp_path / "007.rrd", record)
    values: dict[str, Any] = {}
    units: dict[str, str] = {}
    times: dict[str, Any] = {}
    for chunk in RrdReader(path).stream():
        name = str(chunk.entity_path)
        if not name.startswith("/record/"):
            continue
        batch = chunk.to_record_batch()
        if chunk.is_static:
            columns = [c for c in batch.schema.names if c.endswith("unit")]
            units |= {name[8:]: batch.column(c).to_pylist()[0][0] for c in columns}
        else:
            values[name[8:]] = np.array(batch.column("Scalars:scalars").to_pylist())
            times[name[8:]] = batch.column("bench_time").cast("int64").to_numpy()
    assert set(values) == {field.name for field in FIELDS}
    for field in FIELDS:
        stored = record.cycles[field.name].reshape(len(record.cycles), -1)
        assert np.array_equal(values[field.name], stored.astype(float), equal_nan=True), field.name
        assert units[field.name] == field.unit
    expected = np.round((record.cycles["time"] - record.cycles["time"][0]) * 1e9)
    assert np.array_equal(times["angle"], expected)


def assert_readable(schema: dict[str, Any], value: Any) -> None:
    """Hold a schema and a value against the rules of Foxglove's schema parser: one type a property."""
    kind = schema["type"]
    assert kind in {"boolean", "string", "number", "integer", "object"}
    assert not {"anyOf", "oneOf", "allOf", "$ref"} & schema.keys()
    if kind == "object":
        assert isinstance(value, dict)
        assert value.keys() <= schema["properties"].keys()
        assert set(schema.get("required", ())) <= value.keys()
        for name, part in schema["properties"].items():
            if name in value:
                assert_readable(part, value[name])
            else:
                assert part["type"] == "number", name
    else:
        python = {"boolean": bool, "string": str, "number": float, "integer": int}[kind]
        assert type(value) is python


def test_mcap_is_readable_by_viewers_that_take_one_type_a_property(
    tmp_path: Path, record: ExportRecord
) -> None:
    (path,) = write_mcap(tmp_path / "007.mcap", record)
    with path.open("rb") as stream:
        for schema, _, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert_readable(json.loads(schema.data), json.loads(message.data))


@pytest.mark.parametrize("write", [write_csv, write_mat, write_mcap, write_rrd])
def test_a_folder_that_is_not_there_is_told(
    write: Callable[[Path, ExportRecord], list[Path]], record: ExportRecord
) -> None:
    with pytest.raises(NotStored):
        write(Path("/nonexistent/x"), record)


@pytest.mark.parametrize("write", [write_csv, write_mat, write_mcap, write_rrd])
def test_a_record_without_cycles_can_be_exported(
    write: Callable[[Path, ExportRecord], list[Path]], record: ExportRecord, tmp_path: Path
) -> None:
    for path in write(tmp_path / "empty", record._replace(cycles=record.cycles[:0])):
        assert path.stat().st_size > 0
