"""Plausibility checks of measured values before they are stored."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from math import hypot

from bench.calibration.calibration import Calibration, Entry, apply
from bench.calibration.values import KINDS, BallPosition, ClubInMount, Values
from bench.config import Configuration, contradictions
from bench.errors import BenchError

_BALL_MOVED, _CLUB_MOVED = 0.15, 0.05
"""m from the configured place or length beyond which a measurement is a mistake: a tee has been moved by
hand's breadths, a club slips in its mount by centimetres."""


def require_plausible(values: Values, configuration: Configuration) -> None:
    """Check `values` against the `configuration` they are to correct.

    Raises:
        BenchError: they belong to another part, or are too far from the configured values.
        ExceptionGroup: of BenchErrors: with them the configuration would be inconsistent.
    """
    if isinstance(values, ClubInMount) and values.club not in configuration.clubs:
        place, expected = "calibrate club", f"one of {', '.join(configuration.clubs)}"
        raise BenchError(place, f'"{values.club}"', expected, "Choose one, or add it under [clubs] first.")
    kind = next(kind for kind, of_kind in KINDS.items() if isinstance(values, of_kind))
    begin = datetime(2000, 1, 1, tzinfo=UTC)
    entry = Entry(0, configuration.bench.id, kind, 1, begin, begin + timedelta(days=1), "", "", "", values)
    club = configuration.swing.club
    corrected = apply(Calibration(configuration.bench.id, club, begin, (entry,)), configuration)
    match values:
        case BallPosition(x, y):
            site = configuration.plant.site
            _require_near(
                f"calibrate {kind}", "plant.site", hypot(x - site.ball_x, y - site.ball_y), _BALL_MOVED
            )
        case ClubInMount(name, length):
            moved = abs(length - configuration.clubs[name].length_to_face)
            _require_near(f"calibrate {kind} {name}", f"clubs.{name}.length_to_face", moved, _CLUB_MOVED)
    if faults := contradictions(corrected):
        raise ExceptionGroup(f"calibrate {kind}: invalid for this bench", faults)


def _require_near(place: str, key: str, distance: float, most: float) -> None:
    if distance > most:
        cure = "Measure again; if the machine was rebuilt, correct the configuration first."
        raise BenchError(place, f"{distance:.3f} m from what {key} says", f"{most:g} m at most", cure)
