"""Faults that do not come alone: during a stop, from the start, one behind another, around access."""

from __future__ import annotations

from collections import Counter
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import pytest

from bench.base.lifecycle import Phase
from bench.config import load_configuration, shipped_configuration
from bench.faults.catalogue import (
    ACCESS,
    CATALOGUE,
    FAMILIES,
    INTO_A_STOP,
    START,
    Breakage,
    Instant,
    dense_instants,
    instants_of,
)
from bench.faults.matrix import Workbench, instants_for, plan_matrix
from bench.faults.summary import commit, origin_of
from bench.swing.profile import PHASES, Profile
from sim.faults import Fault
from tests.compiled_only import needs_speed
from tests.faults.made_matrix import BREAKAGE, instant


def test_catalogue_families_have_rows_and_instants(profile: Profile) -> None:
    assert {breakage.family for breakage in CATALOGUE} == set(FAMILIES)
    assert len({breakage.name for breakage in CATALOGUE}) == len(CATALOGUE)
    during = instants_for(BREAKAGE["arm encoder stuck, during an emergency stop"], profile)
    assert {instant.delay for instant in during} == set(INTO_A_STOP)
    assert not {instant.phase for instant in during} & {"standing", "hold", "homing", "return"}
    assert len({instant.name for instant in during}) == len(during)
    assert instants_for(BREAKAGE["arm encoder reversed, from the start"], profile) == START
    assert instants_for(BREAKAGE["supply lost, around access"], profile) == ACCESS


def test_instants_for_valve_stuck_open_are_dense(profile: Profile) -> None:
    instants = instants_for(BREAKAGE["wrist valve stuck open"], profile)
    assert set(dense_instants(profile)) < set(instants)
    ticks = [instant.tick for instant in dense_instants(profile)]
    assert max(b - a for a, b in pairwise(ticks)) <= 12
    begin = profile.begins[PHASES.index(Phase.DOWNSWING)]
    end = profile.begins[PHASES.index(Phase.RETURN)] if Phase.RETURN in PHASES else len(profile.angle)
    assert ticks[0] - begin < 12
    assert end - ticks[-1] <= 12
    assert instants_for(BREAKAGE["wrist valve garbage"], profile) == instants_of(profile)


def test_plan_matrix_sample_is_proportional_subset(profile: Profile) -> None:
    all_, some = (plan_matrix(profile, model_check=True, every=every).cases for every in (1, 20))
    assert set(some) < set(all_)
    assert {breakage.name for breakage, _ in some} == {breakage.name for breakage, _ in all_}
    often = {name for name, cases in Counter(breakage.name for breakage, _ in all_).items() if cases > 60}
    many, few = (sum(breakage.name in often for breakage, _ in cases) for cases in (all_, some))
    assert few == pytest.approx(many / 20, rel=0.2)
    assert {breakage.family for breakage, _ in some} >= {"one fault", "during a stop", "from the start"}
    only = plan_matrix(profile, model_check=True, families=["access"]).cases
    assert {breakage.family for breakage, _ in only} == {"access"}


@needs_speed
@pytest.mark.parametrize("stop", ["an operator's stop", "an emergency stop", "a stop by the guard"])
def test_fault_during_stop_is_reported_after_stop_cause(
    workbench: Workbench, profile: Profile, stop: str
) -> None:
    at = Instant("downswing", instant(profile, "downswing 80 %").tick, "80 %", 0.03)
    outcome = workbench.run(BREAKAGE[f"shoulder valve stuck open in reverse, during {stop}"], at)
    assert outcome.verdict == "safe"
    assert outcome.detected_by.startswith("SHOULDER_")
    assert 0 <= outcome.detection_ticks <= 60
    assert outcome.reaction == "PASSIVE"
    assert "; then shoulder" in outcome.operator


@needs_speed
def test_workbench_requested_stop_is_no_detection(workbench: Workbench, profile: Profile) -> None:
    at = instant(profile, "backswing 50 %")
    harmless = Breakage(Fault("nothing", "ball sensor", "delayed", 0.0), "stop")
    outcome = workbench.run(harmless, at)
    assert (outcome.verdict, outcome.detected_by) == ("harmless", "")


@pytest.mark.slow
@needs_speed
@pytest.mark.parametrize(
    ("name", "at"),
    [
        ("arm valve reversed, from the start", START[0]),
        pytest.param("arm encoder reversed, from the start", START[1], marks=pytest.mark.release),
        ("wrist encoder stuck, from the start", START[1]),
        ("supply valve stuck open, around access", ACCESS[0]),
        pytest.param("vents stuck shut, around access", ACCESS[0], marks=pytest.mark.release),
        ("shoulder valve stuck open, around access", ACCESS[1]),
        pytest.param("link cut, around access", ACCESS[1], marks=pytest.mark.release),
    ],
)
def test_fault_from_start_or_around_access_is_safe(workbench: Workbench, name: str, at: Instant) -> None:
    outcome = workbench.run(BREAKAGE[name], at)
    assert (outcome.verdict, outcome.reasons) == ("safe", ())


@needs_speed
@pytest.mark.parametrize("at", [*START, *ACCESS], ids=lambda at: at.name)
def test_workbench_without_fault_completes_swing(workbench: Workbench, at: Instant) -> None:
    nothing = Breakage(Fault("nothing", "ball sensor", "delayed", 0.0), family="access")
    outcome = workbench.run(nothing, at)
    assert (outcome.verdict, outcome.change) == ("harmless", "")
    assert outcome.head_share == pytest.approx(1.0, abs=0.05)


def test_origin_of_records_time_and_digests(tmp_path: Path, profile: Profile) -> None:
    configuration = load_configuration(shipped_configuration())
    origin = origin_of(configuration, profile, datetime(2026, 1, 2, tzinfo=UTC))
    assert origin["time_utc"].startswith("2026-01-02")
    assert len({origin["configuration"], origin["profile"], origin["sources"]}) == 3
    assert commit(tmp_path) is None
