"""Parts of a report's page: template, table of shots, configurations as text."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2

from bench.campaign.display_units import UnitSystem, display_unit
from bench.shot.shot import Shot


class Quantity(NamedTuple):
    """One measured figure as reports show it."""

    name: str
    column: str


CLUB = (
    Quantity("club", "club_speed_mps"),
    Quantity("attack", "attack_angle_deg"),
    Quantity("path", "club_path_deg"),
    Quantity("face", "face_angle_deg"),
    Quantity("loft", "dynamic_loft_deg"),
    Quantity("strike x", "strike_x_mm"),
    Quantity("strike y", "strike_y_mm"),
)
"""Delivery of a shot, the upper line in the table of shots."""
BALL = (
    Quantity("ball", "ball_speed_mps"),
    Quantity("launch", "launch_angle_deg"),
    Quantity("direction", "direction_deg"),
    Quantity("spin", "spin_rpm"),
    Quantity("spin axis", "spin_axis_deg"),
    Quantity("carry", "carry_m"),
    Quantity("offline", "carry_side_m"),
    Quantity("total", "total_m"),
    Quantity("apex", "apex_m"),
    Quantity("landing", "landing_angle_deg"),
)
"""Launch and flight of a shot, the lower line."""


def page_template(name: str, filters: Mapping[str, Callable[..., Any]] | None = None) -> jinja2.Template:
    """Return a template of this package with its own `filters`; undefined variables are errors."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(
            lambda wanted: (files("bench.campaign") / wanted).read_text(encoding="utf-8")
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(filters or {})
    return environment.get_template(name)


def shot_figures(shot: Shot, quantities: Iterable[Quantity], units: UnitSystem) -> list[str]:
    """Return the `quantities` of a shot as text."""
    return [display_unit(q.column, units).text(getattr(shot, q.column)) for q in quantities]


def flat(configuration: Mapping[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Return the configuration as titled groups of (key, value as text)."""
    groups: dict[str, list[tuple[str, str]]] = {}

    def visit(prefix: str, value: object) -> None:
        if isinstance(value, Mapping) and value:
            for key, inner in value.items():
                visit(f"{prefix}.{key}" if prefix else str(key), inner)
        else:
            group, _, key = prefix.rpartition(".")
            groups.setdefault(group, []).append((key, _text(value)))

    visit("", configuration)
    return list(groups.items())


def _text(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
