"""Stored record of one control cycle, defined once.

`FIELDS` is the schema: the numpy record `CYCLE`, the Arrow schema (Parquet, telemetry) and every export
derive from it. A change of FIELDS requires a new SCHEMA_VERSION.

Vectors become one Arrow column per component, named by joint, chamber or axis (`angle_wrist`,
`chamber_pressure_right_arm_b`): pandas and polars users select, plot and filter plain columns without
unpacking lists, Parquet compresses each channel separately, and a reader may load only some columns.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from bench.base.lifecycle import Cause, Phase, Reaction, Refusal, Request, State
from drivers.base import CHAMBERS, JOINTS

if TYPE_CHECKING:
    import pyarrow as pa

SCHEMA_VERSION = 6
"""Version of FIELDS; stored in every file and message."""

MAX_BATCH_CYCLES = 64
"""Max cycles in a telemetry message: with the schema it stays below 64 kB, which zenoh sends in one piece."""

_CHAMBERS = tuple(chamber.replace(" ", "_").lower() for chamber in CHAMBERS)
_PLANE = ("x", "y")


class Field(NamedTuple):
    """One field of the cycle record."""

    name: str
    dtype: str
    """numpy type of one component. Vectors of Booleans are "u1": compiled code has no nested bool."""
    unit: str
    """SI unit; "1" for pure numbers, codes and Booleans."""
    text: str
    components: tuple[str, ...] = ()
    """Names of the components of a vector; empty for a scalar."""
    names: str = ""
    """Enumeration of its codes, see `bench.records.telemetry.cycle_record`; empty for a field without
    names."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the field in one record: () for a scalar, (n,) for a vector."""
        return (len(self.components),) if self.components else ()

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the field's columns in Arrow, Parquet and exports."""
        return tuple(f"{self.name}_{component}" for component in self.components) or (self.name,)


FIELDS = (
    Field("tick", "i8", "1", "number of the loop's tick since its start; a gap is a missed tick"),
    Field("time", "f8", "s", "time since the start of this swing's record"),
    Field("measured_step", "f8", "s", "measured time since the tick before"),
    Field("wake_latency", "f8", "s", "how late the tick began on its grid; 0 on a virtual clock"),
    Field("work_time", "f8", "s", "time the tick before took; 0 on a virtual clock"),
    Field("state", "u1", "1", "state of the bench, see enumeration 'state'", names="state"),
    Field("request", "u1", "1", "request put to this tick, see enumeration 'request'", names="request"),
    Field("request_number", "i8", "1", "number of the request answered last"),
    Field("answer", "u1", "1", "answer to it: 1 accepted, 2 refused"),
    Field("refusal", "u1", "1", "why it was refused, see enumeration 'refusal'", names="refusal"),
    Field("lease_held", "?", "1", "a client holds the lease"),
    Field("support_ready", "?", "1", "recorder and publisher are running"),
    Field("supervisor_alive", "?", "1", "the supervisor's heart beats"),
    Field("device_operational", "?", "1", "false once the device has gone passive without a command"),
    Field("homed", "?", "1", "encoders' zeros are proven"),
    Field("vented", "?", "1", "chambers are proven empty"),
    Field("phase", "u1", "1", "phase of the swing, see enumeration 'phase'", names="phase"),
    Field("reaction", "u1", "1", "reaction under way, see enumeration 'reaction'", names="reaction"),
    Field("cause", "i4", "1", "cause of the stop, see enumeration 'cause'; 0 when none", names="cause"),
    Field(
        "latest_cause",
        "i4",
        "1",
        "newest cause, also after `cause`, see enumeration 'cause'; 0 when none",
        names="cause",
    ),
    Field("encoder_count", "i8", "1", "encoder reading in counts", JOINTS),
    Field("encoder_valid", "u1", "1", "1 when the encoder reading is valid", JOINTS),
    Field("encoder_age", "f8", "s", "age of the encoder reading at this tick", JOINTS),
    Field("encoder_time", "f8", "s", "instant of the encoder reading on the clock of `time`", JOINTS),
    Field("encoder_indexed", "u1", "1", "1 when the count is absolute or its index was passed", JOINTS),
    Field("angle", "f8", "rad", "estimated joint angle", JOINTS),
    Field("velocity", "f8", "rad/s", "estimated joint velocity", JOINTS),
    Field("angle_variance", "f8", "rad^2", "estimator's variance of the joint angle", JOINTS),
    Field("reference_angle", "f8", "rad", "joint angle that the controller follows", JOINTS),
    Field("reference_velocity", "f8", "rad/s", "joint velocity that the controller follows", JOINTS),
    Field("proportional", "f8", "1", "proportional part of the controller's output", JOINTS),
    Field("integral", "f8", "1", "integral part of the controller's output", JOINTS),
    Field("derivative", "f8", "1", "derivative part of the controller's output", JOINTS),
    Field("feedforward", "f8", "1", "feed-forward and learned part of the controller's output", JOINTS),
    Field("desired_valve", "f8", "1", "valve opening the controller wants, -1 to 1", JOINTS),
    Field(
        "applied_valve", "f8", "1", "valve opening truly applied after envelope and device, -1 to 1", JOINTS
    ),
    Field("supply_enable", "?", "1", "supply valve commanded open"),
    Field("exhaust_closed", "?", "1", "chamber vents commanded closed"),
    Field("guard_lock", "?", "1", "guard left to its locking spring"),
    Field("beacon", "?", "1", "warning beacon commanded on"),
    Field("tee", "?", "1", "tee commanded to raise a ball"),
    Field("emergency_stop_clear", "?", "1", "emergency stop circuit closed"),
    Field("guard_closed", "?", "1", "guard seen closed"),
    Field("guard_locked", "?", "1", "guard seen locked"),
    Field("ball_present", "?", "1", "ball seen on the tee"),
    Field("local_reset", "?", "1", "local reset input"),
    Field("supply_pressure", "f8", "Pa", "supply pressure, absolute; NaN: not fitted, infinite: no value"),
    Field("chamber_pressure", "f8", "Pa", "chamber pressure, absolute, as above", _CHAMBERS),
    Field(
        "spool_position",
        "f8",
        "1",
        "measured spool position, -1 to 1; NaN: not fitted, infinite: no value",
        JOINTS,
    ),
    Field("vent_open", "f8", "1", "vent seen open (1) or shut (0); NaN when not fitted", ("1", "2")),
    Field("shut_off_open", "f8", "1", "shut-off valve seen open (1) or shut (0); NaN when not fitted"),
    Field(
        "air_fault",
        "i4",
        "1",
        "sensors, vents, manifold and lock that fail, see `bench.control.monitor.pressure_monitor`",
    ),
    Field("head_position", "f8", "m", "club head in the swing plane, from the estimated angles", _PLANE),
    Field("head_orientation", "f8", "rad", "club's angle in the swing plane, from the estimated angles"),
    Field("head_speed", "f8", "m/s", "speed of the club head, from the estimated angles and velocities"),
    Field("plant_angle", "f8", "rad", "true joint angle; simulation only, else NaN", JOINTS),
    Field("plant_velocity", "f8", "rad/s", "true joint velocity; simulation only, else NaN", JOINTS),
    Field("plant_pressure", "f8", "Pa", "true chamber pressure; simulation only, else NaN", _CHAMBERS),
    Field("plant_effort", "f8", "N m, N, N m", "true actuator effort; simulation only, else NaN", JOINTS),
    Field(
        "plant_head_position",
        "f8",
        "m",
        "true club head in the swing plane; simulation only, else NaN",
        _PLANE,
    ),
    Field("plant_head_speed", "f8", "m/s", "true speed of the club head; simulation only, else NaN"),
)
"""The schema of one cycle, in storage order. Vectors over joints follow `drivers.base.JOINTS`; those over
actuators carry the name of the joint that the actuator moves."""

CYCLE = np.dtype([(f.name, f.dtype, f.shape) for f in FIELDS], align=True)
"""One cycle as a numpy record: the form of the loop, the ring and compiled code."""


@cache
def arrow_schema() -> pa.Schema:
    """Return the Arrow schema of cycles; each column carries `unit` and `description` as metadata."""
    import pyarrow as pa  # 29 MB, and needed for files and telemetry only

    return pa.schema(
        [
            pa.field(
                column,
                pa.from_numpy_dtype(np.dtype(field.dtype)),
                nullable=False,
                metadata={"unit": unit_of(field, index), "description": field.text},
            )
            for field in FIELDS
            for index, column in enumerate(field.columns)
        ],
        metadata={"golfbench_schema": f"cycle/{SCHEMA_VERSION}"},
    )


def to_arrow(cycles: np.ndarray[Any, Any], schema: pa.Schema | None = None) -> pa.RecordBatch:
    """Return `cycles` (n records of CYCLE) as Arrow columns, by default of `arrow_schema()`; NaN stays NaN.

    From buffers: `pa.array` imports pandas where it is installed, 40 MB and 2 s.
    """
    import pyarrow as pa

    schema = schema or arrow_schema()
    values = [column for field in FIELDS for column in np.atleast_2d(cycles[field.name].T)]
    columns = [
        pa.Array.from_buffers(kind, len(cycles), [None, pa.py_buffer(_packed(column))])
        for kind, column in zip(schema.types, values, strict=True)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _packed(column: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return `column` (n,) as Arrow stores it: contiguous, Booleans as bits."""
    is_boolean = column.dtype == bool
    return np.packbits(column, bitorder="little") if is_boolean else np.ascontiguousarray(column)


def name_columns(cycles: np.ndarray[Any, Any]) -> dict[str, pa.DictionaryArray]:
    """Return the names of the codes in `cycles` by column ("phase_name" …); null for an unknown code."""
    import pyarrow as pa

    columns = {}
    for field in FIELDS:
        if field.names:
            place, names = _dictionary(field.names)
            index = place[np.clip(cycles[field.name].astype(int), -1, len(place) - 1)]
            buffers = [pa.py_buffer(_packed(index >= 0)), pa.py_buffer(index)]
            indices = pa.Array.from_buffers(pa.int8(), len(cycles), buffers)
            columns[f"{field.name}_name"] = pa.DictionaryArray.from_arrays(indices, names)
    return columns


@cache
def _dictionary(enumeration: str) -> tuple[np.ndarray[Any, Any], pa.StringArray]:
    """Return the position of each code in the names of an enumeration, -1 for an unknown one; the names."""
    import pyarrow as pa

    codes, names = [int(code) for code in ENUMERATIONS[enumeration]], list(ENUMERATIONS[enumeration].values())
    place = np.full(max(codes) + 2, -1, np.int8)  # also the last one: it stands for all larger codes and -1
    place[codes] = np.arange(len(codes))
    ends = np.cumsum([0, *map(len, names)], dtype=np.int32)
    text = pa.py_buffer("".join(names).encode())
    return place, pa.StringArray.from_buffers(len(names), pa.py_buffer(ends), text)


def from_arrow(table: pa.Table | pa.RecordBatch) -> np.ndarray[Any, Any]:
    """Return the records of CYCLE in `table`, bit for bit those given to `to_arrow`.

    Raises KeyError naming the first column that is missing.
    """
    cycles = np.zeros(table.num_rows, CYCLE)
    for field in FIELDS:
        target = cycles[field.name].reshape(table.num_rows, len(field.columns))
        for index, column in enumerate(field.columns):
            target[:, index] = table.column(column).to_numpy(zero_copy_only=False)
    return cycles


def unit_of(field: Field, index: int) -> str:
    """Return the unit of one component: efforts differ by actuator and list theirs."""
    units = field.unit.split(", ")
    return units[index] if len(units) > 1 else units[0]


ENUMERATIONS: dict[str, dict[str, str]] = {
    kind.__name__.lower(): {str(one.value): one.name for one in kind}
    for kind in (State, Request, Refusal, Phase, Reaction, Cause)
}
"""Names by code, as stored in the metadata of records; JSON keys are text."""
