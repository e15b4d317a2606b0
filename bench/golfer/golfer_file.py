"""A golfer's swing as measured, and its file `NAME.golfer.toml` with a Parquet table.

Definitions: x level towards the target, y up, both in the swing plane; the origin is the head at the ball,
without a club the lead wrist. theta1 is the direction from trail to lead shoulder, theta1 + theta2 that from
lead shoulder to lead wrist, theta1 + theta2 + theta3 that of the shaft, each projected.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from hashlib import sha256
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bench.base.atomic_file import write_whole
from bench.base.errors import BenchError
from bench.base.from_toml import read_toml
from bench.base.to_toml import toml_value
from bench.golfer.roles import Array, Capture, Orientation, Roles

STEP = 0.001
"""Time between rows (s)."""
HANDS_CUTOFF = 5 / 3
"""Cut-off of the hands over that of the body."""


@dataclass(frozen=True)
class ImportOptions:
    """Values that the user states instead of automatic detection."""

    lead: str = ""
    """Lead side, left or right."""
    up: str = ""
    """Up axis: x, y or z, with a minus for down."""
    top: float | None = None
    """Top (s, time of the file)."""
    impact: float | None = None
    """Impact (s, time of the file)."""
    cutoff: tuple[float, float] = (15.0, 50.0)
    """Low-pass cut-offs for body and club (Hz); that for the hands is 5/3 of the body's."""


@dataclass(frozen=True)
class MeasuredSwing:
    """A golfer's swing on a grid of 1 ms that ends at the ball."""

    time: Array
    """Time (n,), 0 at the ball (s)."""
    angle: Array
    """theta1, theta2, theta3 (n, 3), NaN without a club in the last (rad)."""
    position: dict[str, Array]
    """Paths (n, 3) by role in the plane: x to the target, y up, z off the plane (m)."""
    speed: dict[str, Array]
    """Speeds (n,) of hands and head (m/s)."""
    separation: Array | None
    """X-factor (n,): turn of the shoulders less that of the pelvis, None without a pelvis (rad)."""
    top_row: int
    """Row of the top, by the hands."""
    club_top_row: int | None
    """Row in which the shaft reverses."""
    top_clue: str
    impact_time: float
    """Impact in the time of the file (s)."""
    impact_clue: str
    plane: float
    """Inclination of the swing plane (rad)."""
    orientation: Orientation
    """Unit, up axis and sides, and how each was found."""
    gaps: dict[str, int]
    """Filled frames by role."""
    not_measured: tuple[str, ...]
    """Quantities for which the file has no marker."""
    rate: float = 0.0
    """Frame rate of the file (Hz)."""
    frames: int = 0
    options: ImportOptions = field(default_factory=ImportOptions)

    @property
    def has_club(self) -> bool:
        """Whether shaft and head were measured."""
        return "head" in self.position

    @property
    def downswing(self) -> slice:
        """Rows from the top to the ball."""
        return slice(self.top_row, len(self.time))


SCHEMA = "golfbench.golfer/1"
SUFFIX = ".golfer.toml"
_AXES = ("x", "y", "off")
ANGLES = ("theta1_rad", "theta2_rad", "theta3_rad")
_KEYS = {
    "schema": str,
    "name": str,
    "table": str,
    "table_sha256": str,
    "downswing_s": float,
    "plane_deg": float,
}
_ACTION = "Import the recording again with `golfbench golfer import FILE`."
DEFINITIONS = {
    "plane": "least squares through the head's path from where the shaft is level to the ball, or without a "
    "club through the lead wrist's; x level towards the target, y up, origin at the ball",
    "angles": "theta1 trail to lead shoulder, theta1 + theta2 lead arm (shoulder to wrist), "
    "theta1 + theta2 + theta3 shaft, each projected onto the plane, from x, counterclockwise",
    "impact": "loss of head speed between two frames, else the pass of the position at address",
    "top": "slowest lead wrist before the ball",
    "filter": "Butterworth, second order, forth and back, frames before the ball only",
}


@dataclass(frozen=True)
class GolferSwing:
    """A golfer's swing as read from a file; the last row is impact."""

    name: str
    time: Array
    """Time (n,), 0 at the ball (s)."""
    angle: Array
    """theta1, theta2, theta3 (n, 3), NaN where not measured (rad)."""
    position: dict[str, Array]
    """Paths (n, 3) by role from the ball: x to the target, y up in the plane, z off the plane (m)."""
    head_speed: float
    """Head speed at the ball, NaN without a club (m/s)."""
    top_row: int
    """Row of the top."""
    plane: float
    """Inclination of the swing plane (rad)."""
    path: Path
    """File that it was read from."""
    digest: str
    """SHA-256 of that file."""
    follow: Literal["body", "club"] = "body"
    """Origin of the angles: the golfer's body, or the robot that holds the club alike."""

    @property
    def head(self) -> Array:
        """Head path (n, 2) from the ball, NaN without a club (m)."""
        return self.position.get("head", np.full((len(self.time), 3), np.nan))[:, :2]

    @property
    def text(self) -> str:
        """Source of the swing."""
        return f"measured, {self.path.name}"

    @property
    def downswing_time(self) -> float:
        """Duration of the downswing (s)."""
        return float(self.time[-1] - self.time[self.top_row])

    @property
    def attack(self) -> float:
        """Attack angle of the head at the ball, positive upwards (rad)."""
        x, y = self.head[-1] - self.head[-3]
        return float(np.arctan2(y * np.sin(self.plane), x))

    @property
    def backswing(self) -> float | None:
        """Duration of the backswing (s), None where the recording starts within it."""
        way = np.linalg.norm(np.diff(self.head[: self.top_row], axis=0), axis=1) / STEP
        moving = np.flatnonzero(way > 0.1 * way.max(initial=0.0))
        return float((self.top_row - moving[0]) * STEP) if len(moving) and moving[0] > 20 else None


def _degrees(angle: Array) -> list[float | None]:
    """Return three angles (rad) in degrees, None where not measured; arm and wrist from 0 to 360."""
    found = np.degrees(angle)
    found[1:] %= 360.0
    return _known(found)


def _known(values: Array) -> list[float | None]:
    return [None if np.isnan(value) else round(float(value), 2) for value in values]


def summary(swing: MeasuredSwing) -> dict[str, Any]:
    """Return the key figures of `swing` for file and JSON; None where not measured.

    Distances from the plane are root mean squares over the downswing, the hub is the mean of both shoulders.
    """
    down, position, club_top = swing.downswing, swing.position, swing.club_top_row
    head, factor = swing.speed.get("head"), swing.separation
    cock = None if not swing.has_club else round(360.0 - float(np.degrees(swing.angle[down, 2].min())), 2)
    off_plane = {
        role: round(1e3 * float(np.sqrt(np.mean(position[role][down, 2] ** 2))), 1)
        for role in position
        if role in ("lead_shoulder", "lead_wrist", "head")
    }
    hub = (position["lead_shoulder"] + position["trail_shoulder"])[down] / 2
    peaks = np.abs(np.gradient(swing.angle, STEP, axis=0)[down]).max(axis=0)
    return {
        "rate_hz": swing.rate,
        "frames": swing.frames,
        "impact_s": round(swing.impact_time, 5),
        "impact_clue": swing.impact_clue,
        "top_s": round(swing.impact_time + float(swing.time[swing.top_row]), 4),
        "top_clue": swing.top_clue,
        "club_top_s": None if club_top is None else round(swing.impact_time + float(swing.time[club_top]), 4),
        "downswing_s": round(-float(swing.time[swing.top_row]), 4),
        "lead": swing.orientation.lead,
        "lead_clue": swing.orientation.lead_clue,
        "unit": swing.orientation.unit,
        "up": swing.orientation.up,
        "plane_deg": round(float(np.degrees(swing.plane)), 2),
        "theta_top_deg": _degrees(swing.angle[swing.top_row]),
        "theta_ball_deg": _degrees(swing.angle[-1]),
        "max_cock_deg": cock,
        "head_speed_mps": None if head is None else round(float(head[-1]), 3),
        "hand_speed_mps": round(float(swing.speed["lead_wrist"][-1]), 3),
        "peak_hand_speed_mps": round(float(swing.speed["lead_wrist"][down].max()), 3),
        "peak_joint_speed_rad_per_s": _known(peaks),
        "x_factor_top_deg": None if factor is None else round(float(np.degrees(factor[swing.top_row])), 2),
        "x_factor_max_deg": None if factor is None else round(float(np.degrees(factor[down].max())), 2),
        "off_plane_rms_mm": off_plane,
        "hub_travel_mm": [round(1e3 * float(way), 1) for way in np.ptp(hub, axis=0)[:2]],
        "gaps_filled": swing.gaps,
        "not_measured": list(swing.not_measured),
    }


def save_golfer(folder: Path, name: str, swing: MeasuredSwing, capture: Capture, roles: Roles) -> Path:
    """Write `NAME.golfer.toml` and `NAME.golfer.parquet` into `folder`, and return the path of the first.

    Raises:
        NotStored: a file cannot be written.
    """
    path, table = folder / f"{name}{SUFFIX}", folder / f"{name}.golfer.parquet"
    content = _table(swing)
    body, head = swing.options.cutoff
    about: dict[str, Any] = {
        "schema": SCHEMA,
        "name": name,
        "table": table.name,
        "table_sha256": sha256(content).hexdigest(),
        "source": capture.path.name,
        "source_sha256": capture.digest,
        "golfbench": version("golfbench"),
        "cutoff_hz": {"body": body, "hands": round(body * HANDS_CUTOFF, 3), "club": head},
        **summary(swing),
    }
    about = {key: value for key, value in about.items() if value is not None}
    lines = list[str]()
    for heading, table_of in (("", about), ("markers", roles.markers), ("definitions", DEFINITIONS)):
        lines += ["", f"[{heading}]"] if heading else []
        lines += [f"{key} = {toml_value(value)}" for key, value in table_of.items()]
    write_whole(table, content)
    write_whole(path, "\n".join(lines) + "\n")
    return path


def _table(swing: MeasuredSwing) -> bytes:
    """Return the Parquet file: time, angles, speeds, and each role's path in the plane."""
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Array] = {"time_s": np.round(swing.time, 6)}
    columns |= dict(zip(ANGLES, swing.angle.T, strict=True))
    columns |= {f"{role}_speed_mps": speed for role, speed in swing.speed.items()}
    if swing.separation is not None:
        columns["x_factor_rad"] = swing.separation
    for role, path in swing.position.items():
        columns |= {f"{role}_{axis}_m": path[:, k] for k, axis in enumerate(_AXES)}
    file = BytesIO()
    narrow = pa.table({name: values.astype(np.float32) for name, values in columns.items()})
    parquet.write_table(narrow, file, compression="zstd", use_dictionary=False, use_byte_stream_split=True)
    return file.getvalue()


def load_golfer(path: Path) -> GolferSwing:
    """Return the golfer's swing in `path`, a `NAME.golfer.toml`.

    Raises:
        BenchError: a file is missing, damaged, or its table is not the one it was written with.
    """
    import pyarrow as pa
    from pyarrow import parquet

    raw = read_toml(path, "a golfer's swing", _ACTION)
    for key, kind in _KEYS.items():
        if not isinstance(raw.get(key), kind):
            found = str(raw.get(key, "nothing"))[:60]
            raise BenchError(f"{path}: {key}", found, f"a {kind.__name__}", _ACTION)
    if raw["schema"] != SCHEMA:
        raise BenchError(f"{path}: schema", raw["schema"][:60], SCHEMA, _ACTION)
    table_path = path.with_name(Path(raw["table"]).name)
    try:
        content = table_path.read_bytes()
    except OSError as error:
        found = error.strerror or str(error)
        raise BenchError(str(table_path), found, f"the table of {path}", _ACTION) from None
    if sha256(content).hexdigest() != raw["table_sha256"]:
        raise BenchError(str(table_path), "another digest", f"the table of {path}", _ACTION)
    try:
        table = parquet.ParquetFile(BytesIO(content)).read(use_threads=False)
        columns = {name: np.array(table.column(name).to_pylist(), dtype=float) for name in table.column_names}
        time = columns["time_s"]
        angle = np.column_stack([columns[name] for name in ANGLES])
        roles = [name.removesuffix("_x_m") for name in columns if name.endswith("_x_m")]
        position = {role: np.column_stack([columns[f"{role}_{axis}_m"] for axis in _AXES]) for role in roles}
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError) as error:
        found = f"no table of a golfer: {error}"
        raise BenchError(str(table_path), found, "the columns of an import", _ACTION) from None
    speed = float(columns["head_speed_mps"][-1]) if "head_speed_mps" in columns else np.nan
    row = len(time) - 1 - round(raw["downswing_s"] / STEP)
    if not 0 <= row < len(time) - 2:
        found = f"{raw['downswing_s']:g} s"
        raise BenchError(f"{path}: downswing_s", found, "a time within the table", _ACTION)
    plane, digest = float(np.radians(raw["plane_deg"])), sha256(path.read_bytes()).hexdigest()
    return GolferSwing(raw["name"], time, angle, position, speed, row, plane, path, digest)
