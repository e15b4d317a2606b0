"""`golfbench run` at the command line."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Annotated

import typer

from bench.commands.common.options import flag, option
from bench.commands.common.session import Session


def run(
    context: typer.Context,
    driver: Annotated[str | None, option("Driver of the robot.", "NAME", shown="the configuration's")] = None,
    profile: Annotated[
        str | None, option("Profile to swing.", "PROFILE", shown="the configuration's")
    ] = None,
    series: Annotated[
        bool,
        flag(
            "--series",
            "After a swing hold the address for the next one, as campaigns need it; without it the "
            "bench vents.",
        ),
    ] = False,
    read_only: Annotated[
        bool, flag("--read-only", "Observe only: send nothing but the passive command.")
    ] = False,
) -> None:
    """Run the bench until Ctrl-C or SIGTERM: loop, recorder, publisher, and commands over the network.

    It starts in ESTOP. Continue in another terminal: golfbench lease take, reset, home, arm, swing.
    """
    from bench.config import contradictions, unheard_phases
    from bench.supervisor.daemon import Daemon

    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    logging.getLogger("numexpr").setLevel(logging.WARNING)  # python-can loads it with the extra `export`
    configuration = context.ensure_object(Session).configuration()
    settings = configuration.driver
    if driver is not None:
        settings = replace(settings, name=driver)
    swing = configuration.swing
    if profile is not None:
        swing = replace(swing, profile=profile)
    lifecycle = configuration.lifecycle
    if series:
        lifecycle = replace(lifecycle, hold_between_swings=True)
    configuration = replace(configuration, swing=swing, lifecycle=lifecycle).with_driver(settings)
    if mistakes := contradictions(configuration) + unheard_phases(configuration):
        raise ExceptionGroup("invalid configuration", mistakes)
    daemon = Daemon(configuration, read_only=read_only)
    daemon.run(
        lambda: logging.info("bench %s answers at %s", configuration.bench.id, configuration.network.endpoint)
    )
