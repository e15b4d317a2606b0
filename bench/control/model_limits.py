"""Limits of the model-based check that were made for one profile, plant and controller: their file and use.

A file PROFILE.limits.toml holds the limits by comparison, row and joint, and digests of what they were made
for. `golfbench swing limits` makes it. Limits whose digests do not match are stale: they are named and not
used. Used are, in this order: tables that the configuration gives by hand; the profile's, if they are not
stale; else the default tables of [envelope.model], wide enough for every shipped profile.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from hashlib import sha256
from math import dist, isfinite
from pathlib import Path
from typing import Any, NamedTuple

from bench.control.model import KINDS
from bench.control.settings import (
    MODEL_PHASES,
    MODEL_ROWS,
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    ModelSettings,
    Triple,
)
from bench.errors import BenchError, did_you_mean
from bench.from_toml import format_value, read_toml
from bench.swing.correction import digest_of
from bench.swing.profile import BALL_TOLERANCE, Profile
from sim.plant import Encoders, PlantParameters
from sim.robot import ADDED_TO_CLUBS

SCHEMA = "golfbench-limits/1"
ENDING = ".limits.toml"
"""End of the name of a file of limits."""
FROM_SETTINGS = frozenset({"homing", "standing"})
"""Rows that no swing shows: their limits are those of the settings."""
_KEPT = FROM_SETTINGS | {"arming"}
"""Rows of the settings that hold unless a file has them."""
REQUIRED = frozenset(MODEL_PHASES["air"]) - FROM_SETTINGS
"""Rows that each table of a file has."""

NOT_FELT = frozenset({"ball", "seed", "vent_feedback", "shut_off_feedback"})
"""Fields of the plant that do not make limits stale: they differ from swing to swing, or act only at rest."""

LEAST_FELT_TEE_SHIFT = 0.013
"""Shift of the tee (m) towards heel or toe from which on it makes limits stale: nearer, the joints' speeds
after the blow differ by less than a third of what their comparison allows for."""
ADDED_TO_SITES = {"surface": "none", "divot": 0.0}
"""Fields of sites that are younger than limits in use, with the values at which they change nothing."""

LimitTables = Mapping[str, Mapping[str, Triple]]
"""Limits by comparison and row, joints in order: Pa, Pa, rad/s, rad, N m."""

_CURE = "Make it again with `golfbench swing limits`."


class MadeFor(NamedTuple):
    """Digests of what limits hold for."""

    profile: str
    plant: str
    controller: str

    @classmethod
    def of(
        cls,
        profile: Profile,
        plant: PlantParameters,
        control: ControlSettings,
        envelope: EnvelopeSettings,
        estimator: EstimatorSettings,
    ) -> MadeFor:
        """Return the digests of a bench.

        The plant counts without NOT_FELT and encoder zeros, of the envelope only what changes a command. A
        ball within BALL_TOLERANCE of the profile's counts as there. A club counts as the profile's, whatever
        its name, if its body is the same and the tee is moved less than LEAST_FELT_TEE_SHIFT.
        """
        machine = {k: v for k, v in asdict(plant).items() if k not in NOT_FELT}
        club = machine["robot"]["club"]
        if abs(club["tee_shift"]) < LEAST_FELT_TEE_SHIFT:
            del club["tee_shift"]
        club["name"] = profile.club or club["name"]
        machine["robot"]["club"] = {k: v for k, v in club.items() if ADDED_TO_CLUBS.get(k) != v}
        del machine["supply"]["shut_off_delay"]  # it acts at rest
        for name in ("manifold_relief_ratio", "manifold_relief_conductance"):
            del machine["supply"][name]  # no healthy swing reaches it
        for name in ("shoulder", "right_arm", "wrist"):
            del machine[name]["stop"]["rated"]  # no force depends on it
        if plant.wrist_lever_angle == 0.0:
            del machine["wrist_lever_angle"]  # younger than limits in use
        machine["encoders"] |= {name: getattr(Encoders(), name) for name in ("zero_count", "sign")}
        if dist(profile.ball, (plant.site.ball_x, plant.site.ball_y)) <= BALL_TOLERANCE:
            machine["site"]["ball_x"], machine["site"]["ball_y"] = profile.ball
        machine["site"] = {k: v for k, v in machine["site"].items() if ADDED_TO_SITES.get(k) != v}
        bounds = (envelope.max_opening, envelope.max_slew)
        return cls(
            digest_of(profile),
            _digest(machine),
            _digest([_as_acting(control, plant), asdict(estimator), bounds]),
        )


@dataclass(frozen=True)
class ModelLimits:
    """Content of a file of limits."""

    profile: str
    """Name of the profile."""
    draws: int
    """Number of robots drawn to make them."""
    made_for: MadeFor
    tables: LimitTables

    def differences(self, bench: MadeFor) -> list[str]:
        """Return which of profile, plant and controller differ from those that the limits were made for."""
        return [name for name in MadeFor._fields if getattr(self.made_for, name) != getattr(bench, name)]


class LimitsInUse(NamedTuple):
    """Limits that a bench uses."""

    settings: ModelSettings
    source: str
    """Text for people: the file, or why no file is used."""
    stale: bool
    """Whether there is a file that could not be used."""


def _as_acting(control: ControlSettings, plant: PlantParameters) -> dict[str, Any]:
    """Return `control` without what does not act on `plant`.

    Gains by hand beside those from the machine, a factor 1, a lift where there is no turf.
    """
    values = asdict(control)
    if plant.site.surface == "none":
        del values["follow_through_lift"]
    if values["downswing_stiffness"] == 1.0:
        del values["downswing_stiffness"]
    if values.pop("gains") == "machine":
        values |= dict.fromkeys(("pid", "damping", "move_gain"), "machine")
    return values


def _digest(values: Any) -> str:
    return sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]


def limits_path(profile: Path) -> Path:
    """Return where the limits of the profile in file `profile` are: beside it."""
    return profile.with_name(profile.name.removesuffix(".toml") + ENDING)


def limits_in_use(settings: ModelSettings, bench: MadeFor, candidates: Iterable[Path]) -> LimitsInUse:
    """Return the limits for `bench`: those of the first file of `candidates` that was made for it.

    Raises:
        BenchError: a file is not one of limits.
    """
    default = replace(ModelSettings(), check=settings.check)
    if settings != default:
        return LimitsInUse(settings, "tables of the configuration", stale=False)
    stale = []
    for path in candidates:
        if path.is_file():
            limits = load_limits(path)
            if not (found := limits.differences(bench)):
                return LimitsInUse(_merged(default, limits.tables), str(path), stale=False)
            stale.append(f"{path}: made for another {' and '.join(found)}")
    text = "; ".join(stale) or "none were made for this profile"
    return LimitsInUse(default, f"default tables ({text}; `golfbench swing limits` makes them)", bool(stale))


def _merged(settings: ModelSettings, tables: LimitTables) -> ModelSettings:
    """Return `settings` with `tables`; the rows that these do not have stay."""
    kept: dict[str, dict[str, Triple]] = {
        kind: {row: limits for row, limits in getattr(settings, kind).items() if row in _KEPT}
        for kind in KINDS
    }
    merged: dict[str, Any] = {kind: kept[kind] | dict(tables[kind]) for kind in KINDS}
    return replace(settings, **merged)


def load_limits(path: Path) -> ModelLimits:
    """Read and check the limits at `path`.

    Raises:
        BenchError: the file is missing, unreadable or not one of limits; a key is unknown or missing, a limit
            is not a finite number above 0.
    """
    raw = read_toml(path, "a file of limits", _CURE)
    known = {"schema", *(field.name for field in fields(ModelLimits)), *KINDS} - {"tables"}
    for key in sorted(raw.keys() - known):
        cure = did_you_mean(key, known, _CURE)
        raise BenchError(f"{path}: {key}", "an unknown key", f"one of {', '.join(sorted(known))}", cure)
    for key in sorted(known - raw.keys()):
        raise BenchError(f"{path}: {key}", "nothing", "this key", _CURE)
    if raw["schema"] != SCHEMA:
        raise BenchError(f"{path}: schema", format_value(raw["schema"]), format_value(SCHEMA), _CURE)
    made_for = raw["made_for"]
    if not isinstance(made_for, dict) or made_for.keys() != set(MadeFor._fields):
        expected = f"digests of {', '.join(MadeFor._fields)}"
        raise BenchError(f"{path}: made_for", format_value(made_for), expected, _CURE)
    tables = {kind: _table(path, kind, raw[kind]) for kind in KINDS}
    return ModelLimits(str(raw["profile"]), int(raw["draws"]), MadeFor(**made_for), tables)


def _table(path: Path, kind: str, table: Any) -> dict[str, Triple]:
    if not isinstance(table, dict):
        raise BenchError(f"{path}: {kind}", format_value(table), "a table", _CURE)
    rows = MODEL_ROWS.keys() - FROM_SETTINGS
    for row in sorted(table.keys() - rows):
        raise BenchError(f"{path}: {kind}.{row}", "an unknown row", f"one of {', '.join(rows)}", _CURE)
    for row in sorted(REQUIRED - table.keys()):
        raise BenchError(f"{path}: {kind}.{row}", "nothing", "this row", _CURE)
    return {row: _limits(f"{path}: {kind}.{row}", limits) for row, limits in table.items()}


def _limits(place: str, limits: Any) -> Triple:
    good = isinstance(limits, list) and len(limits) == 3
    if not good or not all(type(v) in (int, float) and isfinite(v) and v > 0 for v in limits):
        raise BenchError(place, format_value(limits), "three finite numbers above 0", _CURE)
    a, b, c = map(float, limits)
    return a, b, c


def save_limits(path: Path, limits: ModelLimits) -> None:
    """Write `limits` as TOML to `path`.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [
        f"# Limits of the model-based check of {limits.profile}, made by `golfbench swing limits`.",
        f'schema = "{SCHEMA}"',
        f"profile = {json.dumps(limits.profile)}",
        f"draws = {limits.draws}",
        "\n[made_for]",
        *(f'{name} = "{digest}"' for name, digest in limits.made_for._asdict().items()),
    ]
    for kind in KINDS:
        lines += [f"\n[{kind}]"]
        lines += [f"{row} = [{', '.join(_number(v) for v in v3)}]" for row, v3 in limits.tables[kind].items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _number(value: float) -> str:
    return repr(float(value))
