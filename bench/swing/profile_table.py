"""The table of a profile as a Parquet file: exact decimals, small by delta coding.

One row a sample. Each column is a decimal of fixed scale, so that any Parquet reader shows rad, rad/s and
openings, and it is read back bit for bit. A blind-brake pattern stands at the sample where it begins; the
rows between are null. Elsewhere a null is -0.0, which a decimal cannot hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import JOINTS

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

DIGITS = {"angle": 6, "velocity": 4, "valve": 5, "blind_brake": 4}
"""Digits behind the decimal point of each table in a file."""

COLUMNS = {
    "angle": [f"angle_{joint}_rad" for joint in JOINTS],
    "velocity": [f"velocity_{joint}_rad_per_s" for joint in JOINTS],
    "valve": [f"valve_{joint}" for joint in JOINTS],
    "blind_brake": [
        *(f"blind_brake_{joint}" for joint in JOINTS),
        *(f"blind_brake_{joint}_s" for joint in JOINTS),
    ],
}
"""Names of the columns of each table, in order."""

_DECIMALS = 9
"""Decimal places that fit into 32 bits."""


def encode_table(tables: Mapping[str, Array], blind_spacing: int) -> bytes:
    """Return the Parquet file of `tables`, as in DIGITS, rounded to them.

    `tables` holds arrays (n, 3), and for "blind_brake" (m, 6) a row every `blind_spacing` samples.
    """
    import pyarrow as pa  # slow to import, and needed for files only
    from pyarrow import parquet

    rows = len(tables["angle"])
    columns: dict[str, Any] = {}
    for key, names in COLUMNS.items():
        at = slice(None, None, blind_spacing if key == "blind_brake" else 1)
        for name, values in zip(names, tables[key].T, strict=True):
            columns[name] = _decimals(values, DIGITS[key], rows, at)
    file = BytesIO()
    parquet.write_table(
        pa.table(columns),
        file,
        compression="zstd",
        compression_level=19,
        use_dictionary=False,
        write_statistics=False,
        store_schema=False,
        store_decimal_as_integer=True,
        column_encoding=dict.fromkeys(columns, "DELTA_BINARY_PACKED"),
    )
    return file.getvalue()


def decode_table(content: bytes, blind_spacing: int) -> dict[str, Array]:
    """Return the tables in the Parquet file `content`, as `encode_table` takes them.

    Raises:
        ValueError: `content` is not such a file; the text names the error.
    """
    import pyarrow as pa
    from pyarrow import parquet

    try:
        found = parquet.ParquetFile(BytesIO(content)).read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise ValueError(f"no Parquet file: {error}") from None
    tables = {}
    for key, names in COLUMNS.items():
        missing = [name for name in names if found.schema.get_all_field_indices(name) == []]
        if missing:
            raise ValueError(f"no column {missing[0]}")
        at = slice(None, None, blind_spacing if key == "blind_brake" else 1)
        columns = [_numbers(found.column(name), name)[at] for name in names]
        tables[key] = np.column_stack(columns) if len(found) else np.zeros((0, len(names)))
    return tables


def _decimals(values: Array, digits: int, rows: int, at: slice) -> pa.Array:
    """Return a column of `rows` decimals, null but for `values` in the rows `at`; -0.0 is also null."""
    import pyarrow as pa

    rounded = np.round(values, digits)
    low, valid = np.zeros(rows, dtype=np.int64), np.zeros(rows, dtype=bool)
    low[at] = np.rint(rounded * 10**digits)
    valid[at] = ~((rounded == 0.0) & np.signbit(rounded))
    words = np.column_stack([low, low >> 63])
    bits = np.packbits(valid, bitorder="little")
    buffers = [pa.py_buffer(bits.tobytes()), pa.py_buffer(words.tobytes())]
    return pa.Array.from_buffers(pa.decimal128(_DECIMALS, digits), rows, buffers)


def _numbers(column: pa.ChunkedArray, name: str) -> Array:
    """Return a column of decimals as the nearest numbers; null is -0.0.

    Raises:
        ValueError: the column has another type.
    """
    import pyarrow as pa

    if not pa.types.is_decimal128(column.type) or column.type.precision > _DECIMALS:
        raise ValueError(f"column {name} of type {column.type}, not decimal")
    # A whole number over a power of ten is rounded once, to the number that the decimal text means.
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks)
    bits, words = array.buffers()  # read here: pyarrow would import pandas first
    within = slice(array.offset, array.offset + len(array))
    low = np.frombuffer(words, dtype=np.int64).reshape(-1, 2)[within, 0]
    numbers: Array = low / 10**column.type.scale
    if bits is None:
        return numbers
    valid = np.unpackbits(np.frombuffer(bits, dtype=np.uint8), bitorder="little")[within]
    numbers[valid == 0] = -0.0
    return numbers
