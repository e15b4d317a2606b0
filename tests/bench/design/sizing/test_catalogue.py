"""The catalogue of parts: every part has a source, a mistake names its place, flows become conductances."""

from __future__ import annotations

from dataclasses import fields
from math import pi, sqrt
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.design.sizing.catalogue import (
    FILE,
    conductance_of,
    fanno_length,
    hose_conductance,
    in_series,
    load_catalogue,
    shipped_catalogue,
)
from sim.plant import PlantParameters
from sim.pneumatics import FLOW_TO_PRESSURE, GAS_CONSTANT, REFERENCE_DENSITY, REFERENCE_TEMPERATURE, flow

NORMAL = 7.013e5, 6.013e5
"""Pressures of a nominal flow, Pa absolute."""


def test_catalogue_each_part_names_source() -> None:
    catalogue = shipped_catalogue()
    parts = [part for kind in fields(catalogue) for part in getattr(catalogue, kind.name).values()]
    assert len(parts) > 15
    assert all(len(part.source) > 10 for part in parts)


def test_catalogue_sizes_rise_within_each_kind() -> None:
    catalogue = shipped_catalogue()
    for kind, size in (
        ("vanes", "displacement"),
        ("cylinders", "bore"),
        ("valves", "nominal_flow"),
        ("absorbers", "energy"),
        ("feeds", "conductance"),
        ("manifolds", "volume"),
        ("hoses", "conductance"),
        ("vents", "conductance"),
    ):
        sizes = [getattr(part, size) for part in getattr(catalogue, kind).values()]
        assert sizes == sorted(sizes)


def test_catalogue_shut_off_valves_switch_within_quarter_of_delay() -> None:
    """The timer is twice the detection time of a supply valve stuck open; switching must not use it up."""
    delay = PlantParameters().supply.shut_off_delay
    parts = shipped_catalogue().shut_offs.values()
    assert len(parts) >= 2
    assert all(part.switching_time < 0.25 * delay for part in parts)


@pytest.mark.parametrize("nominal", [700.0, 2000.0])
def test_conductance_of_reproduces_nominal_flow(nominal: float) -> None:
    power = flow(conductance_of(nominal), *NORMAL, 0.3)
    mass_flow = power / (GAS_CONSTANT * REFERENCE_TEMPERATURE)
    assert 60e3 * mass_flow / REFERENCE_DENSITY == pytest.approx(nominal, rel=1e-9)
    assert FLOW_TO_PRESSURE > 0


def test_conductance_of_700_litres_matches_reference() -> None:
    # golf.md 8.2: 2.75e-8 m3/(s Pa) at a critical ratio of 0.3.
    assert conductance_of(700.0) == pytest.approx(2.75e-8, rel=2e-3)


@pytest.mark.parametrize(("mach", "length"), [(0.3, 5.29925), (0.5, 1.06906), (0.8, 0.07229)])
def test_fanno_length_matches_gas_dynamics_tables(mach: float, length: float) -> None:
    """4 f L / D of Fanno flow, ratio of specific heats 1.4 (tables of any textbook on compressible flow)."""
    assert fanno_length(mach) == pytest.approx(length, rel=1e-4)


def test_hose_conductance_falls_with_length() -> None:
    area = pi / 4 * 0.01**2
    choked = 0.684731 * area / sqrt(GAS_CONSTANT * REFERENCE_TEMPERATURE) / REFERENCE_DENSITY
    lengths = [hose_conductance(0.01, length) for length in (1e-7, 0.1, 0.5, 1.0, 5.0)]
    assert lengths[0] == pytest.approx(choked, rel=2e-3)
    assert lengths == sorted(lengths, reverse=True)
    assert hose_conductance(0.008, 1.0) == pytest.approx(6.1e-8, rel=0.03)


def test_in_series_combines_conductances() -> None:
    assert in_series(3.0, 4.0) == pytest.approx(2.4)
    assert in_series(7.9e-8, 1.0) == pytest.approx(7.9e-8)


def broken(tmp_path: Path, old: str, new: str) -> Path:
    """Return a catalogue with `old` replaced."""
    text = FILE.read_text()
    assert old in text
    file = tmp_path / "catalogue.toml"
    file.write_text(text.replace(old, new, 1))
    return file


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rod = 0.016", "rod = 0.05", "thinner than the bore"),
        ("price = 3", "price = 7", "price"),
        ("displacement = 3.0e-4", "displacement = -1.0", "displacement"),
        ("stroke = 0.01386", "strok = 0.01386", "strok"),
        ("inner_diameter = 0.008", "inner_diameter = 8.0", "inner_diameter"),
    ],
)
def test_load_catalogue_mistake_reports_place(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(ExceptionGroup) as caught:
        load_catalogue(broken(tmp_path, old, new))
    text = " ".join(str(fault) for fault in caught.value.exceptions)
    assert words in text
    assert "catalogue.toml" in text


def test_load_catalogue_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="no such file"):
        load_catalogue(tmp_path / "none.toml")
