"""Records as CSV (RFC 4180), MATLAB's format 5 and MCAP.

CSV (RFC 4180): a header row, then one row per cycle. `NAME.csv-metadata.json` in the same folder, where the
W3C's "Metadata Vocabulary for Tabular Data" expects it, holds names, types, descriptions and units of the
columns, and the record's metadata under `golfbench`. Numbers have the fewest digits that read back to the
same number; an unknown number is `nan`.

MATLAB's format 5, compressed; `scipy.io.loadmat` and Octave read it too. Variables: `cycles`, a struct with a
field for each field of the record, (n, 1) or (n, 3) and so on; `units`, `descriptions` and `components`,
structs with the same fields; `metadata`, the record's as JSON text.

MCAP, the container of robotics, for Foxglove's line of viewers and PlotJuggler; all channels are JSON:
`/cycle`, a message a cycle, whose vectors are objects by component (`/cycle.angle.wrist`), and `/log`, the
changes of the state and the cause of a stop. The schema of `/cycle` carries each value's unit and description
and the names of its codes; the metadata record `golfbench` is the record's own. JSON has no NaN: an unknown
number is left out of its message. It is not null, which would make its type a union: viewers of Foxglove's
line refuse a channel whose schema has one, and need one type a property, no references, and enumerations as
alternatives of number constants with titles. Time stamps are UTC if the record has its time, else from zero.
A layout is stored in the same folder.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from importlib import resources
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow.csv as pc
from scipy.io import savemat

from bench.base.atomic_file import atomic_file, write_whole
from bench.base.errors import load_extra
from bench.base.lifecycle import CAUSE_TEXT, Cause, Phase, Reaction, State
from bench.records.telemetry.cycle_record import (
    ENUMERATIONS,
    FIELDS,
    SCHEMA_VERSION,
    Field,
    to_arrow,
    unit_of,
)
from bench.records.telemetry.record_file import SwingRecord


class Change(NamedTuple):
    """A cycle whose state, phase, reaction or cause differs from that of the cycle before."""

    row: int
    cause: Cause
    """Cause of a stop; NONE without one."""
    text: str


def changes(cycles: np.ndarray[Any, Any]) -> Iterator[Change]:
    """Yield each change in `cycles`, the first cycle included."""
    keys = np.stack([cycles[name].astype(int) for name in ("state", "phase", "reaction", "cause")], axis=1)
    before = np.vstack([np.full((1, 4), -1), keys[:-1]])
    for row in np.flatnonzero(np.any(keys != before, axis=1)):
        state, phase, reaction, cause = keys[row].tolist()
        text = f"{State(state).name}, phase {Phase(phase).name}, reaction {Reaction(reaction).name}"
        yield Change(int(row), Cause(cause), f"{text}: {CAUSE_TEXT[Cause(cause)]}" if cause else text)


_TYPES = {"double": "number", "int64": "integer", "int32": "integer", "uint8": "integer", "bool": "boolean"}


def write_csv(path: Path, record: SwingRecord) -> list[Path]:
    """Write `record` to `path` and its metadata next to it; return both paths.

    Raises:
        NotStored: they cannot be stored.
    """
    table = to_arrow(record.cycles)
    described = [
        {
            "name": field.name,
            "datatype": _TYPES[str(field.type)],
            "unit": field.metadata[b"unit"].decode(),
            "dc:description": field.metadata[b"description"].decode(),
        }
        for field in table.schema
    ]
    metadata = {
        "@context": "http://www.w3.org/ns/csvw",
        "url": path.name,
        "tableSchema": {"columns": described, "primaryKey": "tick"},
        "golfbench": record.metadata,
    }
    beside = path.with_name(f"{path.name}-metadata.json")
    write_whole(beside, json.dumps(metadata, indent=1, allow_nan=False))
    with atomic_file(path) as stream:
        pc.write_csv(table, stream, pc.WriteOptions(quoting_style="needed"))
    return [path, beside]


def write_mat(path: Path, record: SwingRecord) -> list[Path]:
    """Write `record` to `path` and return it; raises NotStored: it cannot be stored."""
    cycles = record.cycles
    variables = {
        "cycles": {f.name: cycles[f.name].reshape(len(cycles), len(f.columns)) for f in FIELDS},
        "units": {f.name: f.unit for f in FIELDS},
        "descriptions": {f.name: f.text for f in FIELDS},
        "components": {f.name: np.array(f.components or (f.name,), dtype=object) for f in FIELDS},
        "metadata": json.dumps(record.metadata, allow_nan=False),
    }
    with atomic_file(path) as stream:
        savemat(cast(Any, stream), variables, do_compression=True, long_field_names=True)
    return [path]


LAYOUT = "foxglove_layout.json"
"""Name of the layout's file, in this package and next to the exported file."""
Schema = dict[str, Any]
_LEVELS = ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")


def write_mcap(path: Path, record: SwingRecord) -> list[Path]:
    """Write `record` to `path` and the layout next to it; return both paths.

    Raises:
        BenchError: the package mcap is not installed.
        NotStored: they cannot be stored.
    """
    mcap = load_extra("mcap.writer", "mcap", "export --format mcap")
    schemas = {
        "/cycle": (f"golfbench.Cycle.{SCHEMA_VERSION}", cycle_schema()),
        "/log": ("foxglove.Log", _log_schema()),
    }
    with atomic_file(path) as stream:
        writer = mcap.Writer(stream, compression=mcap.CompressionType.ZSTD)
        writer.start(library=f"golfbench {version('golfbench')}")
        channels = {
            topic: writer.register_channel(
                topic, "json", writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            )
            for topic, (name, schema) in schemas.items()
        }
        for topic, at, number, content in _messages(record):
            message = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channels[topic], at, message, at, number)
        writer.add_metadata("golfbench", {key: json.dumps(value) for key, value in record.metadata.items()})
        writer.finish()
    layout = path.with_name(LAYOUT)
    write_whole(layout, resources.files("bench.viewer").joinpath(LAYOUT).read_bytes())
    return [path, layout]


def _enumeration(names: Mapping[int, str], **about: str) -> Schema:
    """Return the schema of a code with `names`; `about` are further keys."""
    return {**about, "oneOf": [{"title": name, "const": code} for code, name in names.items()]}


def _log_schema() -> Schema:
    """Return the JSON Schema of Foxglove's well-known message `foxglove.Log`."""
    integer, text = {"type": "integer", "minimum": 0}, {"type": "string"}
    time = {"sec": integer, "nsec": integer | {"maximum": 999_999_999}}
    properties = {
        "timestamp": {"title": "time", "type": "object", "properties": time, "required": list(time)},
        "level": _enumeration(dict(enumerate(_LEVELS)), title="foxglove.LogLevel"),
        "message": text,
        "name": text,
        "file": text,
        "line": integer,
    }
    return {"title": "foxglove.Log", "type": "object", "properties": properties, "required": list(properties)}


def cycle_schema() -> Schema:
    """Return the JSON Schema of a cycle's message, with the `unit` of each number."""
    return {
        "title": "golfbench.Cycle",
        "type": "object",
        "properties": {field.name: _property(field) for field in FIELDS},
        "required": [field.name for field in FIELDS if field.components or field.dtype != "f8"],
    }


def _property(field: Field) -> Schema:
    if field.names:
        names = {int(code): name for code, name in ENUMERATIONS[field.names].items()}
        return _enumeration(names, unit=field.unit, description=field.text)
    kind = {"f8": "number", "?": "boolean"}.get(field.dtype, "integer")
    if not field.components:
        return {"type": kind, "unit": field.unit, "description": field.text}
    inner = {name: {"type": kind, "unit": unit_of(field, n)} for n, name in enumerate(field.components)}
    return {"type": "object", "description": field.text, "properties": inner}


def _messages(record: SwingRecord) -> Iterator[tuple[str, int, int, dict[str, Any]]]:
    cycles = record.cycles
    # Two parts: seconds since 1970 have no nanoseconds in a double.
    begin = round(record.begin_utc * 1e6) * 1000
    times = [max(0, begin + round(at * 1e9)) for at in cycles["time"].tolist()]
    for row, at in zip(_rows(cycles), times, strict=True):
        yield "/cycle", at, max(0, row["tick"]) & 0xFFFFFFFF, row
    for number, change in enumerate(changes(cycles)):
        at, level = times[change.row], _LEVELS.index("ERROR" if change.cause else "INFO")
        stamp = {"sec": at // 10**9, "nsec": at % 10**9}
        content = {"level": level, "message": change.text, "name": "golfbench", "file": "", "line": 0}
        yield "/log", at, number, {"timestamp": stamp, **content}


def _rows(cycles: np.ndarray[Any, Any]) -> Iterator[dict[str, Any]]:
    values = [cycles[field.name].tolist() for field in FIELDS]
    for row in zip(*values, strict=True):
        yield {
            field.name: _known(zip(field.components, value, strict=True)) if field.components else value
            for field, value in zip(FIELDS, row, strict=True)
            if field.components or _is_known(value)
        }


def _known(parts: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in parts if _is_known(value)}


def _is_known(value: Any) -> bool:
    return not isinstance(value, float) or isfinite(value)
