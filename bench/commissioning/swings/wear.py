"""Wear of each part, from recorded swings.

Each value that wear changes is fitted to short predictions of a swing (`_short_predictions`), all at once. So
a moved centre is not taken for a leak, nor dry friction for a slow spool. It is the recorded configuration's
value plus a change, whose prior is as wide as wear goes. The limit of a change is half to two thirds of the
one at which the model-based check stops fault-free swings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.commissioning.machine.machine import Array
from bench.commissioning.swings._short_predictions import Cycles, RecordedSwing, explained, table_rows
from bench.control.measured_plant import value_at, with_values
from bench.records.shot.plot_style import COLOURS, GREY, STYLE, styled
from bench.records.telemetry.record_file import read_swing
from bench.simulation.replay import FEW, growth_of, settings_of
from sim.plant import PlantParameters

_STEP = 0.3
"""Step of a finite difference, as a share of the prior standard deviation."""
_ROUNDS = 2
"""Linearisations at most: large changes bend their effects."""
_SMALL = 0.15
"""Changes, as shares of the prior, up to which one linearisation will do."""
_MAX_FITTED_TIME = 5.0
"""Fitted part of a record (s): a swing, or the way to a stop."""
MAX_FITTED = 40
"""Records that are fitted, evenly over all of them: 1 s each."""
_CERTAIN = 3.0
"""Standard errors by which a change has to exceed zero."""
_MIN_SHARE = 0.05
"""Least share of a configured value that a change leaves."""
_LITRES = 6e4
"""Litres a minute of a m3/s."""


class WearingValue(NamedTuple):
    """A value that wear changes."""

    part: str
    name: str
    keys: tuple[str, ...]
    """Dotted keys below [plant] that change alike; none of a chamber's sensor."""
    is_share: bool
    """Whether a change is a share of the configured value, or added to it."""
    prior: float
    """Standard deviation of the change before any record."""
    most: float
    """Change from which the part is worn; only growth counts for a leak."""
    unit: str
    scale: float
    """Units of one change."""
    action: str
    chamber: int = -1
    """Chamber whose sensor reads `change` (Pa) too much."""

    def changed(
        self, recorded: RecordedSwing, plant: PlantParameters, change: float
    ) -> tuple[RecordedSwing, PlantParameters]:
        """Return record and plant with the value changed; what cannot be negative stays above zero."""
        if self.chamber >= 0:
            return recorded.with_pressure(self.chamber, -change), plant
        values = {}
        for key in self.keys:
            value = float(value_at(plant, key))
            if self.is_share:
                values[key] = value * max(1.0 + change, _MIN_SHARE)
            else:
                values[key] = value + change if key.endswith("centre") else max(value + change, 0.0)
        return recorded, with_values(plant, values)


def wearing_values(plant: PlantParameters) -> tuple[WearingValue, ...]:
    """Return the values of `plant` that are followed, those of `causes.toml`."""
    scales = {"%": 100.0, "g": 1e3, "ms": 1e3, "bar": 1e-5, "l/min": _LITRES * plant.supply.pressure}
    return tuple(
        WearingValue(
            row["part"],
            row["name"],
            tuple(row["keys"]),
            row.get("share", False),
            row["prior"],
            row["most"],
            row["unit"],
            scales[row["unit"]],
            row["action"],
            chamber,
        )
        for row, _, chamber in table_rows("wear")
    )


class SwingWear(NamedTuple):
    """Changes of one swing."""

    values: tuple[WearingValue, ...]
    """Values that may change (p,)."""
    change: Array
    """(p,)"""
    error: Array
    """(p,) standard errors."""


def swing_wear(cycles: Cycles, metadata: Mapping[str, Any], location: str) -> SwingWear:
    """Return the changes against the configuration of a record, from its `cycles` and `metadata`.

    Raises:
        BenchError: the record has no configuration, or a chamber shows no pressure.
        ExceptionGroup: a BenchError for each value of its configuration that today's program rejects.
    """
    plant = settings_of(metadata, location)[0]["plant"]
    if not np.isfinite(cycles["chamber_pressure"]).any(axis=0).all():
        expected = "the pressure of each chamber, which separates the parts"
        raise BenchError(location, "a chamber without pressures", expected, "Fit a sensor to each chamber.")
    return fitted_wear(cycles, plant)


def fitted_wear(cycles: Cycles, plant: PlantParameters) -> SwingWear:
    """Return what changed against `plant` in the CYCLE records of a swing: in its last seconds of motion."""
    moving = np.flatnonzero(cycles["phase"] != Phase.STANDING)
    end = int(moving[-1]) + 1 if len(moving) else len(cycles)
    # Also from standing: how far the supply's soft start has come is not measured.
    used = cycles[max(end - round(_MAX_FITTED_TIME / plant.tick), 0) : end]
    recorded, values = RecordedSwing(used, plant), wearing_values(plant)
    prior, change = np.array([one.prior for one in values]), np.zeros(len(values))
    left, covariance = np.zeros(1), np.eye(len(values))
    for _ in range(_ROUNDS):
        at = recorded, plant
        for one, by in zip(values, change.tolist(), strict=True):
            at = one.changed(*at, by) if by else at
        base = at[0].errors(at[1])
        moved = [one.changed(*at, _STEP * one.prior) for one in values]
        effects = np.stack([(base - record.errors(other)) / _STEP for record, other in moved], axis=-1)
        shift, left, covariance = explained(base, effects, change / prior)
        change = change + shift * prior
        if np.abs(shift).max() <= _SMALL:
            break
    scatter = max(float(np.mean(np.square(left))), 1.0)
    return SwingWear(values, change, prior * np.sqrt(scatter * np.diag(covariance)))


def fitted_parts(files: Sequence[Path], progress: Callable[[int], None]) -> tuple[list[SwingWear], list[int]]:
    """Return the changes of the parts in records, oldest first, of `MAX_FITTED` at most, and their numbers.

    `progress` is given the number of fitted records.

    Raises:
        BenchError: a record cannot be read, has no configuration, or no pressures of the chambers.
    """
    chosen = np.unique(np.linspace(0, len(files) - 1, min(len(files), MAX_FITTED)).round().astype(int))
    swings = []
    for done, k in enumerate(chosen.tolist(), 1):
        swings.append(swing_wear(*read_swing(files[k]), str(files[k])))
        progress(done)
    return swings, (chosen + 1).tolist()


class PartWear(NamedTuple):
    """One value over the swings, oldest first, as changes against the configuration."""

    value: WearingValue
    before: float
    """Median of the first swings."""
    latest: float
    """Median of the latest swings."""
    error: float
    """Standard error of the latest."""
    growth: float
    """Growth per swing; NaN with too few swings, 0 if it may as well be none."""
    is_worn: bool
    """Whether it changed too much: since the first swings, or of few ones against the configuration."""
    left: float
    """Swings until the trend makes it worn; infinite without a trend."""


def worn_parts(swings: Sequence[SwingWear]) -> list[PartWear]:
    """Return the wear of each value over `swings` of one robot, the most worn first."""
    found = []
    changes, errors = np.array([one.change for one in swings]), np.array([one.error for one in swings])
    for k, value in enumerate(swings[0].values):
        column, latest = changes[:, k], changes[-FEW:, k]
        before, now = float(np.median(column[:FEW])), float(np.median(latest))
        apart = float(np.std(latest)) / np.sqrt(len(latest))
        error = float(np.hypot(np.median(errors[-FEW:, k]) / np.sqrt(len(latest)), apart))
        since, growth = now - before if len(column) >= 2 * FEW else now, growth_of(column)
        change = since if value.name == "leak" else abs(since)
        grows = growth * (1.0 if since > 0.0 else -1.0)
        left = max(value.most - change, 0.0) / grows if grows > 0.0 else np.inf
        is_worn = change >= max(value.most, _CERTAIN * error)
        found.append(PartWear(value, before, now, error, growth, is_worn, left))
    return sorted(found, key=lambda one: -abs(one.latest) / one.value.most)


_DRAWN = 6
"""Values in the picture: the most worn ones."""


def wear_plot(swings: Sequence[SwingWear], numbers: Sequence[int]) -> Figure:
    """Return the chart of the most worn parts over `swings` (n,), which have `numbers` (n,).

    Each has its own axes, with the bound from which it is too much.
    """
    changes, errors = np.array([one.change for one in swings]), np.array([one.error for one in swings])
    drawn = [part.value for part in worn_parts(swings)[:_DRAWN]]
    with mpl.rc_context(STYLE):
        figure = styled(1.3 * len(drawn) + 0.4)
        for axes, value in zip(figure.subplots(len(drawn), 1, sharex=True), drawn, strict=True):
            k = swings[0].values.index(value)
            bars = value.scale * changes[:, k], value.scale * errors[:, k]
            axes.errorbar(numbers, *bars, fmt=".", color=COLOURS[0], ecolor=GREY, elinewidth=0.7)
            for bound in (-value.most, value.most):
                axes.axhline(value.scale * bound, color=COLOURS[1], linewidth=0.8, linestyle="--")
            axes.set(title=f"{value.part}: {value.name}", ylabel=value.unit)
        figure.axes[-1].set_xlabel("swing")
        figure.suptitle("Change against the configuration. Dashed: worn.", fontsize=8.5)
    return figure
