"""Parts of a report's page: template, table of shots, configurations as text."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any, NamedTuple

import jinja2

from bench.shot.shot import Shot

MPH = 0.44704
YARD = 0.9144


class Quantity(NamedTuple):
    """One measured figure as reports show it."""

    name: str
    unit: str
    digits: int
    value: Callable[[Shot], float | None]


def _column(name: str, scale: float = 1.0) -> Callable[[Shot], float | None]:
    """Return a function that reads one column of a shot, divided by `scale`."""

    def value(shot: Shot) -> float | None:
        found: float | None = getattr(shot, name)
        return None if found is None else found / scale

    return value


TABLE = (
    Quantity("club", "mph", 1, _column("club_speed_mps", MPH)),
    Quantity("attack", "°", 2, _column("attack_angle_deg")),
    Quantity("path", "°", 2, _column("club_path_deg")),
    Quantity("face", "°", 2, _column("face_angle_deg")),
    Quantity("loft", "°", 2, _column("dynamic_loft_deg")),
    Quantity("strike x", "mm", 1, _column("strike_x_mm")),
    Quantity("strike y", "mm", 1, _column("strike_y_mm")),
    Quantity("ball", "mph", 1, _column("ball_speed_mps", MPH)),
    Quantity("launch", "°", 2, _column("launch_angle_deg")),
    Quantity("direction", "°", 2, _column("direction_deg")),
    Quantity("spin", "rpm", 0, _column("spin_rpm")),
    Quantity("axis", "°", 2, _column("spin_axis_deg")),
    Quantity("carry", "yd", 1, _column("carry_m", YARD)),
    Quantity("total", "yd", 1, _column("total_m", YARD)),
    Quantity("apex", "yd", 1, _column("apex_m", YARD)),
    Quantity("landing", "°", 1, _column("landing_angle_deg")),
)


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


def figure_text(quantity: Quantity, value: float | None) -> str:
    """Write a figure with the quantity's digits and a real minus sign."""
    if value is None:
        return "–"
    text = f"{value:.{quantity.digits}f}"
    return (text.removeprefix("-") if float(text) == 0 else text).replace("-", "−")


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
