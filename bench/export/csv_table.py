"""CSV (RFC 4180): a header row, a row a cycle; beside it units and metadata as JSON.

Beside `NAME.csv` stands `NAME.csv-metadata.json`, where the W3C's "Metadata Vocabulary for Tabular Data"
looks for it: names, types, descriptions and units of the columns; the record's metadata under `golfbench`.
Numbers have the fewest digits that read back to the same number; what is not known is `nan`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pc

from bench.export.record import ExportRecord, columns
from bench.telemetry.cycle_record import to_arrow
from bench.telemetry.whole_file import whole_file

_TYPES = {"double": "number", "int64": "integer", "int32": "integer", "uint8": "integer", "bool": "boolean"}


def write_csv(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and its metadata beside it; return both paths.

    Raises:
        NotStored: they cannot be stored.
    """
    table = to_arrow(record.cycles)
    beside = path.with_name(f"{path.name}-metadata.json")
    with whole_file(beside) as stream:
        stream.write(json.dumps(_metadata(path, record, table.schema), indent=1, allow_nan=False).encode())
    with whole_file(path) as stream:
        pc.write_csv(table, stream, pc.WriteOptions(quoting_style="needed"))
    return [path, beside]


def _metadata(path: Path, record: ExportRecord, schema: pa.Schema) -> dict[str, Any]:
    described = [
        {
            "name": column.name,
            "datatype": _TYPES[str(schema.field(column.name).type)],
            "unit": column.unit,
            "dc:description": column.description,
        }
        for column in columns()
    ]
    return {
        "@context": "http://www.w3.org/ns/csvw",
        "url": path.name,
        "tableSchema": {"columns": described, "primaryKey": "tick"},
        "golfbench": record.metadata,
    }
