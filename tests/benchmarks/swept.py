"""Sweeps of the benchmarks: on several processes or a cluster, with a bar of progress."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from typing import TypeVar

from bench.commands.common import progress_bar, sweep_engine
from bench.config import Configuration, load_configuration, shipped_configuration
from bench.simulation.sweep import Study, SweepStore, sweep
from bench.swing.library import find_profile

Case = TypeVar("Case")
Result = TypeVar("Result")


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the engine."""
    parser.add_argument("--processes", type=int, default=0, help="Number; 0: one per core.")
    parser.add_argument("--cluster", default="", metavar="ADDRESS", help="Scheduler that runs it instead.")


def add_machine_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose machine, swing, check by the model, first seed and engine."""
    parser.add_argument("--configuration", default="", help="Name or path; else the shipped one.")
    parser.add_argument("--profile", default="", help="Name or path; else the configuration's.")
    parser.add_argument("--check", choices=("always", "off"), default="always", help="By the model.")
    parser.add_argument("--first", type=int, default=0, help="Seed of the first.")
    add_engine_options(parser)


def machine_of(options: argparse.Namespace) -> tuple[Configuration, Path]:
    """Return the configuration and the file of the profile that `add_machine_options` chose."""
    c = load_configuration(Path(options.configuration) if options.configuration else shipped_configuration())
    return c, find_profile(options.profile or c.swing.profile)


def swept(
    options: argparse.Namespace,
    study: Study[Case, Result],
    cases: Sequence[Case],
    what: str,
    configuration: Configuration | None = None,
    group: Callable[[Case], Hashable] = lambda case: None,
    store: SweepStore[Result] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Result]:
    """Return what `study` makes of `cases`, on the engine of `options`; those so far on `stop`."""
    c = configuration or load_configuration()
    with sweep_engine(c, options.processes, options.cluster, len(cases)) as engine, progress_bar() as bar:
        task = bar.add_task(what, total=len(cases))

        def show(done: int) -> None:
            bar.update(task, completed=done)

        return sweep(study, cases, engine, store=store, group=group, progress=show, stop=stop)
