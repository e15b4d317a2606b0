"""The state of a bench as a table, 80 columns wide, once or live."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any, NoReturn

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bench.base.lifecycle import in_one
from bench.network.bench_service import (
    BenchStatus,
    CauseStatus,
    DeviceStatus,
    LaunchMonitorStatus,
)
from bench.network.client import BenchClient
from bench.network.status_words import (
    StatusCondition,
    interlock_conditions,
    launch_monitor_text,
    next_command,
    next_step,
    robot_conditions,
    shut_off_words,
    vent_words,
    warning_texts,
)
from drivers.base import ACTUATORS, JOINTS

REDRAW = 0.2
"""Period of a live status (s)."""

SILENT = 1.0
"""Time without a state after which the bench counts as silent (s); it publishes every 0.2 s."""

_STALLS = {
    "preemption": "other programs",
    "page_fault": "page faults",
    "long_tick": "the bench's own work",
    "machine": "the machine",
}
_STYLES = {
    "ESTOP": "bold white on red",
    "FAULT": "bold white on red",
    "ARMED": "bold black on yellow",
    "HOMING": "bold black on yellow",
    "SWINGING": "bold black on yellow",
    "RECOVERING": "bold black on yellow",
    "READY": "bold green",
}
"""Yellow: the robot moves or may move."""


def status_table(status: BenchStatus, age: float) -> Table:
    """Return `status`, received `age` s ago, as a table."""
    silent = age > SILENT
    table = Table(
        title=_title(status, age, silent), title_justify="left", title_style="", show_header=False, width=80
    )
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    style = "dim" if silent else ""
    for name, value in _rows(status):
        table.add_row(name, value, style=style)
    return table


def watch_status(bench: BenchClient, console: Console) -> NoReturn:
    """Show the live state of `bench` on `console` until Ctrl-C.

    Raises:
        NoAnswer: the bench does not answer at the start. Later silence is shown, and its end too.
    """
    newest, heard_at = bench.status(), time.monotonic()
    with (
        Live(status_table(newest, 0.0), console=console, auto_refresh=False) as live,
        closing(bench.states(REDRAW)) as states,
    ):
        drawn_at = heard_at
        for heard in states:
            if heard is not None:
                newest, heard_at = heard, time.monotonic()
            now = time.monotonic()
            if now - drawn_at >= 0.9 * REDRAW:
                live.update(status_table(newest, now - heard_at), refresh=True)
                drawn_at = now
    raise RuntimeError("the states of a bench do not end")


def _title(status: BenchStatus, age: float, silent: bool) -> Text:
    bench, state = (f"bench {status['bench']}  ", "bold"), status["state"]
    if silent:
        return Text.assemble(
            bench, (f"SILENT: last status {age:.1f} s ago", "bold red"), f", in state {state}"
        )
    return Text.assemble(bench, (f" {state} ", _STYLES.get(state, "bold")))


def _rows(status: BenchStatus) -> list[tuple[str, Text]]:
    cause, latest, lease, loop = status["cause"], status["latest_cause"], status["lease"], status["loop"]
    moves = f"{status['phase']}, reaction {status['reaction']}"
    chambers = [_value(pressure, "{:.2f}", 1e-5) for pressure in status["chamber_pressure_pa"]]
    sides = zip(ACTUATORS, chambers[::2], chambers[1::2], strict=True)
    joints = zip(JOINTS, status["joints_deg"], strict=True)
    warnings = "\n".join(warning_texts(status))
    rows: list[tuple[str, Text | str]] = [
        ("phase", moves),
        ("next", f"{next_step(status)} {next_command(status)}"),
        ("cause", _cause(cause) if cause else "none"),
        *([("then found", _cause(latest))] if latest else []),
        ("warnings", Text(warnings, "yellow") if warnings else "none"),
        ("lease", f"{lease['holder']}, {lease['seconds_left']:.0f} s left" if lease else "not held"),
        ("robot", _flags(robot_conditions(status))),
        ("interlocks", _flags(interlock_conditions(status))),
        ("joints", ", ".join(f"{name} {_value(angle, '{:.1f}°')}" for name, angle in joints)),
        ("supply", _value(status["supply_pressure_pa"], "{:.2f}", 1e-5) + " bar absolute"),
        ("chambers A/B", ", ".join(f"{actuator} {a}/{b}" for actuator, a, b in sides) + " bar"),
        ("spools", ", ".join(_value(position, "{:+.2f}") for position in status["spool_positions"])),
        ("vents", vent_words(status["vents_open"])),
        ("shut-off valve", shut_off_words(status["shut_off_open"])),
        (
            "loop",
            f"{loop['rate_hz']:.1f} Hz, tick {status['tick']}, "
            f"skipped {loop['skipped']}, late {loop['late']}{_stalls(loop['stalls'])}\n"
            f"woken p50 {1e6 * loop['wake_p50_s']:.0f} µs, p99 {1e6 * loop['wake_p99_s']:.0f} µs; "
            f"tick p99 {1e6 * loop['tick_p99_s']:.0f} µs",
        ),
        ("device", _counters(status["device"])),
        ("real time", _real_time(status["real_time"])),
        ("processes", _processes(status)),
        ("launch monitor", _launch_monitor(status["launch_monitor"])),
        (
            "swings",
            f"{status['swings']} of {status['profile']}"
            f"{', corrected' if status['correction'] else ''}, driver {status['driver']}",
        ),
        ("club", f"{status['club']}, {'a ball' if status['ball_present'] else 'no ball'} on the tee"),
        ("commands", _pairs(dict(status["counts"]))),
    ]
    if status["last_stop"]:
        rows.append(("last stop", ", ".join(str(value) for value in status["last_stop"].values())))
    return [(name, Text(value) if isinstance(value, str) else value) for name, value in rows]


def _cause(cause: CauseStatus) -> Text:
    return Text(f"{cause['name']}: {in_one((cause['text'], cause['action']))}", "red")


def _flags(conditions: list[StatusCondition]) -> Text:
    """Return the words for `conditions`; in yellow, those not met."""
    return Text(", ").join(Text(text, "" if holds else "yellow") for text, holds in conditions)


def _processes(status: BenchStatus) -> Text:
    words = []
    for name, process in status["processes"].items():
        note = f": {process['note']}" if process["note"] else ""
        alive = process["alive"]
        words.append(Text(f"{name} {process['pid'] if alive else 'DEAD'}{note}", "" if alive else "bold red"))
    return Text(", ").join(words)


def _counters(device: DeviceStatus) -> str:
    return _pairs({name: count for name, count in device["counters"].items() if count})


def _launch_monitor(link: LaunchMonitorStatus | None) -> Text:
    """Return the connected monitors and their counts; a missing monitor and refusals are yellow."""
    if link is None:
        return Text("none configured")
    where = f"listening at {link['listening']}" if link["listening"] else "not listening"
    told = Text(f"{launch_monitor_text(link)}, {where}", "" if link["present"] else "yellow")
    if counted := ", ".join(f"{outcome} {count}" for outcome, count in link["outcomes"].items() if count):
        told.append(f"\n{counted}")
    if link["refused"]:
        told.append(f"\nrefused {link['refused']}, last: {link['refusal']}", "yellow")
    if (simulator := link["simulator"]) is not None:
        passed = f"passed on to GSPro {simulator['taken']}, refused {simulator['refused']}"
        told.append(f"\n{passed}" + (f": {simulator['fault']}" if simulator["fault"] else ""))
    return told


def _real_time(granted: Mapping[str, Any]) -> Text:
    """Return the granted real-time settings, and in yellow those not granted."""
    mode = granted.get("mode", "off")
    if mode == "off":
        return Text("off: nothing was asked of the machine")
    missing = [
        f"{setting['name']} {setting['granted']} instead of {setting['asked']}"
        for setting in granted["settings"].values()
        if not setting["held"]
    ]
    return Text.assemble(
        f"{mode}: ", (", ".join(missing), "yellow") if missing else "all that was asked is granted"
    )


def _pairs(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in values.items()) or "none"


def _value(value: float | None, form: str, scale: float = 1.0) -> str:
    return "–" if value is None else form.format(scale * value)


def _stalls(stalls: Mapping[str, int]) -> str:
    """Return why ticks were late or skipped, empty if none was."""
    found = [f"{count} by {_STALLS.get(why, why)}" for why, count in stalls.items() if count]
    return f" ({', '.join(found)})" if found else ""
