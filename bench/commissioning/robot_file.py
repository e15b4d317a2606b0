"""The commissioned robot as a configuration over the one it began with, and the report to sign."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from shlex import quote
from textwrap import wrap

import jinja2

from bench.base.to_toml import toml_value
from bench.commissioning.commissioning import ALL_STEPS, Commissioning, with_digest
from bench.commissioning.machine.step import ParameterEstimate, RobotEstimate
from bench.control.measured_plant import value_at
from bench.control.settings import EnvelopeSettings
from sim.plant import ACTUATOR_KEYS, PlantParameters

GUESSES = (
    "lengths",
    "masses and inertias whose standard error is 7 %",
    "damping of the spools",
    "Stribeck speeds",
    "polytropic exponent of the chambers",
    "feed, manifold, dump and vent conductances of the supply",
    "end stops",
    "ball and ground",
)
"""Parts of the plant that no step measures yet: they stay as configured."""

NO_CALIBRATION = (
    "The zeros of the encoders hold for the presets that these have now, which no file holds. A bench with "
    "hardware arms only with calibrations in force (golfbench calibrate list), of which the encoders' stores "
    "the presets that the running bench has read, for comparison at each start. For encoders and valves:"
)
"""Why robot.toml does not replace a calibration, for its reader."""

_WIDTH = 108
_MIN_UNCERTAINTY_DEG = 0.001
"""Smallest standard uncertainty that is entered for a zero, deg."""
_CLUB, _SUPPLY, _ENCODERS, _SPOOL = "robot.club", "supply.pressure", "encoders", ("centre", "dead_band")


def robot_file(
    known: RobotEstimate,
    base: str,
    made: datetime,
    envelope: EnvelopeSettings | None = None,
    following: Mapping[str, tuple[float, float, float]] | None = None,
    profile: Path | None = None,
    file: Path = Path("robot.toml"),
) -> str:
    """Return TOML of the robot in `known` over the configuration file `base`, commissioned at `made`.

    The limits of the supply's pressure, of `envelope`, follow the supply that was found; `following` are
    those of following errors, by phase. `profile` is the file of its swing, `file` that of the robot.
    """
    lines = [
        f"# Commissioned on {made:%Y-%m-%d}: values with standard errors, and the steps that found them.",
        "# Not measured, as configured: " + "; ".join(GUESSES) + ".",
        f"base = {toml_value(base)}",
        "",
        "[bench]",
        f"commissioned = {toml_value(made.isoformat(timespec='seconds'))}",
    ]
    if profile is not None:
        lines += ["", "[swing]", f"profile = {toml_value(str(profile.resolve()))}"]
    tables: dict[str, list[str]] = {}
    for key, found in _keys(known.found.values()).items():
        table, _, name = key.rpartition(".")
        text = toml_value(value_at(known.plant, key))
        errors = ", ".join(f"{one.error:.3g}" for one in found)
        unit = f" {found[0].unit}" if found[0].unit else ""
        note = f"± {errors}{unit}; {found[0].step}"
        tables.setdefault(table, []).append(f"{name} = {text}  # {note}")
    for table in sorted(tables):
        location = f"clubs.{known.plant.robot.club.name}" if table == _CLUB else f"plant.{table}".rstrip(".")
        lines += [""]
        lines += _calibration(known, file) if table == _ENCODERS else []
        lines += [f"[{location}]", *tables[table]]
    if envelope is not None and _SUPPLY in known.found:
        share = known.plant.supply.pressure / known.nominal.supply.pressure
        low, high = share * envelope.min_supply_pressure, share * envelope.max_supply_pressure
        lines += ["", "[envelope]"]
        lines += [f"min_supply_pressure = {low:.0f}.0", f"max_supply_pressure = {high:.0f}.0"]
    if following:
        lines += ["", "[envelope.max_following_error]"]
        lines += [f"{phase} = {toml_value(limits)}" for phase, limits in following.items()]
    lines += ["", "[envelope.model]", 'check = "always"  # this robot was measured']
    lines += ["", "[envelope.model.standard_errors]"]
    lines += [
        f'"{found.key}" = {toml_value(found.error)}' for found in known.found.values() if found.error > 0.0
    ]
    return with_digest("\n".join(lines) + "\n")


def _calibration(known: RobotEstimate, file: Path) -> list[str]:
    """Return comments with the commands that store zeros and valves in `file` as calibrations."""
    encoders = known.plant.encoders
    uncertainty = _max_error(known, f"{_ENCODERS}.zero_count") * 360.0 / encoders.counts_per_revolution
    zeros, signs = (" ".join(map(str, values)) for values in (encoders.zero_count, encoders.sign))
    command = f"# golfbench --config {quote(str(file.resolve()))} calibrate"
    lines = [
        *(f"# {line}" for line in wrap(NO_CALIBRATION, _WIDTH)),
        f"{command} encoders --zero-counts {zeros} --sign {signs} "
        f"--uncertainty-deg {max(uncertainty, _MIN_UNCERTAINTY_DEG):.2g}",
    ]
    if error := _max_error(known, *(f"{key}.valve.{name}" for key in ACTUATOR_KEYS for name in _SPOOL)):
        valves = [actuator.valve for actuator in known.plant.actuators]
        centre, band = (" ".join(f"{getattr(valve, name):.5f}" for valve in valves) for name in _SPOOL)
        lines.append(f"{command} valves --centre {centre} --dead-band {band} --uncertainty {error:.2g}")
    return lines


def _max_error(known: RobotEstimate, *keys: str) -> float:
    """Return the max standard error of the values found at or below `keys`, 0 if there are none."""
    return max((one.error for key, one in known.found.items() if key.startswith(keys)), default=0.0)


def _keys(found: Iterable[ParameterEstimate]) -> dict[str, list[ParameterEstimate]]:
    """Return the values by their keys, elements of a list under the list's."""
    keys: dict[str, list[ParameterEstimate]] = {}
    for value in found:
        name, _, last = value.key.rpartition(".")
        keys.setdefault(name if last.isdigit() else value.key, []).append(value)
    return keys


def commissioning_report(state: Commissioning, nominal: PlantParameters, made: datetime) -> str:
    """Return the report of `state` as HTML; `nominal` is the robot as configured."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(
        (files("bench.commissioning") / "commissioning.html.j2").read_text(encoding="utf-8")
    )
    known = RobotEstimate(nominal, state.values)
    done = {step.name for step in state.done}
    return template.render(
        state=state,
        made=made,
        minutes=sum(step.seconds for step in state.done) / 60,
        configured=lambda key: f"{value_at(known.nominal, key):.6g}",
        left=[step.title for step in ALL_STEPS if step.name not in done],
        guesses=GUESSES,
        no_calibration=NO_CALIBRATION,
        steps=len(ALL_STEPS),
    )
