"""`golfbench golfer ...`: measured swings of golfers."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bench.base.errors import BenchError
from bench.commands.common import (
    Json,
    Plot,
    Session,
    argument,
    console_of,
    finite,
    option,
    plain_table,
    require_picture,
    show_json,
)
from bench.swing.library import find_profile, profile_names
from drivers.base.ranges import read_number

if TYPE_CHECKING:
    from bench.config import Configuration
    from bench.golfer.comparison import MotionDeviation, SwingMotion
    from bench.golfer.roles import Roles
    from sim.plant import PlantParameters

app = typer.Typer(no_args_is_help=True)

_NAME = re.compile(r"[\w][\w .-]{0,99}")
PIPED_WIDTH = 160
"""Columns of a comparison in a file or pipe."""
_JOINTS = ("shoulders θ1", "lead arm θ2", "wrist θ3")


@app.callback()
def golfer() -> None:
    """Import measured swings of golfers, and compare swings with them."""


@app.command("import")
def import_(
    context: typer.Context,
    file: Annotated[Path, argument("FILE", "Recording: .c3d, .trc, .csv or .bvh.")],
    markers: Annotated[
        Path | None, option("TOML from roles to markers.", "MAP", shown="built-in maps")
    ] = None,
    name: Annotated[str | None, option("Name of the result.", "NAME", shown="the file's")] = None,
    lead: Annotated[
        Literal["left", "right"] | None, option("Lead side, to be verified.", shown="found")
    ] = None,
    up: Annotated[
        Literal["x", "y", "z", "-x", "-y", "-z"] | None, option("Up axis, -z for z down.", shown="found")
    ] = None,
    events: Annotated[
        str | None, option("Events (s) in the file's time.", "top=S,impact=S", shown="found")
    ] = None,
    output: Annotated[Path, option("Folder of the result.", "DIR")] = Path(),
    plot: Plot = None,
    json_: Json = False,
) -> None:
    """Import a recorded swing: events, swing plane, joint angles, speeds, excess beyond the robot's ranges.

    Writes NAME.golfer.toml and its table. A recording without a club gives shoulders and arm only. Files of
    GEARS itself are not read: export C3D from GEARS. C3D needs `pip install 'golfbench[mocap]'`.
    """
    from bench.golfer.comparison import beyond_ranges
    from bench.golfer.golfer_file import ImportOptions, save_golfer, summary
    from bench.golfer.measuring import measure
    from bench.golfer.recording import read_capture
    from bench.golfer.roles import find_roles

    known = _events(events)
    options = ImportOptions(lead or "", up or "", known.get("top"), known.get("impact"))
    require_picture(plot)
    title = file.stem if name is None else name
    _require_destination(title, output)
    plant = context.ensure_object(Session).configuration().plant
    capture = read_capture(file)
    roles = find_roles(capture, markers)
    swing = measure(capture, roles, options)
    path = save_golfer(output, title, swing, capture, roles)
    if plot is not None:
        from bench.golfer.golfer_plot import golfer_plot
        from bench.records.shot.plot_style import save_picture

        save_picture(golfer_plot(swing, f"{title}, {capture.path.name}"), plot)
    figures, beyond = summary(swing), beyond_ranges(plant, swing.angle[swing.downswing])
    if json_:
        keys = ("shoulder_rad", "right_arm_m", "wrist_rad")
        excess = {key: finite(round(value, 5)) for key, value in zip(keys, beyond, strict=True)}
        source = {"golfer": str(path), "source_sha256": capture.digest}
        marked = {"markers": roles.markers, "markers_left_out": roles.dropped}
        return show_json(source | figures | {"beyond_machine": excess} | marked)
    console = Console()
    for shown in import_report(figures, roles, beyond):
        console.print(shown, highlight=False, soft_wrap=isinstance(shown, str))
    typer.echo(f"Golfer: {path}")
    if plot is not None:
        typer.echo(f"Picture: {plot}")


@app.command()
def compare(
    context: typer.Context,
    swings: Annotated[
        list[str] | None, argument("GOLFER SWING...", "Reference and swings.", shown="all built-in golfers")
    ] = None,
    plot: Plot = None,
    json_: Json = False,
) -> None:
    """Compare swings with the first one, which is a golfer's: deviation of each joint and of the head.

    Swings are NAME.golfer.toml, model:NAME of a built-in golfer, or profiles by name or path. Without swings
    each built-in golfer's model is compared with the profile that follows it.
    """
    from bench.golfer.comparison import beyond_ranges, compare_motions

    require_picture(plot)
    configuration = context.ensure_object(Session).configuration()
    plant = configuration.plant
    if swings:
        if len(swings) < 2:
            action = "Add profiles, NAME.golfer.toml or model:NAME."
            raise BenchError("SWING", swings[0], "a golfer and at least one other swing", action)
        reference, *others = (_motion(plant, text) for text in swings)
        pairs = [(reference, other) for other in others]
    else:
        pairs = _golfers_own(configuration)
    rows = [compare_motions(*pair) for pair in pairs]
    if plot is not None and rows:
        from bench.golfer.golfer_plot import comparison_plot
        from bench.records.shot.plot_style import save_picture

        save_picture(comparison_plot(rows), plot)
    if json_:
        return show_json([_record(row) for row in rows])
    console = console_of(PIPED_WIDTH)
    console.print(comparison_table(rows), highlight=False)
    for motion in {row.reference.name: row.reference for row in rows}.values():
        excess = beyond_ranges(plant, motion.angle[motion.in_downswing])
        console.print(f"{motion.name}: {beyond_text(excess)}", highlight=False, soft_wrap=True)
    if plot is not None and rows:
        typer.echo(f"Picture: {plot}")


def _motion(plant: PlantParameters, text: str) -> SwingMotion:
    from bench.golfer.comparison import golfer_motion, golfer_named, robot_motion
    from bench.golfer.golfer_file import SUFFIX
    from bench.swing.profile import load_profile

    if text.startswith("model:") or text.endswith(SUFFIX):
        return golfer_motion(plant, golfer_named(text.removeprefix("model:")))
    return robot_motion(plant, load_profile(find_profile(text)))


def _record(row: MotionDeviation) -> dict[str, Any]:
    """Return `row` as a record: fractions of the reference's ranges, None where not measured."""
    from bench.golfer.comparison import DEFINITION

    joints = ("shoulder", "arm", "wrist", "head")
    units = ("shoulder_rad", "arm_rad", "wrist_rad", "head_m")
    found: dict[str, Any] = {
        key: {
            "name": motion.name,
            "source": motion.source,
            "head_speed_mps": finite(round(motion.head_speed, 5)),
            "downswing_s": round(motion.downswing, 4),
        }
        for key, motion in (("reference", row.reference), ("swing", row.other))
    }
    for key, names, values in (("deviation", joints, row.share), ("rms", units, row.error)):
        found[key] = {name: finite(round(value, 5)) for name, value in zip(names, values, strict=True)}
    return found | {"definition": DEFINITION}


def _golfers_own(c: Configuration) -> list[tuple[SwingMotion, SwingMotion]]:
    """Return each built-in golfer's model with the profile that follows it within the ranges of robot `c`.

    NAME-full needs the ranges of the variant `golfers`, NAME those of the shipped robot.
    """
    from bench.design.static_checks import beyond_range
    from bench.golfer.comparison import golfer_motion, robot_motion
    from bench.swing.golfers import GOLFERS
    from bench.swing.profile import load_profile

    known = profile_names()
    found: list[tuple[SwingMotion, SwingMotion]] = []
    for name, golfer in GOLFERS.items():
        own = [load_profile(find_profile(n)) for n in (f"{name}-full", name) if n in known]
        fitting = [swing for swing in own if not beyond_range(swing, c.plant, c.envelope)]
        if own:
            followed = robot_motion(c.plant, (fitting or own[-1:])[0])
            found.append((golfer_motion(c.plant, golfer), followed))
    return found


def _require_destination(name: str, folder: Path) -> None:
    """Refuse a name that is no file's, or a folder that does not exist."""
    if not _NAME.fullmatch(name):
        action = "Give --name a name of these characters."
        raise BenchError("--name", name[:60], "letters, digits, blanks, dots, dashes; no dash first", action)
    if not folder.is_dir():
        raise BenchError("--output", str(folder), "a folder that exists", "Make the folder, or name another.")


def _events(text: str | None) -> dict[str, float]:
    found: dict[str, float] = {}
    for part in text.split(",") if text else ():
        key, _, value = (word.strip() for word in part.partition("="))
        try:
            found[{"top": "top", "impact": "impact"}[key]] = read_number(value)
        except (KeyError, ValueError):
            action = "Give the times in seconds, as --events top=0.8,impact=1.1."
            raise BenchError("--events", part[:40], "top=S, impact=S or both", action) from None
    return found


# Tables ----------------------------------------------------------------------------------------------


def import_report(found: Mapping[str, Any], roles: Roles, beyond: Sequence[float]) -> Iterator[Table | str]:
    """Yield the tables and lines of an import; `found` is its summary."""
    yield f"Recording: {found['frames']} frames at {found['rate_hz']:g} Hz"
    yield f"  unit      {found['unit']}"
    yield f"  up        {found['up']}"
    yield f"  lead      {found['lead']}, {found['lead_clue']}"
    yield f"  impact    {found['impact_s']:.3f} s, by {found['impact_clue']}"
    turn = "" if found["club_top_s"] is None else f"; the shaft turns back at {found['club_top_s']:.3f} s"
    yield f"  top       {found['top_s']:.3f} s, by {found['top_clue']}{turn}"
    yield f"  downswing {found['downswing_s']:.3f} s"
    yield f"  plane     {found['plane_deg']:.1f}° from the ground"
    gaps = ", ".join(f"{role} {count}" for role, count in found["gaps_filled"].items() if count)
    yield f"  gaps      {f'{gaps} frames filled' if gaps else 'none'}"
    if roles.dropped:
        yield f"  left out  {', '.join(roles.dropped)}: missing in too many frames"
    yield _angles(found)
    if found["max_cock_deg"] is not None:
        yield f"Largest cock of the wrist {found['max_cock_deg']:.0f}°"
    head = found["head_speed_mps"]
    speed = "" if head is None else f"head {head:.1f} m/s, "
    hands, peak = found["hand_speed_mps"], found["peak_hand_speed_mps"]
    yield f"At the ball: {speed}hands {hands:.1f} m/s (peak {peak:.1f})"
    if found["x_factor_top_deg"] is not None:
        at_top, most = found["x_factor_top_deg"], found["x_factor_max_deg"]
        yield f"X-factor: {at_top:.0f}° at the top, {most:.0f}° at most"
    off = ", ".join(
        f"{role.replace('_', ' ')} {value:.0f}" for role, value in found["off_plane_rms_mm"].items()
    )
    x, y = found["hub_travel_mm"]
    yield f"A planar robot cannot show: {off} mm off the plane (rms); shoulders travel {x:.0f} by {y:.0f} mm"
    yield beyond_text(beyond)
    if found["not_measured"]:
        yield f"Not measured: {'; '.join(found['not_measured'])}"


def _angles(found: Mapping[str, Any]) -> Table:
    figures = ("top, °", "ball, °", "peak, rad/s")
    table = plain_table("joint", *figures, right=figures)
    columns = [found[key] for key in ("theta_top_deg", "theta_ball_deg", "peak_joint_speed_rad_per_s")]
    for joint, name in enumerate(_JOINTS):
        cells = [column[joint] for column in columns]
        table.add_row(name, *("not measured" if cell is None else f"{cell:.1f}" for cell in cells))
    return table


def beyond_text(excess: Sequence[float]) -> str:
    """Return the text of the excess beyond the ranges of shoulder (rad), right arm (m) and wrist (rad)."""
    parts = zip(("shoulder", "right arm", "wrist"), excess, ("rad", "m", "rad"), strict=True)
    out = [f"{name} {value:.2f} {unit}" for name, value, unit in parts if value >= 0.005]
    return f"Beyond the machine's ranges: {', '.join(out) if out else 'nothing that was measured'}"


def comparison_table(rows: Sequence[MotionDeviation]) -> Table:
    """Return a table with a row per deviation: per cent with degrees or mm, speeds and downswings."""
    from bench.golfer.comparison import DEFINITION, HUNT_WIENS, deviation_texts

    caption = (
        f"{DEFINITION}; angles in °, head in mm. Hunt and Wiens report {100 * HUNT_WIENS:.1f} % undefined."
    )
    figures = ("shoulder", "arm", "wrist", "head", "m/s", "downswing, s")
    table = plain_table("reference", "swing", *figures, right=figures, caption=caption)
    table.caption_justify = "left"
    for row in rows:
        cells = deviation_texts(row.share, row.error)
        pair = (row.reference, row.other)
        speeds = " ".join("-" if isnan(one.head_speed) else f"{one.head_speed:.1f}" for one in pair)
        lasting = " ".join(f"{one.downswing:.3f}" for one in pair)
        table.add_row(*(escape(f"{one.name}, {one.source}") for one in pair), *cells, speeds, lasting)
    return table
