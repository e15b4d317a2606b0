"""Sites of clubs: the values a club sets, the way back, and refusals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import asin, degrees, pi, radians, sin
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.config import Configuration, load_configuration
from sim.impact import face_axes, impact_parameters
from sim.plant import build_plant

BAG = ("wood1", "wood3", "hybrid", "iron5", "iron7", "iron8", "iron9", "pitching", "wedge56")
TEES = {"wood1": 0.0387, "wood3": 0.0239, "hybrid": 0.0233}
"""How far the ball stands above turf in the swing plane, m."""
HANDS = {"wood1": 0.47, "wood3": 0.476, "hybrid": 0.476, "iron5": 0.449, "pitching": 0.449, "wedge56": 0.449}
"""How far the ball lies below the shoulder beyond the club's length, m; the irons' is between."""
IRON7 = """
[sites.iron7]
plane_deg = 62.5
ground = -1.417
sole_depth = 0.02
ball_x = 0.14
ball_y = -1.3956
ground_stiffness = 2.0e5
"""
SOLE_AND_BALL = "sole_depth = 0.02\nball_x = 0.14\nball_y = -1.3956"
Overlay = Callable[[str], Path]


@pytest.fixture(scope="module")
def bag() -> Configuration:
    return load_configuration(Path("bag"))


def faults(path: Path) -> list[BenchError]:
    with pytest.raises(ExceptionGroup) as raised:
        load_configuration(path)
    return [fault for fault in raised.value.exceptions if isinstance(fault, BenchError)]


def test_plant_with_club_uses_site_of_club(bag: Configuration) -> None:
    plant = bag.plant_with(club="iron7")
    assert plant.robot.club == bag.clubs["iron7"]
    assert plant.robot.lie == pytest.approx(radians(62.0))
    assert plant.robot.in_plane_gravity == pytest.approx(plant.robot.gravity * sin(radians(62.0)))
    assert (plant.site.ball_x, plant.site.ground) == (0.07, -1.3694)
    assert type(plant.site) is type(bag.plant.site)
    assert build_plant(plant).plant["lie"][0] == plant.robot.lie


def test_plant_with_club_without_site_uses_common_site(
    bag: Configuration, configuration: Configuration
) -> None:
    assert bag.plant == configuration.plant
    ironed = replace(bag, plant=bag.plant_with(club="iron7"))
    assert ironed.plant_with(club="driver") == configuration.plant
    assert configuration.plant_with(club="iron7").site == configuration.plant.site


def test_configuration_swing_club_uses_site_of_club(overlay: Overlay) -> None:
    found = load_configuration(overlay(IRON7 + '[swing]\nclub = "iron7"'))
    assert found.plant.robot.lie == pytest.approx(radians(62.5))
    assert found.plant.site.ball_y == -1.3956


@pytest.mark.parametrize("name", BAG)
def test_bag_clubs_meet_ball_with_level_face(name: str, bag: Configuration) -> None:
    plant = bag.plant_with(club=name)
    site, club = plant.site, plant.robot.club
    n, _, toe = face_axes(1.5 * pi, impact_parameters(club, plant.ball, plant.robot.lie))
    assert toe[1] == pytest.approx(0.0, abs=1e-9)
    assert degrees(asin(n[1])) == pytest.approx(degrees(club.loft))
    lifted = site.ball_y - site.ground - plant.ball.radius
    assert lifted == pytest.approx(TEES.get(name, 0.0), abs=1e-4)
    # The arms stand alike whatever the club's length, lower for irons, wood and hybrid than for wedges.
    assert site.ball_y + club.length_to_face == pytest.approx(-HANDS.get(name, 0.461), abs=1e-9)
    assert (site.surface, site.divot > 0.0) == (("none", False) if name == "wood1" else ("turf", True))


def test_bag_clubs_run_from_long_light_to_short_heavy(bag: Configuration) -> None:
    clubs = [bag.clubs[name] for name in BAG]
    for longer, shorter in pairwise(clubs):
        assert longer.length_to_face > shorter.length_to_face
        assert longer.shaft_length < longer.length_to_face
        assert longer.head_mass < shorter.head_mass
        assert longer.loft < shorter.loft


@pytest.mark.parametrize(
    ("change", "key", "found", "wanted"),
    [
        (("sites.iron7", "sites.putter"), "sites.putter", "no such club", "one of driver"),
        (("62.5", "50.0"), "sites.iron7.plane_deg", "50.0 deg, with the club's lie at 62.5", "within 5 deg"),
        (("62.5", "10.0"), "sites.iron7.plane_deg", "10", "20 to 90 deg"),
        (
            (SOLE_AND_BALL, SOLE_AND_BALL.replace("0.02", "0.0").replace("-1.3956", "-1.41")),
            "sites.iron7.ball_y",
            "-1.41 m",
            "at least -1.3957 m",
        ),
        (
            ("0.02\n", "0.05\n"),
            "sites.iron7.sole_depth",
            "0.05 m, a sole 28.6 mm in the ground",
            "at most 0.0214",
        ),
        (
            ("ball_x = 0.14", "ball_x = 1.4"),
            "sites.iron7.ball_y",
            "1.977 m from the shoulder",
            "at most 1.680 m",
        ),
    ],
)
def test_configuration_invalid_site_is_refused(
    change: tuple[str, str], key: str, found: str, wanted: str, overlay: Overlay
) -> None:
    text = IRON7.replace(*change)
    (fault,) = faults(overlay(text))
    assert fault.location.endswith(f": {key}")
    assert found in fault.found
    assert wanted in fault.expected


def test_configuration_ball_on_turf_passes_within_uncertainty_of_height(overlay: Overlay) -> None:
    on_ground = IRON7.replace("-1.3956", "{:.5f}")
    load_configuration(overlay(on_ground.format(-1.39566 - 1e-4)))
    (fault,) = faults(overlay(on_ground.format(-1.39566 - 6e-4)))
    assert (fault.found, fault.expected[:18]) == ("-1.39626 m", "at least -1.3957 m")


def test_configuration_divot_without_surface_is_refused(overlay: Overlay) -> None:
    (fault,) = faults(overlay(IRON7 + "divot = 0.012\n"))
    assert fault.location.endswith("sites.iron7.divot")
    assert "0.012 m into a bare floor" in fault.found
    assert load_configuration(overlay(IRON7 + 'divot = 0.012\nsurface = "mat"\n')).plant.site.divot == 0.0


def test_configuration_incomplete_site_is_refused(overlay: Overlay) -> None:
    (fault,) = faults(overlay(IRON7.replace("ball_x = 0.14\n", "")))
    assert fault.location.endswith("sites.iron7.ball_x")
    assert fault.found == "nothing"
