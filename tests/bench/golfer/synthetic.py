"""Synthetic golfers: known joint angles, a hub that moves, markers next to the joints, written as files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bench.golfer.golfer_file import GolferSwing

Array = NDArray[np.float64]

TOP, BALL, END = 1.05, 1.31, 1.60
"""Instants (s)."""
_KNOTS = (0.0, 0.2, 0.35, 0.7, 0.95, TOP, 1.13, 1.21, 1.26, BALL, 1.36, 1.45, END)
_THETA1 = (18, 18, 14, -50, -88, -92, -76, -38, -9, 20, 44, 75, 100)
_THETA12 = (283.7, 283.7, 268, 180, 124, 118, 142, 205, 242, 274, 303, 345, 370)
_THETA123 = (269, 269, 250, 90, -2, -4, 21, 100, 172, 268, 368, 480, 520)
"""Degrees at the knots: shoulders, lead arm, shaft."""
_LOSS = 0.25
"""Fraction of the shaft's speed that the ball takes."""


def angles(time: Array) -> Array:
    """Return theta1, theta2, theta3 (n, 3) before the ball at `time` (s), in rad."""
    still = np.clip(time, 0.2, END)  # a golfer stands at address
    directions = [
        CubicSpline(_KNOTS[1:], values[1:], bc_type=("clamped", "not-a-knot"))(still)
        for values in (_THETA1, _THETA12, _THETA123)
    ]
    return np.radians(np.diff([np.zeros(len(time)), *directions], axis=0).T)


@dataclass(frozen=True)
class Synthetic:
    """A golfer and how he or she is recorded."""

    rate: float = 240.0
    noise: float = 0.0
    """Standard deviation of each coordinate (m)."""
    unit: str = "m"
    up: str = "z"
    left_handed: bool = False
    plane: float = np.radians(52.0)
    turned: float = 0.3
    """Turn about the vertical (rad)."""
    loss: float = _LOSS
    offset: float = 0.03
    """Distance of the markers from their joint (m)."""
    start: float = 0.0
    end: float = END
    seed: int = 1

    def time(self) -> Array:
        return np.arange(round((self.end - self.start) * self.rate) + 1) / self.rate + self.start

    def joints(self, time: Array) -> dict[str, Array]:
        """Return positions (n, 3) in the plane's axes: to the target, up the plane, off it; ball at 0."""
        after = np.maximum(time - BALL, 0.0)
        angle = angles(time)
        direction = np.cumsum(angle, axis=1)
        direction[:, 2] = np.where(
            after > 0, np.cumsum(angles(time - self.loss * after), axis=1)[:, 2], direction[:, 2]
        )
        unit = [np.column_stack([np.cos(d), np.sin(d), np.zeros(len(d))]) for d in direction.T]
        phase = (time - 0.2) / (BALL - 0.2)
        hub = np.column_stack([0.12 * phase**5, 0.03 * np.sin(4 * phase), 0.28 - 0.03 * phase])
        lead, trail = hub + 0.16 * unit[0], hub - 0.16 * unit[0]
        wrist = lead + 0.60 * unit[1]
        found = {
            "LSHO": lead,
            "RSHO": trail,
            "LWRI": wrist,
            "GRIP": wrist + 0.2 * unit[2],
            "HEAD": wrist + 1.05 * unit[2],
        }
        found["RWRI"] = wrist + 0.09 * unit[2]
        found["LHIP"], found["RHIP"] = hub + [0.13, -0.5, 0.3], hub + [-0.13, -0.5, 0.3]
        for name in ("GRIP", "HEAD", "LWRI", "RWRI"):  # the arms reach into the plane
            found[name] = found[name] - [0.0, 0.0, 1.0] * hub[:, 2:]
        return found

    def recording(self) -> tuple[list[str], Array]:
        """Return names and positions (frames, markers, 3) as the cameras see them, two markers a joint."""
        random, joints = np.random.default_rng(self.seed), self.joints(self.time())
        origin = self.joints(np.array([BALL]))["HEAD"][0]
        names, paths = list[str](), list[Array]()
        sine, cosine = np.sin(self.plane), np.cos(self.plane)
        for name, path in joints.items():
            x, up, off = (path - origin).T
            # Level to the target, level from the ball to the golfer, vertical: right-handed axes.
            world = np.column_stack([x, up * cosine - off * sine, up * sine + off * cosine])
            marker = name
            if self.left_handed:
                world[:, 0] *= -1.0
                marker = {"L": "R", "R": "L"}.get(name[0], name[0]) + name[1:]
            world = world @ _about_z(self.turned).T
            for k, sign in enumerate((-1.0, 1.0)):
                beside = world + sign * self.offset * np.array([0.6, 0.0, 0.8])
                names.append(f"{marker}{k + 1}")
                paths.append(beside + random.normal(0.0, self.noise, beside.shape) if self.noise else beside)
        points = np.stack(paths, axis=1)
        if self.up == "y":
            points = points[..., [1, 2, 0]]
        return names, points * {"m": 1.0, "cm": 100.0, "mm": 1000.0}[self.unit]


ROLES = {
    "trail_shoulder": "RSHO",
    "lead_shoulder": "LSHO",
    "lead_wrist": "LWRI",
    "grip": "GRIP",
    "head": "HEAD",
}
"""Markers of a right-hander's figure by role."""


def golfer_swing() -> GolferSwing:
    """Return a synthetic golfer as its import would, without an error of measurement."""
    time = np.arange(-BALL, 1e-9, 1e-3)
    angle = angles(BALL + time)
    angle[:, 2] += 2 * np.pi
    paths = Synthetic().joints(BALL + time)
    position = {role: paths[name] - paths["HEAD"][-1] for role, name in ROLES.items()}
    row, path = round(TOP * 1e3), Path("anna.golfer.toml")
    return GolferSwing("Anna", time, angle, position, 43.8, row, np.radians(50.0), path, "5e1f")


MAP = "\n".join(
    f'{role} = ["{name}1", "{name}2"]'
    for role, name in {
        "left_shoulder": "LSHO",
        "right_shoulder": "RSHO",
        "left_wrist": "LWRI",
        "right_wrist": "RWRI",
        "left_hip": "LHIP",
        "right_hip": "RHIP",
        "grip": "GRIP",
        "head": "HEAD",
    }.items()
)


def _about_z(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def write(
    path: Path, names: list[str], points: Array, rate: float, unit: str = "m", start: float = 0.0
) -> Path:
    """Write the recording as the suffix of `path` states."""
    {".csv": write_csv, ".trc": write_trc, ".c3d": write_c3d}[path.suffix](
        path, names, points, rate, unit, start
    )
    return path


def _cell(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.6f}"


def write_csv(path: Path, names: list[str], points: Array, rate: float, unit: str, start: float) -> None:
    lines = ["time_s," + ",".join(f"{name}_{axis}" for name in names for axis in "xyz")]
    for k, frame in enumerate(points.reshape(len(points), -1)):
        lines.append(f"{start + k / rate:.6f}," + ",".join(map(_cell, frame)))
    path.write_text("\n".join(lines) + "\n")


def write_trc(path: Path, names: list[str], points: Array, rate: float, unit: str, start: float) -> None:
    count = len(points)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate:g}\t{rate:g}\t{count}\t{len(names)}\t{unit}\t{rate:g}\t1\t{count}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"),
        "",
    ]
    for k, frame in enumerate(points.reshape(count, -1)):
        lines.append(f"{k + 1}\t{start + k / rate:.6f}\t" + "\t".join(map(_cell, frame)))
    path.write_text("\n".join(lines) + "\n")


def write_c3d(path: Path, names: list[str], points: Array, rate: float, unit: str, start: float) -> None:
    from ezc3d import c3d

    file = c3d()
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file["parameters"]["POINT"]["LABELS"]["value"] = names
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["header"]["points"]["frame_rate"] = rate
    positions = np.ones((4, len(names), len(points)))
    positions[:3] = points.transpose(2, 1, 0)
    file["data"]["points"] = positions
    file.write(str(path))
