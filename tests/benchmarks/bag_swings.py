"""The shipped swings of driver and bag: delivered against demanded, launch beside the tours' averages.

`--picture FILE` also draws launch, spin, carry and descent: the tours' 23 averages, the model of impact and
flight from the tours' deliveries, and the robot's swings.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from math import degrees
from pathlib import Path

import matplotlib as mpl

from bench.config import load_configuration
from bench.shot.plot_style import COLOURS, STYLE, styled
from bench.simulation.simulated_bench import SwingResult, simulate_swing
from sim.flight import Flight, Launch, fly
from sim.impact import delivery_from_angles, strike
from sim.robot import Club
from tests.bench.design.bag_demands import ALL_DEMANDS, mounted
from tests.benchmarks.row import Row
from tests.benchmarks.whole_table import print_whole
from tests.sim.tour_averages import BALL, MPH, RPM, FlownAverage, club_of, flown_averages

NAME = "bag_swings"
YARD = 0.9144
CLUBS = ("Driver", "3-wood", "5-wood", "Hybrid", *(f"{number}-iron" for number in range(3, 10)), "PW")
"""The tours' clubs from long to short."""
PANELS = ("launch (deg)", "spin (rpm)", "carry (yd)", "descent (deg)")


def _figures(launch: Launch, flight: Flight) -> tuple[float, ...]:
    """Return launch (deg), spin (rpm), carry (yd), descent (deg)."""
    return (
        degrees(launch.launch_angle),
        launch.spin / RPM,
        flight.carry / YARD,
        degrees(flight.landing_angle),
    )


def _published(flown: FlownAverage) -> tuple[float, ...]:
    """Return the same of a tour's average."""
    a = flown.average
    return degrees(a.launch), a.spin / RPM, flown.carry / YARD, degrees(flown.landing_angle)


def _modelled(flown: FlownAverage, bag: Mapping[str, Club]) -> tuple[float, ...]:
    """Return the same of the model of impact and flight, from the tour's delivery."""
    a = flown.average
    delivery = delivery_from_angles(a.speed, a.attack, 0.0, 0.0, a.loft)
    launch = strike(delivery, club_of(a.club, bag), BALL)
    return _figures(launch, fly(launch, ball=BALL))


_TITLE = "delivered (demanded); launched (LPGA Tour's average)"
_COLUMNS = (
    "swing",
    "m/s",
    "attack",
    "strike, mm",
    "loft",
    "ball, mph",
    "launch",
    "rpm",
    "carry",
    "descent",
)


def _shown(name: str, result: SwingResult, tour: FlownAverage | None) -> tuple[str, ...]:
    """Return the row of a swing: demanded and delivered, launched beside the `tour`'s average."""
    delivery, launch, flight, demand = result.delivery, result.launch, result.flight, ALL_DEMANDS[name]
    if delivery is None or launch is None or flight is None:
        return name, result.reason
    beside: tuple[str, ...] = ("",) * 5
    if tour is not None:
        values = zip((1, 0, 0, 0), _published(tour), strict=True)
        beside = (
            f" ({tour.average.ball_speed / MPH:.0f})",
            *(f" ({value:.{places}f})" for places, value in values),
        )
    figures = zip((1, 0, 0, 0), _figures(launch, flight), beside[1:], strict=True)
    return (
        name,
        f"{delivery.speed:.2f} ({demand.speed:g})",
        f"{degrees(delivery.attack_angle):+.2f} ({demand.attack:+g})",
        f"{1e3 * delivery.in_plane_error:+.2f}",
        f"{degrees(delivery.dynamic_loft):.1f}",
        f"{launch.speed / MPH:.0f}{beside[0]}",
        *(f"{value:.{places}f}{text}" for places, value, text in figures),
    )


def _draw(swings: Mapping[str, SwingResult], bag: Mapping[str, Club], file: Path) -> None:
    flown = flown_averages()
    with mpl.rc_context(STYLE):
        figure = styled(6.4)
        for panel, title in enumerate(PANELS):
            axes = figure.add_subplot(2, 2, panel + 1)
            for colour, tour in zip(COLOURS, ("PGA", "LPGA"), strict=False):
                rows = [row for row in flown if row.average.group == tour]
                places = [CLUBS.index(row.average.club) for row in rows]
                model = [_modelled(row, bag)[panel] for row in rows]
                axes.plot(places, model, color=colour, label=f"{tour}'s delivery, model")
                averages = [_published(row)[panel] for row in rows]
                axes.plot(places, averages, "o", color=colour, markersize=4, label=f"{tour}, average")
            mine = [
                (CLUBS.index(ALL_DEMANDS[name].average), _figures(result.launch, result.flight)[panel])
                for name, result in swings.items()
                if ALL_DEMANDS[name].average and result.launch is not None and result.flight is not None
            ]
            axes.plot(*zip(*mine, strict=True), "x", color=COLOURS[2], label="robot's swing, simulated")
            axes.set_xticks(range(len(CLUBS)), CLUBS, rotation=60)
            axes.set_title(title)
        figure.axes[0].legend(fontsize=7)
        figure.savefig(file, dpi=130)


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Print the table and return the largest deviations from the demands."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="also draw it: .png, .svg or .pdf")
    given = parser.parse_args(arguments)
    swings = {name: simulate_swing(mounted(name)) for name in ALL_DEMANDS}
    averages = {row.average.club: row for row in flown_averages() if row.average.group == "LPGA"}
    rows = (_shown(name, result, averages.get(ALL_DEMANDS[name].average)) for name, result in swings.items())
    print_whole(_TITLE, _COLUMNS, rows)
    if given.picture:
        _draw(swings, load_configuration(Path("bag")).clubs, given.picture)
    found = [(result.delivery, ALL_DEMANDS[name]) for name, result in swings.items()]
    delivered = [(delivery, demand) for delivery, demand in found if delivery is not None]
    launched = [
        degrees(abs(result.launch.launch_angle - averages[ALL_DEMANDS[name].average].average.launch))
        for name, result in swings.items()
        if ALL_DEMANDS[name].average and result.launch is not None
    ]
    off = {
        "speed": max(100 * abs(one.speed / demand.speed - 1) for one, demand in delivered),
        "attack": max(abs(degrees(one.attack_angle) - demand.attack) for one, demand in delivered),
        "strike": max(1e3 * abs(one.in_plane_error) for one, _ in delivered),
    }
    return [
        Row(
            NAME,
            "swings that struck their ball",
            len(delivered),
            "",
            f"of {len(ALL_DEMANDS)}",
            at_least=len(ALL_DEMANDS),
        ),
        Row(NAME, "speed off its demand, at most", off["speed"], "%", at_most=0.2),
        Row(NAME, "attack off its demand, at most", off["attack"], "deg", at_most=0.1),
        Row(NAME, "strike off the face's centre, at most", off["strike"], "mm", at_most=0.5),
        Row(NAME, "launch off the LPGA Tour's average, at most", max(launched), "deg"),
    ]
