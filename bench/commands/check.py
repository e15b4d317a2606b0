"""`golfbench check`: what was looked at, and every mistake at once."""

from __future__ import annotations

from datetime import UTC, datetime

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.calibration.archive import calibration_of
from bench.calibration.calibration import apply
from bench.commands.session import Session
from bench.config import Configuration, contradictions, load_configuration, shipped_configuration
from bench.config.text import configuration_text
from bench.design.validate import Check, check_profile
from bench.swing.library import find_profile
from bench.swing.profile import load_profile


def check_all(session: Session, name: str | None, console: Console) -> None:
    """Check the configuration, then profile `name` (None: the configuration's) against it; print the checks.

    Raises:
        BenchError: configuration or profile cannot be read.
        ExceptionGroup: of BenchErrors, one for each mistake.
    """
    configuration = session.configuration()
    console.print(_summary(configuration), highlight=False)
    now = datetime.now(UTC)
    calibration = calibration_of(configuration, now)
    configuration = apply(calibration, configuration)
    if faults := contradictions(configuration):
        raise ExceptionGroup("calibration and configuration contradict each other", faults)
    console.print(f"calibration of bench {calibration.bench}: {calibration.summary()}", highlight=False)
    for problem in calibration.problems(now):
        console.print(f"warning: not to be armed: {problem}", style="yellow", highlight=False, soft_wrap=True)
    path = find_profile(name or configuration.swing.profile)
    profile = load_profile(path)
    console.print(
        f"swing {path}: readable, {len(profile.angle)} samples, all finite and in range", highlight=False
    )
    if configuration.envelope.model.check != "off":
        used = configuration.limits_in_use(profile, path)
        style = "yellow" if used.stale else ""
        console.print(
            f"limits of the model-based check: {used.source}", style=style, highlight=False, soft_wrap=True
        )
    else:
        console.print(
            "warning: the model-based check is off (envelope.model.check): "
            "a valve that sticks is found tenths of a second later",
            style="yellow",
            highlight=False,
            soft_wrap=True,
        )
    checks = check_profile(profile, configuration.plant, configuration.envelope, str(path))
    console.print(_table(checks))
    if faults := [fault for check in checks for fault in check.faults]:
        raise ExceptionGroup(f"{path} cannot be swung here", faults)
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


def _table(checks: list[Check]) -> Table:
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for column in ("", "checked", "found", "allowed"):
        table.add_column(column, overflow="fold")
    for check in checks:
        mark = Text("wrong", "bold red") if check.faults else Text("ok", "green")
        table.add_row(mark, *map(Text, (check.name, check.found, check.allowed)))
    return table
