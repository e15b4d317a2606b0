"""Limits of the model-based check for one profile, plant and controller, from swings of drawn robots.

Per comparison, row and joint a limit is the largest of: the deviation that one swing in a million exceeds, by
a Gumbel distribution of the swings' maxima; a quarter more than the largest seen, as rare impacts do not
follow this distribution; and a floor, below which real sensors and encoders deviate without a fault.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from bench.base.errors import Refused
from bench.base.lifecycle import CAUSE_TEXT, Cause
from bench.control.estimate.residual_monitor import KINDS, LEARNING
from bench.control.measured_plant import measured_as
from bench.control.residual_thresholds import (
    FROM_SETTINGS,
    REQUIRED,
    LimitsFingerprint,
    LimitTables,
    ModelLimits,
)
from bench.control.settings import MODEL_ROWS, ModelSettings, Triple, with_tables_of
from bench.control.step_records import ControlParameters
from bench.simulation.plant_variation import HealthyRun, healthy_plant, healthy_run, unknown_plant
from bench.simulation.simulated_bench import Bench
from bench.simulation.sweep import Engine, InProcess, Study, sweep
from bench.swing.correction import basis_of

Array = NDArray[np.float64]

DRAWS = 300
"""Number of known robots; half as many for the limits of learning, which are wide already."""
FIRST_SEED = 1_000_000
"""Seed of the first robot: no test of healthy swings comes there."""
EXCEEDED = 1e-6
"""Probability that a healthy swing exceeds one limit."""
MARGIN = 1.25
"""Times the largest deviation seen."""
FLOORS: dict[str, Triple] = {
    "air": (1.0e4, 1.0e4, 1.0e4),
    "flow": (1.0e3, 1.0e3, 1.0e3),
    "velocity": (0.8, 0.8, 1.0),
    "jump": (0.001, 0.001, 0.001),
    "effort": (15.0, 30.0, 8.0),
}
"""Min limits: one per cent of a pressure sensor's range, a tenth of that where it is smoothed, the encoders'
eccentricity, friction within its tolerance."""
_AT_SPEED = frozenset({"downswing", "committed", "impact", "follow_through"})
"""Phases in which a valve that does not obey must be found within milliseconds."""
MAX_STOPPED = 0.2
"""Max fraction of fault-free robots that the envelope stops before the profile counts as unfit for the
controller."""
_MIN_SWINGS = 20
"""Swings that must have come to a row for a distribution of its maxima."""
_EULER = 0.5772156649
_MAX_CORRECTION = 1.5
"""Longest correction drawn, the norm of its weights: learning's longest first step."""

_DESIGNED_FOR = "Choose the configuration that the profile was designed for, such as `--config bag`."
_DEEPER = (
    "Design a flatter swing (golfbench profile design --attack), or give its site a deeper `divot` in the "
    "configuration."
)


def gumbel_quantile(maxima: Array) -> Array:
    """Return the value the next maximum exceeds with probability EXCEEDED, by column of `maxima` (n, k)."""
    scale = maxima.std(axis=0, ddof=1) * sqrt(6.0) / pi
    quantile: Array = maxima.mean(axis=0) + scale * (-log(-log(1.0 - EXCEEDED)) - _EULER)
    return quantile


def make_limits(
    bench: Bench,
    draws: int = DRAWS,
    progress: Callable[[float], None] = lambda part: None,
    engine: Engine | None = None,
) -> ModelLimits:
    """Return the limits of `bench` from `draws` known robots around its model, half as many to learn on.

    They swing on `engine`, by default in this process.

    Raises:
        Refused: robots without a fault are stopped by the envelope.
    """
    engine = engine or InProcess()
    runs = _drawn(DrawnRobots(bench), draws, engine, lambda part: progress(part / 1.5))
    causes = [run.cause for run in runs if run.cause]
    if len(runs) < draws or len(causes) > MAX_STOPPED * draws:
        (cause, _), *_ = Counter(causes).most_common(1) or [(Cause.NONE, 0)]
        why = CAUSE_TEXT[cause] if cause else "they do not reach their address"
        raise Refused(
            f"limits of profile {bench.profile.name!r}",
            f"{len(causes) + draws - len(runs)} of {draws} healthy robots stopped: {why}",
            "a profile that this controller can swing",
            _DEEPER if cause == Cause.GROUND else _DESIGNED_FOR,
        )
    known = [run.largest for run in runs]
    learning_runs = _drawn(
        DrawnRobots(bench, unknown=True), draws // 2, engine, lambda part: progress((2.0 + part) / 3.0)
    )
    tables = _tables(np.array(known), "")
    learning = _tables(np.array([run.largest for run in learning_runs]), "learning_")
    return ModelLimits(
        bench.profile.name,
        draws,
        LimitsFingerprint.of(bench.profile, bench.plant, bench.control, bench.envelope, bench.estimator),
        {kind: {**tables[kind], **learning[kind]} for kind in KINDS},
    )


@dataclass(frozen=True)
class DrawnRobots:
    """Swings of robots around what could have been measured as the model, by seed."""

    bench: Bench
    unknown: bool = False
    """Whether they are unmeasured robots, each with its own drawn correction; else robots within the
    tolerances."""

    def prepared(self) -> Callable[[int], HealthyRun | None]:
        """Return the function of a seed; None for a robot that does not reach its address."""
        bench, drawn = self.bench, unknown_plant if self.unknown else healthy_plant
        parameters = replace(bench, envelope=bench.envelope.with_model_check("always")).controller()
        for kind in KINDS:  # its check only observes
            parameters.model[kind] = np.inf

        def run(seed: int) -> HealthyRun | None:
            swung = _with_drawn_correction(bench, parameters, seed) if self.unknown else parameters
            like = measured_as(bench.plant, bench.envelope.model.standard_errors, seed)
            return healthy_run(drawn(like, seed), swung, bench.profile, seed)

        return run


def _drawn(
    study: Study[int, HealthyRun | None], draws: int, engine: Engine, progress: Callable[[float], None]
) -> list[HealthyRun]:
    """Return the runs of `draws` robots that reach their address; at most a third more are sampled."""
    runs = list[HealthyRun]()
    seed, last = FIRST_SEED, FIRST_SEED + draws + draws // 3
    while len(runs) < draws and seed < last:
        seeds = range(seed, min(seed + draws - len(runs), last))
        seed, had = seeds.stop, len(runs)

        def report(done: int, had: int = had) -> None:
            progress((had + done) / draws)

        runs += [run for run in sweep(study, seeds, engine, progress=report) if run is not None]
    return runs


def _with_drawn_correction(bench: Bench, parameters: ControlParameters, seed: int) -> ControlParameters:
    """Return `parameters` with the tables of a correction in a random direction, drawn with `seed`."""
    random, basis = np.random.default_rng([seed, 3]), basis_of(bench.profile)
    weights = random.standard_normal(basis.size)
    weights *= _MAX_CORRECTION * random.uniform() / np.linalg.norm(weights)
    return with_tables_of(
        parameters, basis.corrected(bench.profile, weights.tolist()), bench.control, bench.plant
    )


def _tables(largest: Array, prefix: str) -> LimitTables:
    """Return the limits from maxima `largest` (n, 5, LEARNING, 3), rows named with `prefix`."""
    tables: dict[str, dict[str, Triple]] = {}
    rows = {name: row for name, row in MODEL_ROWS.items() if row < LEARNING and name not in FROM_SETTINGS}
    for k, kind in enumerate(KINDS):
        found = {
            name: _limit(largest[:, k, row], floor_of(kind, f"{prefix}{name}")) for name, row in rows.items()
        }
        seen = [limit for limit in found.values() if limit is not None]
        # Where hardly a swing came to: the widest limits of all rows.
        widest = np.max(seen, axis=0) if seen else np.array(FLOORS[kind])
        tables[kind] = {
            prefix + name: _rounded(widest if limit is None else limit)
            for name, limit in found.items()
            if limit is not None or name in REQUIRED or name == "blow"
        }
    return tables


def floor_of(kind: str, row: str) -> Triple:
    """Return the lower bounds of the limits in a row of a table.

    A robot to learn on may have valves and lengths that no draw has: dead bands wider by 0.012, centres off
    by 0.008, spools slower by a fifth, lengths off by 1.5 mm, encoders later by 0.6 ms. The default tables
    leave room for that; at speed they would find a valve that does not obey later, and are not needed.
    """
    name = row.removeprefix("learning_")
    if name == row or (kind in ("air", "velocity") and name in _AT_SPEED):
        return FLOORS[kind]
    a, b, c = np.maximum(FLOORS[kind], getattr(ModelSettings(), kind).get(name, 0.0)).tolist()
    return a, b, c


def _limit(maxima: Array, floor: Triple) -> Array | None:
    """Return the limits (3,) from `maxima` (n, 3) of the swings; None if too few came to the row."""
    came = maxima[maxima.max(axis=1) > 0.0]
    if len(came) < _MIN_SWINGS:
        return None
    bounds: Array = np.maximum.reduce([gumbel_quantile(came), MARGIN * came.max(axis=0), np.array(floor)])
    return bounds


def _rounded(limits: Array) -> Triple:
    """Return `limits` rounded up to three digits."""
    digits = 10.0 ** (np.floor(np.log10(limits)) - 2)
    a, b, c = (float(f"{v:.3g}") for v in np.ceil(limits / digits - 1e-9) * digits)
    return a, b, c
