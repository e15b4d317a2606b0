"""Outcome of one simulated swing: a table, JSON, the record and a picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from rich.box import SIMPLE_HEAD
from rich.table import Table
from rich.text import Text

from bench.base.lifecycle import Phase
from bench.records.shot.plot_style import COLOURS, GREY, INK, save_picture, styled
from bench.records.telemetry.recorder import write_swing
from bench.simulation.simulated_bench import SwingResult
from drivers.base import ACTUATORS, CHAMBERS, JOINTS
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


def write_outcome(folder: Path, result: SwingResult, metadata: Mapping[str, Any]) -> tuple[Path, Path]:
    """Write `swing.parquet` and `tracking.png` into `folder`, which is made, and return their paths.

    Raises:
        NotStored: record or picture cannot be written.
        OSError: the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record, picture = folder / "swing.parquet", folder / "tracking.png"
    write_swing(record, result.cycles, metadata)
    save_picture(tracking(result.cycles), picture)
    return record, picture


_PHASES = {
    Phase.BACKSWING: ("backswing", "#eef2ff"),
    Phase.TOP: ("top", "#fef9c3"),
    Phase.DOWNSWING: ("downswing", "#dcfce7"),
    Phase.COMMITTED: ("committed", "#bbf7d0"),
    Phase.IMPACT: ("impact", "#fecaca"),
    Phase.FOLLOW_THROUGH: ("follow-through", "#fdf2e9"),
    Phase.RETURN: ("return", "#f3f4f6"),
}


def _since_start(cycles: np.ndarray[Any, Any]) -> np.ndarray:
    since: np.ndarray = cycles["time"] - cycles["time"][0]
    return since


def _without_return(cycles: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the cycles up to the slow return, all of them without one."""
    returning = np.flatnonzero(cycles["phase"] == Phase.RETURN)
    return cycles[: returning[0] + 1] if returning.size and returning[0] > 0 else cycles


def _shade(axes: Axes, cycles: np.ndarray[Any, Any]) -> None:
    """Shade the phases of the swing."""
    phase, time = cycles["phase"], _since_start(cycles)
    edges = np.flatnonzero(np.diff(phase.astype(int)))
    starts, ends = np.concatenate([[0], edges + 1]), np.concatenate([edges + 1, [len(phase) - 1]])
    for start, end in zip(starts, ends, strict=True):
        shown = _PHASES.get(Phase(int(phase[start])))
        if shown:
            axes.axvspan(time[start], time[end], color=shown[1], linewidth=0)


def _phase_legend(figure: Figure, cycles: np.ndarray[Any, Any]) -> None:
    present = set(np.unique(cycles["phase"]).tolist())
    patches = [
        Patch(facecolor=colour, edgecolor="#d1d5db", linewidth=0.5, label=name)
        for phase, (name, colour) in _PHASES.items()
        if phase.value in present
    ]
    if patches:
        figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), fontsize=7)


def tracking(cycles: np.ndarray[Any, Any]) -> Figure:
    """Reference against actual joint angles, and their difference, phases shaded."""
    figure = styled(4.3)
    grid = figure.subplots(3, 2, sharex=True, width_ratios=[1.5, 1])
    cycles = _without_return(cycles)
    time = _since_start(cycles)
    to_ball = cycles["phase"] <= Phase.IMPACT
    for joint, name in enumerate(JOINTS):
        angle, error = grid[joint]
        reference = np.degrees(cycles["reference_angle"][:, joint])
        actual = np.degrees(cycles["angle"][:, joint])
        for axes in (angle, error):
            _shade(axes, cycles)
        angle.plot(time, reference, color=INK, linewidth=1.0, linestyle=(0, (4, 2)), label="reference")
        angle.plot(time, actual, color=COLOURS[0], label="actual (estimate)")
        angle.set(title=f"θ{joint + 1} {name}", ylabel="degrees")
        error.plot(time, reference - actual, color=COLOURS[1], linewidth=1.0)
        error.axhline(0, color=GREY, linewidth=0.6)
        error.set(title="reference − actual", ylabel="degrees")
        if to_ball.any():
            largest = max(1.15 * float(np.abs(reference - actual)[to_ball].max()), 0.01)
            error.set_ylim(-largest, largest)
    grid[0, 0].legend(loc="best")
    for axes in grid[2]:
        axes.set(xlabel="time, s", xlim=(time[0], time[-1]))
    _phase_legend(figure, cycles)
    return figure
