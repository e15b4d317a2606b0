"""The identified robot as a configuration file over the one it was identified with."""

from __future__ import annotations

import json
from pathlib import Path

from bench.config import Configuration
from bench.learning.identify import NAMES, Identified
from sim.plant import PlantParameters

_ACTUATORS = ("shoulder", "right_arm", "wrist")


def plant_file(plant: PlantParameters, found: Identified, configuration: Configuration) -> str:
    """Return TOML with the identified parameters of `plant`, on top of the file of `configuration`.

    Each parameter's standard error stands above it; uncertain ones are marked.
    """
    base = str(configuration.files[-1].resolve())
    lines = ["# Identified from recorded swings: value, standard error."]
    for name, value, error, known in zip(NAMES, found.values, found.error, found.known, strict=True):
        unit = "ms more" if name == NAMES[-1] else "of the nominal"
        doubt = "" if known else "; NOT identified, a guess"
        lines.append(f"# {name}: {value:.4f} {unit}, {error:.4f}{doubt}")
    lines += [f"base = {json.dumps(base)}", ""]
    for name, actuator in zip(_ACTUATORS, plant.actuators, strict=True):
        friction = actuator.friction
        lines += [
            f"[plant.{name}]",
            f"area_a = {actuator.area_a!r}",
            f"area_b = {actuator.area_b!r}",
            f"dead_volume = {actuator.dead_volume!r}",
            f"[plant.{name}.friction]",
            f"viscous = {friction.viscous!r}",
            f"coulomb = {friction.coulomb!r}",
            f"static = {friction.static!r}",
            f"[plant.{name}.valve]",
            f"conductance = {actuator.valve.conductance!r}",
            "",
        ]
    lines += [
        "[plant.supply]",
        f"pressure = {plant.supply.pressure!r}",
        "[plant.encoders]",
        f"latency = {plant.encoders.latency!r}",
        f"[clubs.{plant.robot.club.name}]",
        f"head_mass = {plant.robot.club.head_mass!r}",
    ]
    return "\n".join(lines) + "\n"


def write_plant_file(path: Path, text: str) -> None:
    """Write `text` to `path`; OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
