"""Response of the modelled swing to corrections: finite differences on plant and controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bench.errors import BenchError
from bench.learning.delivery import figures_of
from bench.lifecycle import CAUSE_TEXT
from bench.simulation.series import Bench, Series, SeriesSwing, quiet
from bench.swing.correction import Basis
from sim.plant import PlantParameters

Array = NDArray[np.float64]

PATH_SPACING = 0.005
"""Time between the instants of the downswing at which the path is compared, s."""
_STEP = 0.1
"""Step of a weight."""
_AFTER = 0.03
"""Time after the planned contact for which a swing is followed, s."""


class Response(NamedTuple):
    """The model's swing with one correction, and its derivatives by the basis' weights."""

    figures: Array
    """(4,) as in `Figures`."""
    path: Array
    """(r, 3) rad, angles at `rows`."""
    rows: NDArray[np.int64]
    """Samples of the profile."""
    by_figures: Array
    """(4, m)"""
    by_path: Array
    """(3 r, m) rad"""
    free: Array
    """(k, 3) rad, the plant's angles tick by tick without correction and without a ball, past the contact."""


def path_rows(bench: Bench) -> NDArray[np.int64]:
    """Return the samples of the downswing, up to the impact window, at which paths are compared."""
    profile = bench.profile
    return np.arange(profile.begins[3], profile.begins[5], round(PATH_SPACING / profile.period))


class Model:
    """The bench's model, ready to swing with any correction from the same instant."""

    def __init__(self, bench: Bench, basis: Basis, plant: PlantParameters | None = None) -> None:
        """Arm the model, or another `plant`; Refused if it does not reach its address."""
        self._bench, self._basis = bench, basis
        self._series = Series(bench, quiet(plant or bench.model))
        self._series.settle()
        profile = bench.profile
        self._ticks = min(round((profile.impact_time + _AFTER) / profile.period), len(profile.angle))
        self.rows = path_rows(bench)

    def swing(self, point: Array) -> SeriesSwing:
        """Swing with the correction `point` (m,)."""
        corrected = self._basis.correction(point).applied_to(self._bench.profile)
        return self._series.swing_again(corrected, self._ticks)

    def free(self) -> Array:
        """Swing without correction and without a ball; return the angles (k, 3) tick by tick, rad."""
        swing = self._series.swing_again(self._bench.profile, self._ticks, ball=False)
        return np.array(swing.cycles["plant_angle"])

    def response(
        self, point: Array | None = None, progress: Callable[[float], None] = lambda part: None
    ) -> Response:
        """Return the response at `point` (default: no correction).

        Raises:
            BenchError: the modelled swing is stopped or misses the ball.
        """
        m = self._basis.size
        point = np.zeros(m) if point is None else point
        swing = self.swing(point)
        if swing.cause or swing.delivery is None:
            found = CAUSE_TEXT[swing.cause] if swing.cause else "the club misses the ball"
            place, wanted = f"{self._bench.profile.name} on the model", "a swing that strikes the ball"
            raise BenchError(place, found, wanted, "Identify the plant, or design a new swing.")
        figures, path = self._seen(swing)
        free = self.free()
        by_figures, by_path = np.zeros((4, m)), np.zeros((path.size, m))
        for i in range(m):
            sides = []
            for step in (_STEP, -_STEP):
                trial = point.copy()
                trial[i] += step
                varied = self.swing(trial)
                if varied.delivery is not None and not varied.cause:
                    sides.append((step, *self._seen(varied)))
            if len(sides) < 2:
                sides.append((0.0, figures, path))
            if len(sides) == 2:  # else: the weight only fails the swing and stays unused
                width = sides[0][0] - sides[1][0]
                by_figures[:, i] = (sides[0][1] - sides[1][1]) / width
                by_path[:, i] = ((sides[0][2] - sides[1][2]) / width).ravel()
            progress((i + 1) / m)
        return Response(figures, path, self.rows, by_figures, by_path, free)

    def _seen(self, swing: SeriesSwing) -> tuple[Array, Array]:
        return figures_of(swing.delivery).array, swing.cycles["angle"][self.rows]
