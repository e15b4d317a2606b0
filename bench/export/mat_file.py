"""MATLAB's format 5, compressed; `scipy.io.loadmat` and Octave read it too.

Variables: `cycles`, a struct with a field for each field of the record, (n, 1) or (n, 3) and so on;
`units`, `descriptions` and `components`, structs with the same fields; `metadata`, the record's as JSON text.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.io import savemat

from bench.export.record import ExportRecord
from bench.telemetry.cycle_record import FIELDS
from bench.telemetry.whole_file import whole_file


def write_mat(path: Path, record: ExportRecord) -> list[Path]:
    """Write `record` to `path` and return it.

    Raises:
        NotStored: it cannot be stored.
    """
    count = len(record.cycles)
    variables = {
        "cycles": {
            field.name: record.cycles[field.name].reshape(count, len(field.columns)) for field in FIELDS
        },
        "units": {field.name: field.unit for field in FIELDS},
        "descriptions": {field.name: field.text for field in FIELDS},
        "components": {
            field.name: np.array(field.components or (field.name,), dtype=object) for field in FIELDS
        },
        "metadata": json.dumps(record.metadata, allow_nan=False),
    }
    with whole_file(path) as stream:
        savemat(cast(Any, stream), variables, do_compression=True, long_field_names=True)
    return [path]
