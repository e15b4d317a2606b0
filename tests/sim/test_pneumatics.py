"""Air: ISO 6358 against hand values, the spool against its analytic response, cushions that never pull."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from sim.pneumatics import LAMINAR_RATIO, REFERENCE_DENSITY, EndStop, Valve, flow, stop_force

C, B = 7.9e-8, 0.3
R_T = 287.05 * 293.15

pressures = st.floats(5e4, 1.2e6)
ratios = st.floats(0.05, 0.9)


def test_flow_choked_equals_conductance_times_pressure() -> None:
    """A 3/8 inch valve at 8 bar absolute passes 75 g/s."""
    assert flow(C, 8e5, 1.0e5, B) / R_T == pytest.approx(7.9e-8 * 8e5 * 1.185)
    assert flow(C, 8e5, 1.0e5, B) / R_T == pytest.approx(0.0749, rel=1e-3)
    assert flow(C, 8e5, 2.4e5, B) == flow(C, 8e5, 1.0e5, B)


@pytest.mark.parametrize(
    ("ratio", "share"),  # sqrt(1 - ((ratio - 0.3) / 0.7)^2)
    [(0.3, 1.0), (0.5, 0.958315), (0.65, np.sqrt(0.75)), (0.8, 0.699854), (0.9, 0.515079), (0.95, 0.371154)],
)
def test_flow_subsonic_follows_iso_6358_ellipse(ratio: float, share: float) -> None:
    assert flow(C, 7e5, ratio * 7e5, B) == pytest.approx(share * flow(C, 7e5, 0.0, B), rel=2e-6)


@given(pressures, pressures, ratios)
def test_flow_swapped_pressures_reverses_sign(first: float, second: float, critical: float) -> None:
    assert flow(C, first, second, critical) == -flow(C, second, first, critical)
    assert flow(C, first, first, critical) == 0.0


@given(pressures, ratios, st.floats(0.0, 0.999), st.floats(1e-6, 1e-3))
def test_flow_falls_with_downstream_pressure(
    upstream: float, critical: float, ratio: float, more: float
) -> None:
    before = flow(C, upstream, ratio * upstream, critical)
    after = flow(C, upstream, min(ratio + more, 1.0) * upstream, critical)
    assert after <= before * (1 + 1e-12)
    assert before <= flow(C, upstream, 0.0, critical) * (1 + 1e-12)


@given(pressures, pressures, ratios, st.floats(1e-6, 1e-3))
def test_flow_grows_with_upstream_pressure(
    upstream: float, downstream: float, critical: float, more: float
) -> None:
    before, after = (flow(C, p, downstream, critical) for p in (upstream, upstream * (1 + more)))
    if upstream >= downstream:
        assert after > before
    else:  # backwards, and not at all where that flow is choked
        assert after >= before


@given(ratios)
def test_flow_is_continuous_between_branches(critical: float) -> None:
    for edge in (critical, LAMINAR_RATIO):
        below, above = (flow(C, 6e5, edge * (1 + side) * 6e5, critical) for side in (-1e-9, 1e-9))
        assert above == pytest.approx(below, rel=1e-4)


def test_flow_is_linear_near_equal_pressures() -> None:
    small, twice = (flow(C, 6e5, (1 - d) * 6e5, B) for d in (0.005, 0.01))
    assert twice == pytest.approx(2 * small, rel=1e-9)


def test_reference_density_matches_iso_6358() -> None:
    assert pytest.approx(1e5 / (288.0 * 293.15), rel=2e-3) == REFERENCE_DENSITY


@pytest.mark.parametrize("damping", [0.05, 0.3, 0.8, 0.999999, 1.0, 1.000001, 1.7])
@pytest.mark.parametrize("half_step", [2.5e-6, 1.25e-4, 1e-3])
def test_valve_half_step_matrix_equals_matrix_exponential(damping: float, half_step: float) -> None:
    valve = Valve(damping_ratio=damping)
    omega = valve.natural_frequency
    system = np.array([[0.0, 1.0], [-(omega**2), -2 * damping * omega]])
    difference = valve.half_step_matrix(half_step) - expm(system * half_step)
    scale = np.array([[1.0, 1 / omega], [omega, 1.0]])
    assert np.max(np.abs(difference) / scale) < 1e-9


@given(st.floats(1e-6, 0.1), st.floats(-50.0, 50.0))
def test_stop_force_never_pulls(depth: float, speed: float) -> None:
    stop = EndStop(energy=40.0, travel=0.02, damping_speed=2.0)
    force = stop_force(stop.stiffness, stop.travel, stop.damping_speed, depth, speed)
    assert force >= 0.0
    if speed <= -stop.damping_speed:
        assert force == 0.0


def test_stop_force_full_travel_takes_rated_energy() -> None:
    stop = EndStop(energy=40.0, travel=0.02)
    depth = np.linspace(0.0, stop.travel, 1001)
    force = [stop_force(stop.stiffness, stop.travel, stop.damping_speed, d, 0.0) for d in depth]
    assert np.trapezoid(force, depth) == pytest.approx(40.0)
    beyond = stop_force(stop.stiffness, stop.travel, stop.damping_speed, stop.travel + 1e-3, 0.0)
    assert beyond - force[-1] == pytest.approx(21 * stop.stiffness * 1e-3)
