"""Limits of the model-based check that were made for one profile, plant and controller: their file and use.

A file PROFILE.limits.toml holds the limits by comparison, row and joint, and what they were made for.
`golfbench profile limits` makes it. Limits made for something else are stale: reported and not used, and
a real robot is not armed. Used are, in this order: tables that the configuration gives by hand; the limits of
the profile, if they are not stale; else the default tables of [envelope.model], wide enough for every shipped
profile. Limits are made for the values that a swing feels, each within a tolerance: a measured value changes
with each calibration, and limits allow for robots within their tolerances around the model.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from bench.base.errors import BenchError, did_you_mean
from bench.base.from_toml import format_value, read_toml
from bench.base.to_toml import toml_value
from bench.control.estimate.residual_monitor import KINDS
from bench.control.settings import (
    MODEL_PHASES,
    MODEL_ROWS,
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    ModelSettings,
    Triple,
)
from bench.swing.correction import digest_of
from bench.swing.profile import Profile
from sim.plant import ACTUATOR_KEYS, PlantParameters

Values = Mapping[str, Any]
"""Values by their dotted names in files of limits: numbers, texts, truth values, lists of numbers."""

IGNORED_FIELDS = frozenset(
    {
        # They differ from swing to swing, or act only at rest.
        "ball",
        "seed",
        "vent_feedback",
        "shut_off_feedback",
        "spool_feedback",
        "supply.shut_off_delay",
        # No healthy swing reaches them, or no force depends on them.
        "supply.manifold_relief_ratio",
        "supply.manifold_relief_conductance",
        "shoulder.stop.rated",
        "right_arm.stop.rated",
        "wrist.stop.rated",
        "robot.club.name",
        # Counts become angles before anything is compared.
        "encoders.zero_count",
        "encoders.sign",
    }
)
"""Values of the plant, and groups of them, that do not make limits stale."""

MIN_RELEVANT_TEE_SHIFT = 0.013
"""Shift of the tee (m) towards heel or toe from which on it makes limits stale: nearer, the joints' speeds
after the blow differ by less than a third of what their comparison allows for."""
SHARE = 0.02
"""Fraction by which a value of the plant may differ: less than the tolerances of the sampled robots."""
TOLERANCES: Values = {
    "robot.club.tee_shift": 0.999 * MIN_RELEVANT_TEE_SHIFT,
    "robot.club.face_angle": 0.02,
    "wrist_lever_angle": 0.01,
    "site.ball_x": 0.005,
    "site.ball_y": 0.005,
    "encoders.latency": 1e-4,
    "encoders.noise": 1e-5,
    "encoders.jitter": 2e-6,
    **{f"{joint}.valve.centre": 0.005 for joint in ACTUATOR_KEYS},
    **{f"{joint}.valve.dead_band": 0.002 for joint in ACTUATOR_KEYS},
}
"""Min relevant difference of a plant value for which a fraction means nothing (m, rad, s, valve command)."""


class LimitsFingerprint(NamedTuple):
    """A profile, a plant and a controller as far as a swing feels them."""

    profile: str
    """Digest of the tables."""
    plant: Values
    controller: Values

    @classmethod
    def of(
        cls,
        profile: Profile,
        plant: PlantParameters,
        control: ControlSettings,
        envelope: EnvelopeSettings,
        estimator: EstimatorSettings,
    ) -> LimitsFingerprint:
        """Return the values of a bench; IGNORED_FIELDS of its plant are left out."""
        acting = {
            "control": _as_acting(control, plant),
            "estimator": asdict(estimator),
            "envelope": {"max_opening": envelope.max_opening, "max_slew": envelope.max_slew},
        }
        return cls(digest_of(profile), dict(_named(asdict(plant))), dict(_named(acting)))

    def differences(self, bench: LimitsFingerprint) -> list[str]:
        """Return what of `bench` is not as in this one, for people; empty if these limits hold for it."""
        plant = _differing(self.plant, bench.plant, SHARE)
        controller = _differing(self.controller, bench.controller, 0.0)
        return [
            *(["another profile"] if self.profile != bench.profile else []),
            *([f"another plant ({plant})"] if plant else []),
            *([f"another controller ({controller})"] if controller else []),
        ]


def _as_acting(control: ControlSettings, plant: PlantParameters) -> dict[str, Any]:
    """Return `control` without the values that have no effect on `plant`.

    These are manual gains where scheduled ones are used, a factor of 1, and the turf lift on surface "none".
    """
    values = asdict(control)
    if plant.site.surface == "none":
        del values["turf_lift_gain"]
    if values["downswing_gain_factor"] == 1.0:
        del values["downswing_gain_factor"]
    if values.pop("gains") == "machine":
        values |= dict.fromkeys(("pid", "damping", "move_gain"), "machine")
    return values


def _named(values: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the felt values of a nested table by their dotted names."""
    for key, value in values.items():
        name = f"{group}.{key}".lstrip(".")
        if name in IGNORED_FIELDS:
            continue
        if isinstance(value, Mapping):
            yield from _named(value, name)
        else:
            yield name, list(value) if isinstance(value, tuple) else value


def _differing(made: Values, here: Values, share: float) -> str:
    """Return the first value that differs, with how many more; empty without one."""
    names = [
        name
        for name in {**here, **made}
        if not _alike(made.get(name), here.get(name), share, TOLERANCES.get(name, 0.0))
    ]
    if not names:
        return ""
    first, more = names[0], f" and {len(names) - 1} more" if names[1:] else ""
    return f"{first} {_short(made.get(first))}, here {_short(here.get(first))}{more}"


def _alike(made: Any, here: Any, share: float, least: float) -> bool:
    """Return whether two values are the same within the fraction `share` of them, or within `least`."""
    if isinstance(made, list) and isinstance(here, list):
        pairs = zip(made, here, strict=False)
        return len(made) == len(here) and all(_alike(a, b, share, least) for a, b in pairs)
    if type(made) not in (int, float) or type(here) not in (int, float):
        return bool(made == here)
    return bool(abs(made - here) <= max(share * max(abs(made), abs(here)), least))


def _short(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else "nothing" if value in (None, "") else str(value)


SCHEMA = "golfbench-limits/2"
ENDING = ".limits.toml"
"""End of the name of a file of limits."""
FROM_SETTINGS = frozenset({"homing", "standing"})
"""Rows that no swing shows: their limits are those of the settings."""
_KEPT = FROM_SETTINGS | {"arming"}
"""Rows of the settings that hold unless a file has them."""
REQUIRED = frozenset(MODEL_PHASES["air"]) - FROM_SETTINGS
"""Rows that each table of a file has."""

LimitTables = Mapping[str, Mapping[str, Triple]]
"""Limits by comparison and row, joints in order: Pa, Pa, rad/s, rad, N m."""

_ACTION = "Make it again with `golfbench profile limits`."


@dataclass(frozen=True)
class ModelLimits:
    """Content of a file of limits."""

    profile: str
    """Name of the profile."""
    draws: int
    """Number of sampled robots that the limits come from."""
    made_for: LimitsFingerprint
    tables: LimitTables


class LimitsInUse(NamedTuple):
    """Limits that a bench uses."""

    settings: ModelSettings
    source: str
    """Text for people: the file, or why no file is used."""
    stale: bool
    """Whether there is a file that could not be used."""


def limits_path(profile: Path) -> Path:
    """Return the path of the limits of the profile in file `profile`: in its folder."""
    return profile.with_name(profile.name.removesuffix(".toml") + ENDING)


def limits_in_use(
    settings: ModelSettings, bench: LimitsFingerprint, candidates: Iterable[Path]
) -> LimitsInUse:
    """Return the limits for `bench`: those of the first file of `candidates` that was made for it.

    Raises:
        BenchError: a file is not one of limits.
    """
    if any(getattr(settings, kind) != getattr(ModelSettings(), kind) for kind in KINDS):
        return LimitsInUse(settings, "tables of the configuration", stale=False)
    stale = []
    for path in candidates:
        if path.is_file():
            limits = load_limits(path)
            if not (found := limits.made_for.differences(bench)):
                return LimitsInUse(_merged(settings, limits.tables), str(path), stale=False)
            stale.append(f"{path}: made for {' and '.join(found)}")
    text = "; ".join(stale) or "none were made for this profile"
    return LimitsInUse(
        settings, f"default tables ({text}; `golfbench profile limits` makes them)", bool(stale)
    )


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
    raw = read_toml(path, "a file of limits", _ACTION)
    known = {"schema", *(field.name for field in fields(ModelLimits)), *KINDS} - {"tables"}
    for key in sorted(raw.keys() - known):
        action = did_you_mean(key, known, _ACTION)
        raise BenchError(f"{path}: {key}", "an unknown key", f"one of {', '.join(sorted(known))}", action)
    for key in sorted(known - raw.keys()):
        raise BenchError(f"{path}: {key}", "missing", f"the key {key}", _ACTION)
    if raw["schema"] != SCHEMA:
        raise BenchError(f"{path}: schema", format_value(raw["schema"]), format_value(SCHEMA), _ACTION)
    made_for = _made_for(f"{path}: made_for", raw["made_for"])
    tables = {kind: _table(path, kind, raw[kind]) for kind in KINDS}
    return ModelLimits(str(raw["profile"]), int(raw["draws"]), made_for, tables)


def _made_for(location: str, table: Any) -> LimitsFingerprint:
    if not isinstance(table, dict) or table.keys() != set(LimitsFingerprint._fields):
        raise BenchError(location, format_value(table), f"{', '.join(LimitsFingerprint._fields)}", _ACTION)
    for part in ("plant", "controller"):
        if not isinstance(table[part], dict):
            raise BenchError(f"{location}.{part}", format_value(table[part]), "a table of values", _ACTION)
    return LimitsFingerprint(
        str(table["profile"]), _ungrouped(table["plant"]), _ungrouped(table["controller"])
    )


def _ungrouped(groups: Mapping[str, Any]) -> Values:
    """Return the values by their whole names."""
    values: dict[str, Any] = {}
    for group, items in groups.items():
        if isinstance(items, dict):
            values |= {f"{group}.{key}": value for key, value in items.items()}
        else:
            values[group] = items
    return values


def _table(path: Path, kind: str, table: Any) -> dict[str, Triple]:
    if not isinstance(table, dict):
        raise BenchError(f"{path}: {kind}", format_value(table), "a table", _ACTION)
    rows = MODEL_ROWS.keys() - FROM_SETTINGS
    for row in sorted(table.keys() - rows):
        raise BenchError(f"{path}: {kind}.{row}", "an unknown row", f"one of {', '.join(rows)}", _ACTION)
    for row in sorted(REQUIRED - table.keys()):
        raise BenchError(f"{path}: {kind}.{row}", "missing", f"the row {row}", _ACTION)
    return {row: _limits(f"{path}: {kind}.{row}", limits) for row, limits in table.items()}


def _limits(location: str, limits: Any) -> Triple:
    good = isinstance(limits, list) and len(limits) == 3
    if not good or not all(type(v) in (int, float) and isfinite(v) and v > 0 for v in limits):
        raise BenchError(location, format_value(limits), "three finite numbers above 0", _ACTION)
    a, b, c = map(float, limits)
    return a, b, c


def save_limits(path: Path, limits: ModelLimits) -> None:
    """Write `limits` as TOML to `path`.

    Raises:
        OSError: the file cannot be written.
    """
    lines = [
        f"# Limits of the model-based check of {limits.profile}, made by `golfbench profile limits`.",
        f'schema = "{SCHEMA}"',
        f"profile = {toml_value(limits.profile)}",
        f"draws = {limits.draws}",
        "\n[made_for]",
        f'profile = "{limits.made_for.profile}"',
        "\n[made_for.plant]",
        *_grouped(limits.made_for.plant),
        "\n[made_for.controller]",
        *_grouped(limits.made_for.controller),
    ]
    for kind in KINDS:
        lines += [f"\n[{kind}]"]
        lines += [f"{row} = {toml_value(v3)}" for row, v3 in limits.tables[kind].items()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _grouped(values: Values) -> Iterator[str]:
    """Yield a line of TOML for each group of `values`."""
    groups: dict[str, list[str]] = {}
    for name, value in values.items():
        group, _, key = name.rpartition(".")
        groups.setdefault(group, []).append(f"{key} = {toml_value(value)}")
    yield from groups.pop("", [])
    for group, items in groups.items():
        yield f'"{group}" = {{ {", ".join(items)} }}'
