"""A swing profile: the motion of the robot tick by tick, and open-loop brakes from each instant.

A profile is a short TOML file (golfer, club, times, planned delivery, design limits) and a table in the same
folder. The table is a Parquet file, whose digest the TOML file holds. The table has angles, velocities and
valve openings at a fixed period, and the patterns of the open-loop brake. A TOML file that holds its tables
itself is also a profile. The swing runs from address to standstill after the follow-through; the return is
the controller's.

The table is exact, and small by delta coding: each column is a decimal of fixed scale, so that any Parquet
reader shows rad, rad/s and openings, and its values are read back bit-identical. A pattern of the
open-loop brake is stored at the sample where it begins; the rows between are null. Elsewhere a null is -0.0,
which a decimal cannot hold.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypedDict, cast

import numpy as np
from numpy.typing import NDArray

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError
from bench.base.from_toml import Builder, as_tree, format_value, read_toml
from bench.base.json_schema import require_fit
from bench.base.lifecycle import Phase
from bench.base.to_toml import toml_value
from drivers.base import JOINTS
from drivers.base.ranges import AtLeast, Count, Range

if TYPE_CHECKING:
    import pyarrow as pa

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


Array = NDArray[np.float64]

SCHEMA = "golfbench-profile/2"
"""Schema of a file whose table is a separate file."""
SCHEMA_WITH_TABLES = "golfbench-profile/1"
"""Schema of a file that holds its tables itself."""
PHASES = (
    Phase.HOLD,
    Phase.BACKSWING,
    Phase.TOP,
    Phase.DOWNSWING,
    Phase.COMMITTED,
    Phase.IMPACT,
    Phase.FOLLOW_THROUGH,
)
"""Phases of a profile in their order; each begins where `begins` says."""
BALL_TOLERANCE = 0.0005
"""Max distance of the ball from its place in the profile (m)."""


class FollowedGolfer(TypedDict):
    """Measured swing that a profile follows, and the deviation of the planned motion from it."""

    sha256: str
    """Digest of the golfer's file."""
    follow: Literal["body", "club"]
    """Followed part: angles of shoulders, arm and club, or the club alone."""
    head_speed_mps: float
    """Head speed of the golfer at the ball (m/s)."""
    deviation: Annotated[list[float], Count(4)]
    """Deviations of shoulder, arm, wrist and head as fractions of the golfer's ranges."""
    rms_rad: Annotated[list[float], Count(3)]
    """RMS deviations of shoulder, arm and wrist (rad)."""
    rms_head_m: float
    """RMS deviation of the head (m)."""
    definition: str
    """Definition of the deviations."""


@dataclass(frozen=True)
class Profile:
    """One swing; arrays at `period` s from the start of the swing, n samples, joints in order.

    `angle` (n, 3) rad, `velocity` (n, 3) rad/s, `valve` (n, 3) feed-forward openings, `begins` (7,) the
    sample at which each of PHASES begins, `blind_brake` (m, 6): valve openings and their durations (s) for
    a blind stop that starts at sample k * `blind_spacing`.
    """

    name: str
    text: str
    golfer: str
    club: str
    period: float
    begins: tuple[int, ...]
    angle: Array
    velocity: Array
    valve: Array
    blind_spacing: int
    blind_brake: Array
    ball: tuple[float, float]
    """Place of the ball in the swing plane when the face centre meets it (m)."""
    impact_time: float
    """Planned contact, s from the start."""
    delivery: dict[str, float] = field(default_factory=dict)
    """Planned head_speed_mps, attack_angle_deg, shaft_lean_deg, ball_position, for display and checks."""
    limits: dict[str, float] = field(default_factory=dict)
    """Limits of the design: supply_pressure_pa, greatest_opening, ..."""
    air: tuple[float, ...] = ()
    """Planned pressures of the six chambers at the address, shoulder A and B first (Pa absolute); empty: not
    planned."""
    air_supply: float = 0.0
    """Supply pressure to which `air` belongs (Pa absolute)."""
    corrected: bool = False
    """Whether a learned correction is in its tables."""
    followed: FollowedGolfer | None = None
    """Measured swing of `golfer` that it follows."""

    @property
    def duration(self) -> float:
        """From start to planned standstill, s."""
        return len(self.angle) * self.period

    @property
    def downswing_time(self) -> float:
        """From the top to the ball, s."""
        return self.impact_time - self.begins[PHASES.index(Phase.DOWNSWING)] * self.period

    @property
    def angle_at_impact(self) -> Array:
        """Joint angles (3,) at the planned contact (rad), linear between samples."""
        time = np.arange(len(self.angle)) * self.period
        return np.array([np.interp(self.impact_time, time, column) for column in self.angle.T])

    def phase_of(self, sample: int) -> Phase:
        """Return the phase at `sample`."""
        return PHASES[int(np.searchsorted(self.begins, sample, side="right")) - 1]

    @property
    def phases(self) -> NDArray[np.uint8]:
        """Phase of each sample."""
        return np.array(PHASES, dtype=np.uint8)[
            np.searchsorted(self.begins, np.arange(len(self.angle)), side="right") - 1
        ]


_Place = Annotated[float, Range(-3.0, 3.0, "m")]
_Pressure = Annotated[float, Range(1.0e5, 2.0e6, "Pa absolute")]
_Sample = Annotated[int, AtLeast(0)]
_Row = tuple[float, float, float]
_Pattern = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class _Address:
    """Table `address` of a file."""

    supply_pressure_pa: _Pressure
    chamber_pressures_pa: tuple[_Pressure, _Pressure, _Pressure, _Pressure, _Pressure, _Pressure]

    def __post_init__(self) -> None:
        if max(self.chamber_pressures_pa) >= self.supply_pressure_pa:
            limit = f"less than the supply's {self.supply_pressure_pa:g} Pa"
            raise ValueError(f"chamber_pressures_pa {limit}: the limit of a dithered spool")


_OPTIONAL = {"optional": True}


@dataclass(frozen=True)
class _ProfileFile:
    """Keys of a file besides _TABLES_OF_NUMBERS."""

    schema: Literal["golfbench-profile/2", "golfbench-profile/1"]
    name: str
    text: str
    golfer: str
    club: str
    period_s: Annotated[float, Range(1e-4, 0.02, "s")]
    begins: tuple[_Sample, _Sample, _Sample, _Sample, _Sample, _Sample, _Sample]
    ball_m: tuple[_Place, _Place]
    impact_time_s: float
    blind_spacing: Annotated[int, AtLeast(1)]
    table: str = field(default="", metadata=_OPTIONAL)
    table_sha256: str = field(default="", metadata=_OPTIONAL)
    angle_rad: tuple[_Row, ...] = field(default=(), metadata=_OPTIONAL)
    velocity_rad_per_s: tuple[_Row, ...] = field(default=(), metadata=_OPTIONAL)
    valve: tuple[_Row, ...] = field(default=(), metadata=_OPTIONAL)
    blind_brake: tuple[_Pattern, ...] = field(default=(), metadata=_OPTIONAL)
    address: _Address = field(default=cast("Any", None), metadata=_OPTIONAL)


_TABLES_OF_NUMBERS = {
    "delivery": dict[str, float],
    "limits": dict[str, float],
    "followed": FollowedGolfer | None,
}
"""Tables of a file whose keys may be any, or the golfer's."""
_TABLES = {
    "angle_rad": "angle",
    "velocity_rad_per_s": "velocity",
    "valve": "valve",
    "blind_brake": "blind_brake",
}
"""Key of a table in a file, and its field."""
_BESIDE = ("table", "table_sha256")
"""Keys of a file that names the file of its tables."""
_ACTION = "Correct the profile, or design it again with `golfbench profile design`."
_ACTION_ADDRESS = "Plan them with `golfbench profile address`, or leave the table `address` out."
_ACTION_TABLE = (
    "Copy both files from the same place, or design the profile again with `golfbench profile design`. "
    "To edit a profile, start from `golfbench profile show PROFILE --table`."
)


def load_profile(path: Path) -> Profile:
    """Read and check the profile at `path`.

    Raises:
        BenchError: a file is missing, unreadable or no profile, the table does not match its
            digest, a key is unknown, missing or of the wrong type, a number is not finite or outside its
            physical range, or the tables do not fit together.
    """
    raw = read_toml(path, "a swing profile", "`golfbench profile list` shows the known ones.")
    loose = {key: raw.pop(key, None) for key in _TABLES_OF_NUMBERS}
    file = _checked_file(path, raw)
    for key, kind in _TABLES_OF_NUMBERS.items():
        require_fit(loose[key], kind, f"{path}: {key}", _ACTION)
    beside, address = file.schema == SCHEMA, cast("_Address | None", file.address)
    tables = _read_table(path, file) if beside else {key: np.array(getattr(file, key)) for key in _TABLES}
    _check_tables(path, file, tables)
    return Profile(
        name=file.name,
        text=file.text,
        golfer=file.golfer,
        club=file.club,
        period=file.period_s,
        begins=file.begins,
        angle=tables["angle_rad"],
        velocity=tables["velocity_rad_per_s"],
        valve=tables["valve"],
        blind_spacing=file.blind_spacing,
        blind_brake=tables["blind_brake"],
        ball=file.ball_m,
        impact_time=file.impact_time_s,
        delivery={k: float(v) for k, v in loose["delivery"].items()},
        limits={k: float(v) for k, v in loose["limits"].items()},
        air=address.chamber_pressures_pa if address else (),
        air_supply=address.supply_pressure_pa if address else 0.0,
        followed=loose["followed"],
    )


def _checked_file(path: Path, raw: dict[str, Any]) -> _ProfileFile:
    """Return the checked keys of the file at `path`; raises BenchError for the first mistake."""
    faults: list[BenchError] = []
    builder = Builder(as_tree(raw, path, faults), path, _ACTION, _ACTION, faults=faults)
    file: _ProfileFile = builder.build(_ProfileFile)
    for fault in faults:
        if fault.location.startswith(f"{path}: address"):
            fault.action = _ACTION_ADDRESS
        raise fault
    keys = _BESIDE if file.schema == SCHEMA else _TABLES
    for key in (*_BESIDE, *_TABLES):
        if (key in raw) != (key in keys):
            found, expected = "a key" if key in raw else "nothing", f"{', '.join(keys)} in {file.schema}"
            raise BenchError(f"{path}: {key}", found, expected, _ACTION)
    return file


def _read_table(path: Path, file: _ProfileFile) -> dict[str, Array]:
    """Return the tables of the Parquet file that the profile at `path` names, by their keys in TOML."""
    table = path.parent / file.table
    try:
        content = table.read_bytes()
    except FileNotFoundError:
        expected = f"the table of {path}"
        raise BenchError(str(table), "no such file", expected, _ACTION_TABLE) from None
    except OSError as error:
        found = error.strerror or str(error)
        raise BenchError(str(table), found, "a file that can be read", _ACTION_TABLE) from None
    digest = sha256(content).hexdigest()
    if digest != file.table_sha256:
        expected = f"{format_value(file.table_sha256)}, as {path} says"
        raise BenchError(str(table), f"SHA-256 {digest}", expected, _ACTION_TABLE)
    try:
        tables = decode_table(content, file.blind_spacing)
    except ValueError as error:
        raise BenchError(str(table), str(error), "the table of a profile", _ACTION_TABLE) from None
    return {key: tables[name] for key, name in _TABLES.items()}


def _check_tables(path: Path, file: _ProfileFile, tables: dict[str, Array]) -> None:
    """Raise BenchError unless the tables fit together and all values lie in their ranges."""
    n, begins = len(tables["angle_rad"]), file.begins
    rows = dict.fromkeys(_TABLES, (n, 3)) | {"blind_brake": (max(n - 1, 0) // file.blind_spacing + 1, 6)}
    for key, shape in rows.items():
        if tables[key].shape != shape:
            raise BenchError(f"{path}: {key}", f"shape {tables[key].shape}", f"shape {shape}", _ACTION)
    ranges: tuple[tuple[str, Any, float, float, str], ...] = (
        ("angle_rad", tables["angle_rad"], -10.0, 10.0, "-10 to 10 rad"),
        ("velocity_rad_per_s", tables["velocity_rad_per_s"], -100.0, 100.0, "-100 to 100 rad/s"),
        ("valve", tables["valve"], -1.0, 1.0, "openings -1 to 1"),
        ("blind_brake", tables["blind_brake"][:, :3], -1.0, 1.0, "openings -1 to 1"),
        ("blind_brake", tables["blind_brake"][:, 3:], 0.0, 2.0, "durations 0 to 2 s"),
        ("impact_time_s", file.impact_time_s, 0.0, n * file.period_s, "a time within the swing"),
    )
    for key, given, low, high, expected in ranges:
        values = np.atleast_1d(given)
        if np.any(values < low) or np.any(values > high):
            worst = values.flat[int(np.argmax(np.maximum(low - values, values - high)))]
            raise BenchError(f"{path}: {key}", f"{worst:g}", expected, _ACTION)
    if n < 2 or begins[0] != 0 or list(begins) != sorted(begins) or begins[-1] >= n:
        raise BenchError(f"{path}: begins", repr(begins), f"rising samples from 0, all below {n}", _ACTION)


def as_written(profile: Profile) -> Profile:
    """Return `profile` with its tables as `save_profile` rounds them."""
    return replace(profile, **{key: np.round(getattr(profile, key), n) for key, n in DIGITS.items()})


def save_profile(path: Path, profile: Profile) -> Path:
    """Write `profile` as TOML to `path` and its table to the same folder; return the table's path.

    Raises:
        NotStored: a file cannot be written.
    """
    table = path.with_suffix(".parquet") if path.suffix == ".toml" else Path(f"{path}.parquet")
    content = encode_table({key: getattr(profile, key) for key in DIGITS}, profile.blind_spacing)
    beside = (
        "# Angles, velocities, valves, blind brakes; `golfbench profile show PROFILE --table` prints them.",
        f"table = {toml_value(table.name)}",
        f'table_sha256 = "{sha256(content).hexdigest()}"',
    )
    text = "\n".join([*_head(profile, SCHEMA), *beside, *_tail(profile)]) + "\n"
    for file, stored in ((table, content), (path, text.encode())):
        write_whole(file, stored)
    return table


def profile_text(profile: Profile) -> str:
    """Return `profile` with its tables as one TOML file, to read or edit; one row of a table a line."""
    blind = "Openings of the three valves, then how long each holds (s); one row every blind_spacing samples."
    above = {"angle_rad": ["# Columns: shoulder, arm, wrist."], "blind_brake": [f"# {blind}"]}
    tables: list[str] = []
    for key, name in _TABLES.items():
        rows, digits = getattr(profile, name), DIGITS[name]
        lines = ("  [" + ", ".join(f"{value:.{digits}f}" for value in row) + "]," for row in rows)
        tables += [*above.get(key, ()), f"{key} = [", *lines, "]"]
    return "\n".join([*_head(profile, SCHEMA_WITH_TABLES), *tables, *_tail(profile)]) + "\n"


def _head(profile: Profile, schema: str) -> list[str]:
    return [
        f'schema = "{schema}"',
        f"name = {toml_value(profile.name)}",
        f"text = {toml_value(profile.text)}",
        f"golfer = {toml_value(profile.golfer)}",
        f"club = {toml_value(profile.club)}",
        f"period_s = {toml_value(profile.period)}",
        "# Sample at which hold, backswing, top, downswing, committed, impact window, follow-through begin.",
        f"begins = {toml_value(profile.begins)}",
        "# Face centre at the ball in the swing plane (x0, y0).",
        f"ball_m = {toml_value(profile.ball)}",
        f"impact_time_s = {toml_value(profile.impact_time)}",
        f"blind_spacing = {profile.blind_spacing}",
    ]


def _tail(profile: Profile) -> Iterator[str]:
    for name, values in (("delivery", profile.delivery), ("limits", profile.limits)):
        yield f"\n[{name}]"
        yield from (f"{key} = {toml_value(value)}" for key, value in values.items())
    if profile.air:
        yield "\n# Pressures to which the chambers are brought before a swing, Pa absolute, with that supply:"
        yield "# shoulder A and B, right arm A and B, wrist A and B."
        yield "[address]"
        yield f"supply_pressure_pa = {toml_value(profile.air_supply)}"
        yield f"chamber_pressures_pa = {toml_value(profile.air)}"
    if profile.followed is not None:
        yield "\n# Measured swing that it follows. Deviations: shoulder, arm, wrist, head."
        yield "[followed]"
        for key, value in profile.followed.items():
            yield f"{key} = {toml_value(value)}"
