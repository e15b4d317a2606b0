"""MDF 4.1 (ASAM) by asammdf, for CANape, INCA and NI: a channel a column, with units, names and events.

Codes have their names as a conversion from value to text. Each change of state, phase, reaction or cause is
an event, the record's metadata are an attached JSON text. Time is from zero, the file's begin is the record's
in UTC, if it has one. A channel without a measured value, NaN throughout, is left out.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from bench.errors import BenchError
from bench.export.record import ExportRecord, changes
from bench.telemetry.cycle_record import FIELDS, Field, unit_of
from bench.telemetry.enumerations import ENUMERATIONS
from bench.telemetry.whole_file import whole_file

_COMMENT = "<EVcomment><TX>{}</TX><tool>golfbench</tool></EVcomment>"


def write_mf4(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and return it.

    Raises:
        NotStored: it cannot be stored.
        BenchError: asammdf is not installed.
    """
    try:
        from asammdf import MDF
        from asammdf.blocks.v4_blocks import EventBlock
        from asammdf.blocks.v4_constants import EVENT_CAUSE_SCRIPT, EVENT_TYPE_MARKER
    except ImportError as error:
        action = "Install it: pip install 'golfbench[mdf]'."
        raise BenchError("export to mf4", f"{error}", "the package asammdf", action) from error
    cycles = record.cycles
    begin = record.begin_utc + (float(cycles["time"][0]) if len(cycles) else 0.0)
    with MDF(version="4.10") as file:
        file.header.start_time = datetime.fromtimestamp(begin, UTC)
        if len(cycles):
            time = cycles["time"] - cycles["time"][0]
            file.append(_signals(cycles, time), comment="a sample a cycle", common_timebase=True)
            for change in changes(cycles):
                event = EventBlock(
                    event_type=EVENT_TYPE_MARKER,
                    cause=EVENT_CAUSE_SCRIPT,
                    sync_base=round(1e9 * float(time[change.row])),
                    sync_factor=1e-9,
                )
                event.name, event.comment = change.text, _COMMENT.format(escape(change.text))
                file.events.append(event)
        text = json.dumps(record.metadata, allow_nan=False).encode()
        file.attach(text, file_name="golfbench.json", mime="application/json", compression=True)
        written = BytesIO()
        file.save(written)
    with whole_file(path) as stream:
        stream.write(written.getvalue())
    return [path]


def _signals(cycles: np.ndarray[Any, Any], time: np.ndarray[Any, Any]) -> list[Any]:
    from asammdf import Signal

    return [
        Signal(
            np.ascontiguousarray(values),
            time,
            unit="" if unit_of(field, index) == "1" else unit_of(field, index),
            name=column,
            comment=field.text,
            conversion=_names(field),
        )
        for field in FIELDS
        for index, (column, values) in enumerate(
            zip(field.columns, np.atleast_2d(cycles[field.name].T), strict=True)
        )
        if field.dtype != "f8" or not np.isnan(values).all()
    ]


def _names(field: Field) -> dict[str, Any] | None:
    """Return the conversion from the codes of `field` to their names."""
    if not field.names:
        return None
    found: dict[str, Any] = {"default": b"unknown"}
    for number, (code, name) in enumerate(ENUMERATIONS[field.names].items()):
        found |= {f"val_{number}": int(code), f"text_{number}": name.encode()}
    return found
