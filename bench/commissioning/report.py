"""The report of a commissioning that a person can sign: one self-contained HTML file."""

from __future__ import annotations

from datetime import datetime
from importlib.resources import files

import jinja2

from bench.commissioning.commissioning import ALL_STEPS, Commissioning
from bench.commissioning.known_robot import KnownRobot
from bench.commissioning.robot_file import GUESSES, NO_CALIBRATION
from bench.commissioning.steps import NamedStep
from bench.control.measured_plant import value_at
from sim.plant import PlantParameters


def commissioning_report(state: Commissioning, nominal: PlantParameters, made: datetime) -> str:
    """Return the report of `state` as HTML; `nominal` is the robot as configured."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(
        (files("bench.commissioning") / "commissioning.html.j2").read_text(encoding="utf-8")
    )
    known = KnownRobot(nominal, state.values)
    done = {step.name for step in state.done}
    return template.render(
        state=state,
        made=made,
        minutes=sum(step.seconds for step in state.done) / 60,
        configured=lambda key: f"{value_at(known.nominal, key):.6g}",
        left=_titles([step for step in ALL_STEPS if step.name not in done]),
        guesses=GUESSES,
        no_calibration=NO_CALIBRATION,
        steps=len(ALL_STEPS),
    )


def _titles(steps: list[NamedStep]) -> list[str]:
    return [step.title for step in steps]
