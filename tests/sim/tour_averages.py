"""Published averages of impacts, and the launches that the model of impact gives for them.

Tour averages: TrackMan, 2023, 23 rows of club speed, attack angle, ball speed, launch and spin. They do not
state the dynamic loft. It follows from angular momentum alone: a ball of spin w leaves the face with the
speed 0.4 r w along it, so that loft = launch + asin(0.4 r w / ball speed). So ball speed and spin are tested,
and of the launch only the part below the face's normal. Rows of drivers and 6-irons with a published loft
test all three. Every other row, beginning with the first, is fitted; the rest is held out.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import asin, degrees, pi, radians
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from sim.ball import Ball
from sim.impact import strike
from sim.robot import Club
from tests.sim.deliveries import delivery_from_angles

MPH, RPM = 0.44704, pi / 30
BALL = Ball()
DATA = Path(__file__).parent / "data"
ODD_ROW = ("LPGA", "3-wood")
"""A row whose spin, 2595 rpm, is far below the neighbouring rows' (driver 2506, 5-wood 4320 rpm)."""
ROTATION = radians(0.5)
"""Loft that a head at 40 rad/s gains until maximum compression (0.22 ms), where TrackMan states it."""

SEVEN_GRAMS = 0.007
_IRONS = {
    "3-iron": -2,
    "4-iron": -1,
    "5-iron": 0,
    "6-iron": 1,
    "7-iron": 2,
    "8-iron": 3,
    "9-iron": 4,
    "PW": 5,
}


@dataclass(frozen=True)
class Average:
    """A published average, SI and rad; `loft` is dynamic, at first contact."""

    group: str
    club: str
    speed: float
    attack: float
    loft: float
    ball_speed: float
    launch: float
    spin: float
    held_out: bool

    @property
    def name(self) -> str:
        """Group and club."""
        return f"{self.group} {self.club}"


@dataclass(frozen=True)
class Error:
    """Model less published: ball speed and spin as shares, launch in degrees."""

    ball_speed: float
    launch: float
    spin: float


def _average(row: Mapping[str, str], group: str, held_out: bool) -> Average:
    ball_speed, spin = float(row["ball_speed_mph"]) * MPH, float(row["spin_rpm"]) * RPM
    launch = radians(float(row["launch_angle_deg"]))
    if "dynamic_loft_deg" in row:
        loft = radians(float(row["dynamic_loft_deg"])) - ROTATION
    else:
        loft = launch + asin(BALL.inertia_factor * BALL.radius * spin / ball_speed)
    return Average(
        group,
        row["club"],
        float(row["club_speed_mph"]) * MPH,
        radians(float(row["attack_angle_deg"])),
        loft,
        ball_speed,
        launch,
        spin,
        held_out,
    )


def _rows(name: str) -> list[dict[str, str]]:
    with (DATA / name).open(newline="") as file:
        return list(csv.DictReader(file))


def tour_averages() -> list[Average]:
    """Return the 23 rows; 12 are fitted, 11 held out."""
    return [
        _average(r, r["tour"], held_out=i % 2 == 1) for i, r in enumerate(_rows("tour_averages_2023.csv"))
    ]


def lofted_averages() -> list[Average]:
    """Return 13 rows with a published dynamic loft, tours and amateurs; none is fitted for its loft."""
    return [_average(r, r["group"], held_out=True) for r in _rows("driver_averages.csv")]


def club_of(name: str, bag: Mapping[str, Club]) -> Club:
    """Return the club of a row: the bag's, or one between with the head mass of its number."""
    if name == "Driver":
        return bag["wood1"]
    if name in {"3-wood", "5-wood"}:
        return replace(bag["wood3"], head_mass=bag["wood3"].head_mass + SEVEN_GRAMS * (name == "5-wood"))
    if name == "Hybrid":
        return bag["hybrid"]
    number = _IRONS[name]
    nearest = bag["iron5" if number < 2 else "iron7" if number < 4 else "iron9" if number < 5 else "pitching"]
    return replace(nearest, head_mass=bag["iron5"].head_mass + SEVEN_GRAMS * number)


def error_of(average: Average, club: Club) -> Error:
    """Return the error of the launch that a centred strike of `club` gives."""
    delivery = delivery_from_angles(average.speed, average.attack, 0.0, 0.0, average.loft)
    launch = strike(delivery, club, BALL)
    return Error(
        launch.speed / average.ball_speed - 1.0,
        degrees(launch.launch_angle - average.launch),
        launch.spin / average.spin - 1.0,
    )


def rms(errors: Sequence[Error]) -> Error:
    """Return the root mean square of `errors`."""
    values = np.array([(e.ball_speed, e.launch, e.spin) for e in errors])
    return Error(*(float(v) for v in np.sqrt(np.mean(values**2, axis=0))))


# --- Fit --------------------------------------------------------------------------------------------

RUBBER = 2.0 / 3.0
"""Mindlin's ratio 2 (1 - nu) / (2 - nu) of an incompressible ball on a rigid face."""


def stiffness_of(restitution: float, solid: float) -> float:
    """Return the ratio on a face of `restitution`, which yields without loss; `solid`: a rigid face's."""
    return RUBBER * (1.0 - solid * solid) / (1.0 - restitution * restitution)


@dataclass(frozen=True)
class Fitted:
    """The fitted values: restitution of driver, wood and hybrid, solid face; its slope; loss factor."""

    driver: float
    fairway: float
    solid: float
    slope: float
    loss: float

    def applied_to(self, name: str, club: Club) -> Club:
        """Return `club` of a row called `name` with these values."""
        fairway = name in {"3-wood", "5-wood", "Hybrid"}
        e = self.driver if name == "Driver" else self.fairway if fairway else self.solid
        return replace(
            club,
            restitution=e,
            restitution_slope=self.slope,
            tangential_stiffness=stiffness_of(e, self.solid),
            tangential_loss=self.loss,
        )


def fit(averages: Sequence[Average], bag: Mapping[str, Club]) -> Fitted:
    """Return the values that fit ball speed (to 1.5 %) and spin (to 10 %) of the rows not held out."""

    def misses(values: np.ndarray) -> list[float]:
        fitted = Fitted(*values)
        found = []
        for average in averages:
            if not average.held_out:
                club = fitted.applied_to(average.club, club_of(average.club, bag))
                error = error_of(average, club)
                found += [error.ball_speed / 0.015, error.spin / 0.10]
        return found

    bounds = ([0.5, 0.5, 0.5, -0.02, 0.0], [0.98, 0.98, 0.98, 0.02, 2.0])
    return Fitted(*least_squares(misses, [0.87, 0.83, 0.78, 0.0, 0.2], bounds=bounds, x_scale=0.05).x)
