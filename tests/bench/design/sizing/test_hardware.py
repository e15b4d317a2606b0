"""A choice of parts becomes a configuration, that of the variants their texts name; swings stop safely."""

from __future__ import annotations

import re
from dataclasses import asdict, fields, replace
from math import radians
from pathlib import Path
from typing import Any

import pytest

from bench.base.errors import BenchError
from bench.config import VARIANTS, load_configuration
from bench.design.sizing.catalogue import (
    PRICES,
    Hardware,
    highest_pressure,
    in_series,
    parts_of,
    relief_pressure,
    shipped_catalogue,
)
from bench.design.sizing.search import (
    SizingDemand,
    SizingGrid,
    candidate_configuration,
    candidate_text,
    cheaper,
)
from bench.design.stop_verification import TRIALS, SwingCheck
from bench.simulation.simulated_bench import Bench
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from tests.compiled_only import needs_speed
from tests.sampling import release_except

SHIPPED = load_configuration(Path("shipped"))
PARTS = shipped_catalogue()


def configured(hardware: Hardware, speed: float = 45.0):  # type: ignore[no-untyped-def]
    """Return the configuration of `hardware`."""
    text = candidate_text(PARTS, hardware, SHIPPED, SizingDemand(speed))
    return candidate_configuration(text)


def flat(values: dict, path: str = "") -> dict:  # type: ignore[type-arg]
    """Return nested `values` by dotted path."""
    found: dict[str, object] = {}
    for key, value in values.items():
        found |= flat(value, f"{path}{key}.") if isinstance(value, dict) else {f"{path}{key}": value}
    return found


def test_candidate_configuration_default_hardware_matches_shipped_plant() -> None:
    made, wanted = flat(asdict(configured(Hardware()).plant)), flat(asdict(SHIPPED.plant))
    assert made.keys() == wanted.keys()
    for key, value in wanted.items():
        expected = pytest.approx(value, rel=0.006) if isinstance(value, float) else value
        assert made[key] == expected, key
    assert configured(Hardware()).envelope == SHIPPED.envelope


def test_candidate_configuration_default_grid_loads() -> None:
    for hardware in SizingGrid().candidates(PARTS):
        configured(hardware, 58.1)


def test_hardware_larger_parts_raise_friction_volume_and_vent() -> None:
    small, large = configured(Hardware()).plant, configured(Hardware(vane="V800", arm="C63")).plant
    assert large.shoulder.friction.coulomb == pytest.approx(2 * small.shoulder.friction.coulomb)
    assert large.shoulder.dead_volume == pytest.approx(2 * small.shoulder.dead_volume)
    assert large.supply.vent_conductance == pytest.approx(2 * small.supply.vent_conductance, rel=1e-3)
    assert large.right_arm.friction.static > small.right_arm.friction.static


@pytest.mark.parametrize("regulated", [7e5, 8e5, 10e5, 11e5])
def test_relief_pressure_lies_between_regulated_and_rated(regulated: float) -> None:
    assert regulated < relief_pressure(regulated) < 12e5
    assert highest_pressure(regulated) > regulated


@pytest.mark.parametrize(("pressure", "feed"), [(8e5, "L34"), (10e5, "L100")])
def test_manifold_relief_conductance_exceeds_feed(pressure: float, feed: str) -> None:
    made = configured(replace(Hardware(), pressure=pressure, feed=feed))
    supply = made.plant.supply
    assert supply.manifold_relief_pressure == pytest.approx(made.envelope.max_supply_pressure)
    assert supply.manifold_relief_pressure == pytest.approx(1.1 * pressure)
    # At 1.4 times its pressure upstream the feed is hardly throttled, the relief valve choked.
    assert supply.manifold_relief_conductance > supply.feed_conductance


def test_hardware_hose_adds_dead_volume_flow_loss_and_price() -> None:
    hose, own = PARTS.hoses["H12"], replace(Hardware(), hose="H12")
    bare, hosed = configured(Hardware()).plant, configured(own).plant
    for before, after in zip(bare.actuators, hosed.actuators, strict=True):
        assert after.dead_volume - before.dead_volume == pytest.approx(6.136e-5, rel=1e-3)
        passed = in_series(before.valve.conductance, hose.conductance)
        assert after.valve.conductance == pytest.approx(passed, rel=1e-5)
        assert after.valve.conductance < before.valve.conductance
    assert parts_of(PARTS, own).price - parts_of(PARTS, Hardware()).price == 6 * PRICES[hose.price]
    assert own.name == f"{Hardware().name}-H12"


def test_hardware_catalogue_vent_replaces_sized_throttle() -> None:
    own = Hardware(vane="V800", vent="T30")
    assert configured(own).plant.supply.vent_conductance == pytest.approx(3.0e-9)
    assert parts_of(PARTS, own).price - parts_of(PARTS, replace(own, vent="")).price == 1000
    assert own.name.endswith("-T30")


def test_sizing_grid_varies_hoses_and_vents() -> None:
    found = replace(SizingGrid(), hoses=("", "H19"), vents=("", "T50", "T80")).candidates(PARTS)
    assert len(found) == 6 * len(SizingGrid().candidates(PARTS))
    assert len({hardware.name for hardware in found}) == len(found)
    smaller = [hardware.hose for hardware in cheaper(PARTS, Hardware(hose="H19", vent="T50"))]
    assert "H12S" in smaller
    assert "" not in smaller


@pytest.mark.parametrize(("single", "pair", "rated"), [("A90", "A90P", 203.7), ("A170", "A170P", 294.0)])
def test_absorber_pair_keeps_stiffness_and_raises_rating(single: str, pair: str, rated: float) -> None:
    one, two = (configured(Hardware(wrist_absorber=name)).plant.wrist.stop for name in (single, pair))
    assert two.stiffness == pytest.approx(one.stiffness, rel=1e-3)
    assert two.travel == pytest.approx(one.travel, rel=1e-3)
    assert two.rating == pytest.approx(rated)


def test_arm_absorber_larger_body_keeps_stiffness() -> None:
    shipped, larger = (
        configured(Hardware(arm_absorber=name)).plant.right_arm.stop for name in ("A40", "A40H")
    )
    assert (larger.stiffness, larger.travel) == (shipped.stiffness, shipped.travel)
    assert (shipped.rating, larger.rating) == (40.0, pytest.approx(147.0 * 13.86 / 25.0, rel=1e-3))


def test_parts_of_unknown_part_lists_available_parts() -> None:
    with pytest.raises(BenchError, match="V400"):
        parts_of(PARTS, Hardware(vane="V9"))


def test_hardware_names_are_unique_in_grid() -> None:
    grid = SizingGrid().candidates(PARTS)
    assert len({hardware.name for hardware in grid}) == len(grid) == 32


def test_cheaper_changes_one_part_and_lowers_price() -> None:
    own = Hardware("V600", "C63", "C63", "F3500", "F3500", "F3500", "A120", "A170", "L100", "M5")
    found = cheaper(PARTS, own)
    assert len(found) == 10
    for hardware in found:
        assert sum(a != b for a, b in zip(asdict(hardware).values(), asdict(own).values(), strict=True)) == 1
        assert parts_of(PARTS, hardware).price < parts_of(PARTS, own).price
    assert cheaper(PARTS, replace(own, vane="V300"))[0].arm == "C40"


def named_hardware(variant: str) -> Hardware:
    """Return the hardware that the comment of the variant names."""
    text = (VARIANTS / f"{variant}.toml").read_text()
    found = re.search(r"^# (V\d+-\S+?)-8bar-60mm-(\d+)deg(?:-(\w+))?", text, re.MULTILINE)
    assert found is not None
    names = [field.name for field in fields(Hardware)][:10]
    parts: dict[str, Any] = dict(zip(names, found[1].split("-"), strict=True))
    parts |= {"lever_angle": radians(int(found[2])), "frame": found[3] or "R80"}
    return Hardware(**parts, pressure=8.0e5, lever=0.06)


@pytest.mark.parametrize(("name", "speed"), [("high_speed", 58.1), ("golfers", 51.41)])
def test_variant_matches_hardware_named_in_comment(name: str, speed: float) -> None:
    made, variant = configured(named_hardware(name), speed), load_configuration(Path(name))
    assert made.plant == variant.plant
    assert made.envelope == variant.envelope


@pytest.mark.release
@needs_speed
@pytest.mark.parametrize(
    "name", release_except({"driver-130mph"}, ["driver-115mph", "driver-130mph", "driver-130mph-level"])
)
def test_swing_check_high_speed_trials_end_safely(name: str) -> None:
    c, profile = load_configuration(Path("high_speed")), load_profile(find_profile(name))
    trials = tuple(trial for trial in TRIALS if "stuck" not in trial.name)
    bench = Bench.of(replace(c, envelope=c.envelope.with_model_check("off")), profile)
    outcomes = SwingCheck(bench).outcomes(trials, spacing=205)
    assert len(outcomes) > 90
    assert [outcome for outcome in outcomes if outcome.unsafe] == []
