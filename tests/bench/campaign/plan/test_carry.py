"""Carry states its source: three quantities, never mixed; hardware never shows the plan's ball."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest

from bench.base.errors import Refused
from bench.calibration.ball_aerodynamics import AerodynamicsEntry, BallAerodynamics
from bench.campaign.plan.carry import carry_columns, measured_of, require_carry
from bench.campaign.plan.plan import CampaignPlan
from bench.campaign.report.campaign_record import CampaignRecord
from bench.campaign.report.campaign_report import render_campaign_report
from bench.campaign.report.findings import as_flown, findings
from bench.campaign.report.report_tables import carry_words
from bench.campaign.report.verdicts import quantity_name
from bench.campaign.run.runner_control import new_entry
from bench.campaign.statistics._unequal_variances import common_errors
from bench.campaign.statistics.block_model import Contrast
from bench.records.shot.recorded_shot import FlightConditions
from bench.store.rows import CampaignState, Hit, Standing
from drivers.base import Launch
from sim.ball import REFERENCE_BALL, Ball
from sim.flight import fly
from tests.bench.campaign.plans import NOW, SHIPPED, compared, shipped_plan, with_values
from tests.benchmarks.campaign_statistics import Truth, campaign_shots

pytestmark = pytest.mark.usefixtures("undrawn")

AROUND = FlightConditions()
LAUNCH = Launch(63.0, 0.2, 0.01, 2800 * pi / 30, 0.02)
VALUES = BallAerodynamics(
    "a", 0.04593, 0.021335, "LIBGOLF", 1.05, 0.97, 0.004, 0.006, 0.4, 20, 58.0, 70.0, 230.0, 340.0, 1.1
)


def _ten(carry: str, **sections: dict[str, Any]) -> CampaignPlan:
    return shipped_plan("ten-balls", analysis={"carry": carry}, **sections)


def _entry(ball: str = "a", values: BallAerodynamics = VALUES) -> AerodynamicsEntry:
    return AerodynamicsEntry(1, NOW, "radar, range 2", "Ann", replace(values, ball=ball))


def _carry(plan: CampaignPlan, ball: str, told: float | None = 190.0, **measured: Any) -> dict[str, Any]:
    """Return the columns of a shot on hardware."""
    return carry_columns(plan, measured, ball, LAUNCH, AROUND, told, None)[0]


def test_shot_carry_reference_is_equal_for_all_balls() -> None:
    # Flown with the plan's own drag_factor and lift_factor they were 179.6 to 185.2 m.
    plan = _ten("reference")
    carries = {_carry(plan, ball)["carry_m"] for ball in plan.design.balls}
    assert carries == {fly(LAUNCH, AROUND.air, REFERENCE_BALL, AROUND.wind, AROUND.turf).carry}


@pytest.mark.parametrize("carry", ["", "reference", "monitor", "measured"])
def test_shot_carry_hardware_ignores_ball_parameters_of_plan(carry: str) -> None:
    plan = _ten(carry)
    balls = {name: replace(ball, drag_factor=0.5, lift_factor=2.0) for name, ball in plan.balls.items()}
    other = replace(plan, balls=balls)
    assert _carry(plan, "f", f=_entry("f")) == _carry(other, "f", f=_entry("f"))


def test_shot_carry_compares_selected_source_and_keeps_all() -> None:
    for source, column in (
        ("reference", "carry_reference_m"),
        ("monitor", "carry_monitor_m"),
        ("measured", "carry_measured_m"),
    ):
        found = _carry(_ten(source), "a", a=_entry())
        assert (found["carry_source"], found["carry_m"]) == (source, found[column])
        three = [found[f"carry_{name}_m"] for name in ("reference", "monitor", "measured")]
        assert len(set(three)) == 3
        assert found["carry_measured_error_m"] == pytest.approx(0.6, abs=0.5)
    monitor = _carry(_ten("monitor"), "a", a=_entry())
    assert not {"total_m", "apex_m", "landing_angle_deg", "carry_side_m"} & monitor.keys()
    measured = _carry(_ten("measured"), "a", a=_entry())
    flown = fly(LAUNCH, AROUND.air, VALUES.as_flown, AROUND.wind, AROUND.turf)
    assert (measured["total_m"], measured["flight_source"]) == (flown.total, "measured")


@pytest.mark.parametrize(
    ("carry", "launch", "told", "reason"),
    [
        ("monitor", LAUNCH, None, "the launch monitor reported none"),
        ("measured", LAUNCH._replace(speed=80.0), 200.0, "ball speed 80.0 m/s, aerodynamics of a measured"),
        ("reference", LAUNCH._replace(speed=500.0), 200.0, "no flight"),
    ],
)
def test_shot_carry_unknown_carry_reports_reason(
    carry: str, launch: Launch, told: float | None, reason: str
) -> None:
    columns, doubt = carry_columns(_ten(carry), {"a": _entry()}, "a", launch, AROUND, told, None)
    assert reason in doubt
    assert columns.get("carry_m") is None
    speed = with_values(_ten(carry), analysis={"quantity": "ball_speed_mps"})
    if carry != "reference":
        assert carry_columns(speed, {"a": _entry()}, "a", launch, AROUND, told, None)[1] == ""


def test_shot_carry_simulated_ball_uses_simulated_flight() -> None:
    ball = Ball("a", drag_factor=0.9)
    for carry, source in (("", "simulated"), ("measured", "simulated"), ("reference", "reference")):
        found, _ = carry_columns(_ten(carry), {}, "a", LAUNCH, AROUND, 190.0, ball)
        assert (found["carry_source"], found["flight_source"]) == (source, source)
    own, _ = carry_columns(_ten(""), {}, "a", LAUNCH, AROUND, 190.0, ball)
    assert own["carry_m"] == fly(LAUNCH, AROUND.air, ball, AROUND.wind, AROUND.turf).carry
    monitor, _ = carry_columns(_ten("monitor"), {}, "a", LAUNCH, AROUND, 190.0, ball)
    assert [monitor[name] for name in ("carry_m", "carry_source")] == [190.0, "monitor"]
    assert monitor["flight_source"] == "simulated"


def test_require_carry_missing_source_or_aerodynamics_is_refused() -> None:
    with pytest.raises(Refused, match="carry_m is compared"):
        require_carry(_ten(""), {})
    with pytest.raises(Refused, match="no aerodynamics of b, c"):
        require_carry(_ten("measured"), {"a": _entry()})
    for carry in ("reference", "monitor"):
        require_carry(_ten(carry), {})
    require_carry(shipped_plan("repeatability"), {})


def test_new_entry_stores_measured_aerodynamics() -> None:
    plan = _ten("measured")
    entry = new_entry(plan, SHIPPED, NOW, simulated=False, measured={"a": _entry()})
    stored = json.loads(json.dumps(entry.calibrations))
    assert measured_of(stored, "campaign") == {"a": _entry()}
    assert new_entry(plan, SHIPPED, NOW, simulated=False).calibrations == {}


@pytest.mark.slow
def test_campaign_report_hardware_omits_simulation_parameters() -> None:
    plan = _ten("measured")
    shots = [
        replace(shot, carry_source="measured", carry_measured_error_m=0.8)
        for shot in campaign_shots(with_values(plan, design={"blocks": 2}), Truth(), 1)
    ]
    measured = {"a": _entry()}
    texts = {}
    for simulated in (False, True):
        entry = new_entry(plan, SHIPPED, NOW, simulated=simulated, measured=measured)
        standing = Standing(CampaignState.FINISHED, "", "")
        record = CampaignRecord(entry, standing, plan, shots, [], Counter[Hit]())
        texts[simulated] = render_campaign_report(record, findings(plan, shots))
    for word in ("drag_factor", "lift_factor", "plant.ball", "plan.simulation"):
        assert word not in texts[False], word
        assert word in texts[True], word
    hardware = texts[False]
    assert "measured – flown from the measured launch with the aerodynamics measured on each ball" in hardware
    assert "drag 1.0500 ± 0.0040, lift 0.9700 ± 0.0060 times LIBGOLF" in hardware
    assert "radar, range 2, 2026-11-21, version 1, by Ann" in hardware
    assert "carry (measured aerodynamics)" in hardware
    assert "length to the face" in hardware
    assert "0.80 to 0.80 m" in hardware


def test_carry_words_explain_source() -> None:
    plan = _ten("")
    shots = [replace(shot, carry_source="reference") for shot in campaign_shots(plan, Truth(), 1)[:40]]
    assert "it compares launches, not flights" in carry_words(shots)
    assert carry_words([]) == ""


def test_quantity_name_simulated_carry_omits_measured() -> None:
    plan = _ten("measured")
    shots = [replace(s, carry_source="simulated") for s in campaign_shots(plan, Truth(), 1)[:40]]
    assert quantity_name(as_flown(plan, shots)) == "carry"
    assert quantity_name(plan) == "carry (measured aerodynamics)"


def test_analyse_carry_error_limits_false_differences() -> None:
    # Two equal balls, each flown with coefficients that are off by 1 m of carry (standard uncertainty).
    design = {"balls": ("a", "b"), "blocks": 12, "swings": ("default",)}
    plan = _ten("measured", design=design, control={"ball": ""})
    random, called = np.random.default_rng(20261122), {0.0: 0, 1.0: 0}
    campaigns = 150
    for number in range(campaigns):
        off = dict(zip("ab", random.normal(0.0, 1.0, 2), strict=True))
        shots = campaign_shots(plan, Truth(sd=1.0, block=0.5), number)
        drawn = [replace(shot, carry_source="measured") for shot in shots]
        for error in called:
            shots = [
                replace(s, carry_m=(s.carry_m or 0.0) + off[s.ball], carry_measured_error_m=error)
                for s in drawn
            ]
            (pair,) = compared(plan, shots, None).pairs
            called[error] += pair.verdict in {"different", "both"}
    assert called[0.0] / campaigns > 0.4, "verdict from the SD alone"
    assert called[1.0] / campaigns < 0.10


def test_common_errors_apply_only_to_compared_measured_balls() -> None:
    plan = _ten("measured")
    shots = [
        replace(s, carry_source="measured", carry_measured_error_m=0.7)
        for s in campaign_shots(plan, Truth(), 1)
    ]
    assert common_errors(plan, shots) == pytest.approx(dict.fromkeys(plan.design.balls, 0.7))
    assert common_errors(with_values(plan, design={"compare": "club"}), shots) == {}
    assert common_errors(plan, [replace(s, carry_source="monitor") for s in shots]) == {}
    plain = Contrast(2.0, 0.5, 10.0)
    assert plain.widened(0.0, 0.0) == plain
    assert plain.widened(0.3, 0.4).error == pytest.approx(0.5 * 2**0.5)
    assert plain.widened(0.3, 0.4).dof == pytest.approx(40.0)
