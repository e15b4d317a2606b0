"""MCAP, the container of robotics: one channel `/cycle` of JSON messages, a message a cycle.

Vectors are objects by component, so that a plot names `/cycle.angle.wrist`. The channel's JSON schema carries
each value's unit and description, the file's metadata record `golfbench` the record's own. JSON has no NaN:
an unknown number is left out of its message. It is not null, which would make its type a union: viewers of
Foxglove's line refuse a channel whose schema has one. Time stamps are UTC if the record has its time, else
from zero.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from bench.export.record import ExportRecord
from bench.telemetry.cycle_record import FIELDS, SCHEMA_VERSION, Field
from bench.telemetry.whole_file import whole_file

TOPIC = "/cycle"


def write_mcap(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and return it.

    Raises:
        NotStored: it cannot be stored.
    """
    with whole_file(path) as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(library=f"golfbench {version('golfbench')}")
        schema = writer.register_schema(
            f"golfbench.Cycle.{SCHEMA_VERSION}", "jsonschema", json.dumps(json_schema()).encode()
        )
        channel = writer.register_channel(TOPIC, "json", schema)
        begin = record.begin_utc
        for row in _rows(record):
            # Two parts: seconds since 1970 have no nanoseconds in a double.
            at = max(0, round(begin * 1e6) * 1000 + round(row["time"] * 1e9))
            message = json.dumps(row, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channel, at, message, at, max(0, row["tick"]) & 0xFFFFFFFF)
        writer.add_metadata("golfbench", {key: json.dumps(value) for key, value in record.metadata.items()})
        writer.finish()  # type: ignore[no-untyped-call]
    return [path]


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a message, with `unit` beside each number."""
    return {
        "title": "golfbench.Cycle",
        "type": "object",
        "properties": {field.name: _property(field) for field in FIELDS},
        "required": [field.name for field in FIELDS if field.components or field.dtype != "f8"],
    }


def _property(field: Field) -> dict[str, Any]:
    kind = {"f8": "number", "?": "boolean"}.get(field.dtype, "integer")
    if not field.components:
        return {"type": kind, "unit": field.unit, "description": field.text}
    units = field.unit.split(", ")
    units = units if len(units) > 1 else units * len(field.components)
    inner = {name: {"type": kind, "unit": unit} for name, unit in zip(field.components, units, strict=True)}
    return {"type": "object", "description": field.text, "properties": inner}


def _rows(record: ExportRecord) -> Iterator[dict[str, Any]]:
    """Yield the messages' contents."""
    values = [record.cycles[field.name].tolist() for field in FIELDS]
    for row in zip(*values, strict=True):
        contents = zip(FIELDS, row, strict=True)
        yield {
            field.name: _known(zip(field.components, value, strict=True)) if field.components else value
            for field, value in contents
            if field.components or _is_known(value)
        }


def _known(parts: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {name: value for name, value in parts if _is_known(value)}


def _is_known(value: Any) -> bool:
    return not isinstance(value, float) or isfinite(value)
