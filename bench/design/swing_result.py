"""Outcome of one simulated swing: a table and JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from bench.simulation.simulated_bench import SwingResult
from drivers.base import ACTUATORS, CHAMBERS
from sim.plant import PlantParameters

_YARD = 0.9144

FIGURES = (
    ("club speed", "club_speed_mps", "{:.2f} m/s"),
    ("attack angle", "attack_angle_deg", "{:+.2f}°"),
    ("club path", "club_path_deg", "{:+.2f}°"),
    ("face angle", "face_angle_deg", "{:+.2f}°"),
    ("dynamic loft", "dynamic_loft_deg", "{:.2f}°"),
    ("strike, heel-toe", "strike_x_mm", "{:+.1f} mm"),
    ("strike, low-high", "strike_y_mm", "{:+.1f} mm"),
    ("ball speed", "ball_speed_mps", "{:.2f} m/s"),
    ("launch angle", "launch_angle_deg", "{:.2f}°"),
    ("direction", "direction_deg", "{:+.2f}°"),
    ("spin", "spin_rpm", "{:.0f} rpm"),
    ("spin axis", "spin_axis_deg", "{:+.2f}°"),
    ("carry", "carry_m", "{:.1f} m"),
    ("total", "total_m", "{:.1f} m"),
)
"""Name, field of Shot, form."""


def outcome_record(result: SwingResult, time: datetime) -> dict[str, Any]:
    """Return the swing's figures as JSON; units are in the names."""
    shot = asdict(result.shot(1, time_utc=time).shot)
    shot["time_utc"] = time.isoformat(timespec="seconds")
    return {
        "shot": shot,
        "cause": result.cause.name,
        "contact_time_s": result.contact_time,
        "peak_head_speed_mps": result.loads.peak_head_speed,
        "lowest_clearance_m": result.loads.lowest_clearance,
        "stop_energy_j": dict(zip(ACTUATORS, result.loads.stop_energy.max(axis=1).tolist(), strict=True)),
        "peak_pressure_pa": dict(zip(CHAMBERS, result.loads.peak_pressure.tolist(), strict=True)),
        "unsafe": result.unsafe,
    }


def outcome_table(result: SwingResult, plant: PlantParameters, record: Mapping[str, Any]) -> Table:
    """Return the swing's figures and loads as a table."""
    table = Table(box=SIMPLE_HEAD, pad_edge=False, show_header=False, title_justify="left")
    table.title = Text(result.reason or "a valid shot", "bold red" if result.reason else "bold green")
    table.add_column(no_wrap=True)
    table.add_column(no_wrap=True)
    for name, field, form in FIGURES:
        if (value := record["shot"][field]) is not None:
            yards = f"  ({value / _YARD:.1f} yd)" if field in ("carry_m", "total_m") else ""
            table.add_row(name, form.format(value) + yards)
    table.add_section()
    for actuator, energy, name in zip(
        plant.actuators, result.loads.stop_energy.max(axis=1), ACTUATORS, strict=True
    ):
        table.add_row(f"end stop, {name}", f"{energy:.1f} of {actuator.stop.rating:g} J")
    table.add_row("highest pressure", f"{result.loads.peak_pressure.max() / 1e5:.2f} bar absolute")
    table.add_row("sole over ground", f"at least {1e3 * result.loads.lowest_clearance:.1f} mm")
    for danger in result.unsafe:
        table.add_row("unsafe", Text(danger, "bold red"))
    return table
