"""Rerun's format: what `golfbench view --save` writes, and every field of the record in its own unit.

The fields stand below `record/`, a row a cycle on `bench_time`; each entity carries its unit and description.
The record's metadata are properties of the recording.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import rerun as rr

from bench.records.shot.recorded_shot import recorded_shot
from bench.records.telemetry.cycle_record import FIELDS
from bench.viewer.export.record_files import ExportRecord
from bench.viewer.recording import log_shots, writing_recording
from bench.viewer.signals import bench_time, send_scalars


def write_rrd(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and return it.

    Raises:
        NotStored: it cannot be stored.
        ExceptionGroup: one BenchError for each value of its configuration that this program rejects.
    """
    shot = recorded_shot(record.cycles, record.metadata, str(record.path))
    with writing_recording(path, [shot.record], str(record.path)) as recording:
        log_shots(recording, [shot.record], shot.plant)
        recording.send_property(
            "golfbench",
            rr.AnyValues(**cast(Any, {key: json.dumps(value) for key, value in record.metadata.items()})),
        )
        if len(record.cycles):
            _log_fields(recording, record)
    return [path]


def _log_fields(recording: rr.RecordingStream, record: ExportRecord) -> None:
    time = bench_time(record.cycles["time"] - record.cycles["time"][0])
    for field in FIELDS:
        entity = f"record/{field.name}"
        rows = record.cycles[field.name].astype(float).reshape(len(record.cycles), len(field.columns))
        send_scalars(recording, entity, time, rows)
        names = rr.SeriesLines(names=list(field.components or (field.name,)))
        facts = rr.AnyValues(unit=field.unit, description=field.text)
        recording.log(entity, names, facts, static=True)
