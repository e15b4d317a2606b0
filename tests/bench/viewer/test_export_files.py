from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars
import pyarrow.csv as pc
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader
from scipy.io import loadmat

from bench.base.atomic_file import NotStored
from bench.base.errors import BenchError
from bench.base.lifecycle import Phase, State
from bench.records.telemetry.cycle_record import CYCLE, FIELDS, arrow_schema, from_arrow
from bench.records.telemetry.record_file import SwingRecord, read_swing, write_swing
from bench.viewer.export_files import changes, cycle_schema, write_csv, write_mat, write_mcap
from bench.viewer.rerun_recording import write_rrd

Cycles = np.ndarray[Any, Any]
BEGIN = "2026-11-01T09:30:00+00:00"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory, make_swing: Callable[[int], Cycles]) -> SwingRecord:
    """A record with awkward values: no pressure sensors, large counts, non-terminating fractions."""
    cycles = make_swing(3)[700:1000].copy()
    cycles["chamber_pressure"] = np.nan
    cycles["plant_pressure"][0, 0] = np.nan
    cycles["encoder_count"][0] = 2**52 + 1
    cycles["angle"][1] = [1 / 3, 1e-300, -0.0]
    path = tmp_path_factory.mktemp("records") / "007.parquet"
    write_swing(path, cycles, {"number": 7, "time_utc": BEGIN, "profile": {"name": "default"}})
    return SwingRecord(path, *read_swing(path))


def equal(a: Cycles, b: Cycles) -> bool:
    return all(
        np.array_equal(a[f.name], b[f.name], equal_nan=f.dtype == "f8") and a[f.name].dtype == b[f.name].dtype
        for f in FIELDS
    )


def test_csv_read_back_equals_record(tmp_path: Path, record: SwingRecord) -> None:
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
    assert by_name["chamber_pressure_right_arm_b"]["unit"] == "Pa"
    assert all(column["unit"] and column["dc:description"] for column in by_name.values())
    assert by_name["tick"]["datatype"] == "integer"
    assert described["golfbench"] == record.metadata


def test_mat_read_back_equals_record(tmp_path: Path, record: SwingRecord) -> None:
    (path,) = write_mat(tmp_path / "007.mat", record)
    read = loadmat(path, simplify_cells=True)
    back = np.zeros(len(record.cycles), CYCLE)
    for field in FIELDS:
        back[field.name] = read["cycles"][field.name]
    assert equal(back, record.cycles)
    assert read["units"]["angle"] == "rad"
    assert list(read["components"]["angle"]) == ["shoulder", "arm", "wrist"]
    assert json.loads(read["metadata"]) == record.metadata


def read_mcap(path: Path) -> dict[str, list[tuple[Any, Any, Any]]]:
    """Return schema, message and its contents by topic, by the `mcap` package."""
    found: dict[str, list[tuple[Any, Any, Any]]] = {}
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            row = schema, message, json.loads(message.data)
            found.setdefault(channel.topic, []).append(row)
    return found


def test_mcap_read_back_equals_record(tmp_path: Path, record: SwingRecord) -> None:
    path, _ = write_mcap(tmp_path / "007.mcap", record)
    back, times, properties = np.zeros(len(record.cycles), CYCLE), [], {}
    for n, (schema, message, row) in enumerate(read_mcap(path)["/cycle"]):
        properties = json.loads(schema.data)["properties"]
        for field in FIELDS:
            found = row[field.name] if field.components else row
            numbers = [found.get(name, np.nan) for name in field.components or (field.name,)]
            back[field.name][n] = numbers if field.components else numbers[0]
        times.append(message.log_time)
    with path.open("rb") as stream:
        (metadata,) = make_reader(stream).iter_metadata()
    assert equal(back, record.cycles)
    assert properties["angle"]["properties"]["wrist"]["unit"] == "rad"
    assert [properties["plant_effort"]["properties"][j]["unit"] for j in ("shoulder", "arm")] == ["N m", "N"]
    assert {"title": "DOWNSWING", "const": int(Phase.DOWNSWING)} in properties["phase"]["oneOf"]
    assert {key: json.loads(value) for key, value in metadata.metadata.items()} == record.metadata
    assert times[0] == 1793525400 * 10**9
    steps = np.diff(times) - np.round(np.diff(record.cycles["time"]) * 1e9)
    assert np.abs(steps).max() <= 1


def test_mcap_contains_log(tmp_path: Path, record: SwingRecord) -> None:
    path, _ = write_mcap(tmp_path / "007.mcap", record)
    log = read_mcap(path)["/log"]
    assert log[0][0].name == "foxglove.Log"
    assert log[0][2]["level"] == 2
    assert [row["message"] for _, _, row in log] == [change.text for change in changes(record.cycles)]


def test_mcap_layout_names_existing_topics_and_fields(tmp_path: Path, record: SwingRecord) -> None:
    path, layout = write_mcap(tmp_path / "007.mcap", record)
    read, topics = json.loads(layout.read_text()), read_mcap(path)
    panels = read["configById"]

    def leaves(part: Any) -> list[str]:
        return [part] if isinstance(part, str) else leaves(part["first"]) + leaves(part["second"])

    assert sorted(leaves(read["layout"])) == sorted(panels)
    schema = cycle_schema()
    plotted = [p["value"] for panel in panels.values() for p in panel.get("paths", ())]
    assert len(plotted) == 14
    for name in plotted:
        topic, *parts = name.removeprefix("/").split(".")
        part = schema
        for key in parts:
            part = part["properties"][key]
        assert (topic, "type" in part or "oneOf" in part) == ("cycle", True)
    assert panels["RosOut!log"]["topicToRender"] in topics


def test_record_opens_in_duckdb_and_polars(record: SwingRecord) -> None:
    """Names in addition to numbers, and units in the file's own metadata."""
    path, phases = record.path, record.cycles["phase"]
    with duckdb.connect() as connection:
        rows = connection.execute(
            "select phase_name, count(*), max(phase) from read_parquet(?) group by 1", [str(path)]
        ).fetchall()
        facts = connection.execute(
            "select decode(value) from parquet_kv_metadata(?) where decode(key) = 'units'", [str(path)]
        ).fetchone()
    names = {Phase(int(code)).name: (int(np.sum(phases == code)), int(code)) for code in np.unique(phases)}
    assert {name: (count, code) for name, count, code in rows} == names
    assert facts is not None
    assert json.loads(facts[0])["angle_wrist"] == "rad"
    frame = polars.read_parquet(path)
    assert frame["state_name"].to_list() == [State(int(code)).name for code in record.cycles["state"]]
    assert np.array_equal(frame["angle_wrist"].to_numpy(), record.cycles["angle"][:, 2])
    assert json.loads(polars.read_parquet_metadata(path)["units"])["velocity_arm"] == "rad/s"


@pytest.mark.requires("octave")
def test_mat_opens_in_octave(tmp_path: Path, record: SwingRecord, tool: Callable[[str], str]) -> None:
    (path,) = write_mat(tmp_path / "007.mat", record)
    script = f"load('{path}'); printf('%s %.17g', units.angle, cycles.angle(2, 1))"
    done = subprocess.run(
        [tool("octave"), "--eval", script], capture_output=True, text=True, check=True, timeout=100
    )
    unit, value = done.stdout.split()
    assert (unit, float(value)) == ("rad", record.cycles["angle"][1, 0])


def test_rrd_holds_every_field_unchanged(tmp_path: Path, record: SwingRecord) -> None:
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


def test_rrd_passes_rerun_verify(tmp_path: Path, record: SwingRecord) -> None:
    (path,) = write_rrd(tmp_path / "007.rrd", record)
    check = [sys.executable, "-m", "rerun", "rrd", "verify", str(path)]
    done = subprocess.run(check, capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stdout + done.stderr


def assert_readable(schema: dict[str, Any], value: Any) -> None:
    """Hold a schema and a value against the rules of Foxglove's schema parser: one type a property."""
    assert not {"anyOf", "allOf", "$ref", "enum"} & schema.keys()
    if "oneOf" in schema:  # an enumeration: number constants with titles
        assert all(type(one["const"]) is int and one["title"] for one in schema["oneOf"])
        assert value in [one["const"] for one in schema["oneOf"]]
        return
    kind = schema["type"]
    assert kind in {"boolean", "string", "number", "integer", "object", "array"}
    if kind == "object":
        assert isinstance(value, dict)
        assert value.keys() <= schema["properties"].keys()
        assert set(schema.get("required", ())) <= value.keys()
        for name, part in schema["properties"].items():
            if name in value:
                assert_readable(part, value[name])
            else:
                assert part["type"] == "number", name
    elif kind == "array":
        for item in value:
            assert_readable(schema["items"], item)
    else:
        python = {"boolean": bool, "string": str, "number": float, "integer": int}[kind]
        assert type(value) is python


def test_mcap_schemas_have_one_type_per_property(tmp_path: Path, record: SwingRecord) -> None:
    path, _ = write_mcap(tmp_path / "007.mcap", record)
    for rows in read_mcap(path).values():
        for schema, _, content in rows:
            assert_readable(json.loads(schema.data), content)


def test_mcap_missing_package_states_extra_to_install(
    tmp_path: Path, record: SwingRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(BenchError, match=r"golfbench\[mcap\]"):
        write_mcap(tmp_path / "007.mcap", record)


@pytest.mark.parametrize("write", [write_csv, write_mat, write_mcap, write_rrd])
def test_export_without_cycles_writes_file_and_without_folder_raises(
    write: Callable[[Path, SwingRecord], list[Path]], record: SwingRecord, tmp_path: Path
) -> None:
    for path in write(tmp_path / "empty", record._replace(cycles=record.cycles[:0])):
        assert path.stat().st_size > 0
    with pytest.raises(NotStored):
        write(tmp_path / "absent" / "x", record)
