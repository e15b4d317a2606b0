"""`golfbench check`: summary of the checks, with all mistakes at once."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.commands.common.output import plain_table
from bench.commands.common.session import Session
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.config.text import configuration_text
from bench.design.static_checks import Check
from bench.supervisor.readiness import assess_bench


def check_all(session: Session, name: str | None, console: Console) -> None:
    """Print the readiness of the bench for profile `name` (None: the configuration's), the verdict last.

    Raises:
        BenchError: configuration or profile cannot be read.
        ExceptionGroup: BenchErrors, one for each reason that blocks arming.
    """
    configuration, now = session.configuration(), datetime.now(UTC)
    console.print(_summary(configuration), highlight=False)
    found = assess_bench(configuration, now, name, running=True)
    calibration = found.calibration
    console.print(f"calibration of bench {calibration.bench}: {calibration.summary()}", highlight=False)
    console.print(
        f"swing {found.file}: readable, {len(found.profile.angle)} samples, all finite and in range",
        highlight=False,
    )
    if found.limits:
        console.print(f"limits of the model-based check: {found.limits}", highlight=False, soft_wrap=True)
    for warning in found.warnings:
        console.print(f"warning: {warning}", style="yellow", highlight=False, soft_wrap=True)
    console.print(_table(found.checks))
    if blocks := [*found.faults, *calibration.problems(now)]:
        reasons = f"{len(blocks)} reason{'s' * (len(blocks) > 1)}"
        console.print(f"Arming blocked for {reasons}: this bench does not swing.", style="red")
        raise ExceptionGroup(f"{found.file} cannot be swung here", blocks)
    if count := len(found.warnings):
        warned = f"{count} warning{'s' * (count > 1)}"
        console.print(f"Nothing blocks arming; {warned}, see above.", style="yellow")
    else:
        console.print("Everything holds: this swing may be tried on this bench.", style="green")


def shipped_text() -> str:
    """Return the shipped configuration as a complete file with comments."""
    return configuration_text(load_configuration(shipped_configuration()))


def _summary(c: Configuration) -> str:
    files = " over ".join(str(file) for file in reversed(c.files))
    return (
        f"configuration {files}: every key known and in its physical range\n"
        f"  bench {c.bench.id}, driver {c.driver.name}, loop {c.loop.rate:g} Hz, real time {c.loop.realtime}"
        f", records in {c.bench.data_dir}\n"
        f"  clubs {', '.join(c.clubs)}; balls {', '.join(c.balls)}; "
        f"mounted: {c.swing.club} and {c.swing.ball}"
    )


def _table(checks: Sequence[Check]) -> Table:
    table = plain_table("", "checked", "found", "allowed")
    for check in checks:
        mark = Text("wrong", "bold red") if check.faults else Text("ok", "green")
        table.add_row(mark, *map(Text, (check.name, check.found, check.allowed)))
    return table
