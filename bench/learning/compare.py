"""Controllers compared on one swing and one robot: what each adds to tracking and delivery, and its cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.control.settings import ControlSettings
from bench.errors import Refused
from bench.learning.figures import UNKNOWN, Figures, figures_of
from bench.learning.learn import by_encoders, learn, prepare
from bench.learning.series import Bench, Series
from bench.lifecycle import Cause
from bench.swing.profile import Profile
from sim.plant import PlantParameters

Array = NDArray[np.float64]

_NONE = (0.0, 0.0, 0.0)


class Compared(NamedTuple):
    """One controller: the mean of its swings."""

    controller: str
    figures: Figures
    """Unknown when no swing struck the ball."""
    tracking: Array
    """Root mean square of reference less true angle in the downswing, up to a stop, rad."""
    saturated: float
    """Share of the downswing in which a valve stood at its limit."""
    air: float
    """kg a swing."""
    cause: Cause
    """Of the last stop; ADDRESS_TIMEOUT when it does not come to rest at the address; else NONE."""


def compare(
    bench: Bench, plant: PlantParameters, swings: int = 3, told: Callable[[str], None] = lambda name: None
) -> list[Compared]:
    """Return PIDs alone as in the thesis, and what damping, planned openings and learning add, on `plant`.

    Each controller arms anew and swings once before its swings count. Learning starts from the whole
    controller.

    Raises:
        BenchError: the modelled swing is stopped or misses the ball.
        Refused: the whole controller does not reach its address.
    """
    whole = bench.control
    controllers: tuple[tuple[str, ControlSettings], ...] = (
        ("PID alone", replace(whole, feed_forward="none", damping=_NONE, dither=_NONE)),
        (
            "PID, acceleration damped",
            replace(whole, feed_forward="none", downswing_damping=1.0, dither=_NONE),
        ),
        ("PID, planned openings, dither", whole),
    )
    rows = []
    for name, control in controllers:
        told(name)
        try:
            series = Series(bench._replace(control=control), plant)
            rows.append(_row(name, bench.profile, bench, series, swings))
        except Refused:
            rows.append(Compared(name, UNKNOWN, np.full(3, np.nan), np.nan, np.nan, Cause.ADDRESS_TIMEOUT))
    told("learning")
    lecture, series = prepare(bench), Series(bench, plant)
    lesson = learn(lecture, series, by_encoders(lecture))
    learned = lesson.correction.applied_to(bench.profile)
    rows.append(_row(f"and {lesson.chosen} learning swings", learned, bench, series, swings))
    return rows


def _row(name: str, profile: Profile, bench: Bench, series: Series, swings: int) -> Compared:
    series.swing(profile)
    made = [series.swing(profile) for _ in range(swings)]
    figures = np.array([figures_of(swing.delivery).array for swing in made])
    errors, limit = [], bench.envelope.greatest_opening
    saturated = []
    for swing in made:
        down = swing.cycles[profile.begins[3] : profile.begins[5]]
        down = down[down["trip"] == 0]
        errors.append(down["reference_angle"] - down["plant_angle"])
        saturated.append(np.abs(down["applied_valve"]).max(axis=1) >= limit)
    struck = np.isfinite(figures).all(axis=1)
    mean = Figures(*map(float, figures[struck].mean(axis=0))) if struck.any() else figures_of(None)
    stops = [swing.cause for swing in made if swing.cause]
    return Compared(
        name,
        mean,
        np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0)),
        float(np.mean(np.concatenate(saturated))),
        float(np.mean([swing.air_used for swing in made])),
        stops[-1] if stops else Cause.NONE,
    )
