"""How much a swing depends on how the robot came to its address: `... air_at_address [--swings 100]`.

One bench swings in turn in five ways, so that all ways see the same times: armed anew (disarmed, vented,
armed), held for 1 s after the swing before, held for 60 s, armed again after a stop on the way, and in a
series (as soon as the bench permits it). Each row is a way: standard deviations of strike, head speed,
shaft lean and attack angle; then the largest differences between the ways' means. Once with planned air
at the address, once with the air as it comes (`--air planned`, `--air free`: only one of them), on the
nominal robot and on the worn one (`--robot nominal`, `--robot worn`). Encoders have noise. Promised are
the third parts of learning's tolerances, with planned air.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from bench.config import Configuration, load_configuration
from bench.control.planned_air import with_planned_air
from bench.control.settings import build_controller
from bench.errors import Refused
from bench.learning.figures import figures_of
from bench.lifecycle import Request
from bench.simulation.engine import LockstepEngine
from bench.simulation.lockstep import Lockstep
from bench.simulation.swing_operator import LONGEST_RETURN
from bench.simulation.variation import WORN
from bench.swing.library import find_profile
from bench.swing.profile import Profile, load_profile
from sim.driver import hanging_pose
from sim.plant import PlantParameters, build_plant
from sim.truth import contact_in
from tests.benchmarks.row import Row

NAME = "air_at_address"
NOISE, JITTER = 1e-5, 2e-6
"""rad, s"""
_LONGEST_VENT = 25.0
"""s"""
_REST = 0.4
"""s in which the robot comes to rest at the address."""
_FIGURES = ("strike", "head speed", "shaft lean", "attack angle")
_UNITS = ("mm", "%", "deg", "deg")
_PROMISED = (0.7, 0.1, 0.1, 0.1)

Array = NDArray[np.float64]


class SwingingRobot:
    """A simulated robot that comes to its address in several ways, and swings."""

    def __init__(self, configuration: Configuration, plant: PlantParameters, profile: Profile) -> None:
        """Switch on `plant`, hanging, with the controller that `configuration` has for `profile`."""
        c = configuration
        parameters = build_controller(c.plant, profile, c.control, c.envelope, c.estimator)
        encoders = replace(plant.encoders, noise=NOISE, jitter=JITTER)
        self._plant, self._parameters = replace(plant, encoders=encoders), parameters
        self._profile, self._site, self._robot = profile, c.plant.site, c.plant.robot
        self._random = np.random.default_rng(1)
        self.switch_on()

    def switch_on(self) -> None:
        """Hang vented; arm and swing once."""
        pose = hanging_pose(self._plant)
        self._engine = LockstepEngine(Lockstep(build_plant(self._plant), self._parameters, pose))
        self._engine.advance(200)
        self._engine.arm()
        self.swing()

    def swing(self) -> Array:
        """Swing as soon as the bench permits it, and return to the address; figures (4,).

        Raises:
            Refused: the bench stopped it.
        """
        self._engine.begin_record()  # else it would keep every tick of 1,000 swings and minutes of rest
        self._begin()
        self._engine.advance(len(self._profile.angle) - 1)
        contact = contact_in(self._engine.plant_state)
        if contact is None or not self._engine.run_until(self._engine.holding, LONGEST_RETURN):
            raise self._engine.refusal(f"cause {self._engine.cause.name} in a swing")
        return figures_of(contact.delivery(self._robot, (self._site.ball_x, self._site.ball_y))).array

    def _begin(self) -> None:
        # On its way back the head passes over the ball's place, and holds before it rests.
        self._engine.advance(round(_REST / self._engine.period))
        self._engine.tee_up(ball=True)
        if not self._engine.start_swing(300, 10):
            raise self._engine.refusal(f"cause {self._engine.cause.name} at the address")

    def hold(self, seconds: float) -> Callable[[], None]:
        """Return what holds the address for so long."""
        return lambda: self._hold(seconds)

    def _hold(self, seconds: float) -> None:
        self._engine.advance(round(seconds / self._engine.period))

    def arm_anew(self) -> None:
        """Disarm, vent, and arm again."""
        self._engine.request(Request.DISARM)
        self._arm_vented()

    def stop(self) -> None:
        """Begin a swing, stop it somewhere before the ball, and arm again."""
        self._begin()
        last = int(self._profile.impact_time / self._profile.period)
        self._engine.advance(int(self._random.integers(100, last)))
        self._engine.request(Request.STOP)
        self._engine.rest()
        self._arm_vented()

    def _arm_vented(self) -> None:
        engine = self._engine
        engine.wait_for(lambda: bool(engine.control["vented"][0]), _LONGEST_VENT)
        if engine.cause and not engine.request(Request.RESET):
            raise engine.refusal(f"no reset after {engine.cause.name}")
        engine.arm()

    def ways(self) -> dict[str, Callable[[], None]]:
        """Return the ways to the address by name."""
        return {
            "armed anew": self.arm_anew,
            "held for 1 s": self.hold(1.0),
            "held for 60 s": self.hold(60.0),
            "after a stop": self.stop,
            "in a series": self.hold(0.0),
        }


class WaySwings(NamedTuple):
    """Swings of one robot with one air."""

    robot: str
    air: str
    figures: dict[str, list[Array]]
    """(4,) each, by way."""
    refused: list[str]


def run(arguments: Sequence[str] = ()) -> list[Row]:
    """Swing in all ways; return scatter and differences."""
    parser = argparse.ArgumentParser(prog=f"python -m tests.benchmarks {NAME}", description=__doc__)
    parser.add_argument("--swings", type=int, default=100, help="of each way (default: %(default)s)")
    parser.add_argument("--air", choices=("planned", "free", "both"), default="both")
    parser.add_argument("--robot", choices=("nominal", "worn", "both"), default="both")
    parser.add_argument("--configuration", default="shipped", help="Name or path (default: %(default)s).")
    parser.add_argument("--check", choices=("always", "off"), default="off", help="By the model.")
    options = parser.parse_args(arguments)
    c = load_configuration(Path(options.configuration))
    file = find_profile(c.swing.profile)
    profile = load_profile(file)
    c = replace(c, envelope=c.envelope.with_model_check(options.check)).for_profile(profile, file)
    planned = with_planned_air(profile, c.plant)
    robots = {"nominal": c.plant, "worn": WORN.applied_to(c.plant)}
    benches = [
        (robot, air, SwingingRobot(c, plant, planned if air == "planned" else profile))
        for robot, plant in robots.items()
        for air in ("planned", "free")
        if options.robot in (robot, "both") and options.air in (air, "both")
    ]
    made = [WaySwings(robot, air, {}, []) for robot, air, _ in benches]
    for round_ in track(range(options.swings), "swinging", console=Console(stderr=True), transient=True):
        for swings, (_, _, bench) in zip(made, benches, strict=True):
            ways = list(bench.ways().items())
            order = np.random.default_rng(round_).permutation(len(ways))  # each way follows each other one
            for way, come in (ways[k] for k in order):
                try:
                    come()
                    swings.figures.setdefault(way, []).append(bench.swing())
                except Refused as refusal:
                    swings.refused.append(f"{way}: {refusal}")
                    bench.switch_on()
    return [row for swings in made for row in _rows(swings)]


def _rows(swings: WaySwings) -> list[Row]:
    """Return the rows of one robot with one air."""
    title = f"{swings.robot}, air {'as planned' if swings.air == 'planned' else 'as it comes'}"
    promised = _PROMISED if swings.air == "planned" else (None,) * 4
    scales = np.array([1000.0, 0.0, *np.degrees([1.0, 1.0])])
    rows, means = list[Row](), list[Array]()
    for way, found in swings.figures.items():
        figures = np.array(found)
        scales[1] = 100.0 / figures[:, 1].mean()
        means.append(figures.mean(axis=0))
        spread, mean = figures.std(axis=0, ddof=1) * scales, means[-1]
        for name, value, unit, most in zip(_FIGURES, spread, _UNITS, promised, strict=True):
            note = f"mean speed {mean[1]:.3f} m/s, strike {1000 * mean[0]:+.2f} mm, {len(figures)} swings"
            rows.append(Row(NAME, f"{title}, {way}: {name}, SD", float(value), unit, note, at_most=most))
    apart = (np.max(means, axis=0) - np.min(means, axis=0)) * scales
    for name, value, unit, most in zip(_FIGURES, apart, _UNITS, promised, strict=True):
        rows.append(Row(NAME, f"{title}: {name}, means apart", float(value), unit, at_most=most))
    refused, note = len(swings.refused), "; ".join(swings.refused[:3])
    return [*rows, Row(NAME, f"{title}: ways and swings refused or stopped", refused, "", note)]
