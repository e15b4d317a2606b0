"""Plans are valid or report each error; the seed sets the order; the power is the textbook's."""

from __future__ import annotations

import json
from collections import Counter
from math import sqrt
from pathlib import Path

import pytest
from typer.testing import CliRunner

from bench.base.errors import BenchError
from bench.campaign.plan.bench_setup import Fitting, missing
from bench.campaign.plan.conformity_rules import control_ball_speed, rule_sets
from bench.campaign.plan.gate import Centre
from bench.campaign.plan.plan import CampaignPlan, reference_level
from bench.campaign.plan.plan_file import EXAMPLES, campaign_names, find_plan, load_plan, plan_from_record
from bench.campaign.plan.shot_sequence import (
    Arm,
    PlannedShot,
    Role,
    Step,
    all_trials,
    block_trials,
    hits_needed,
    sections,
)
from bench.campaign.report.preview import outlook, outlook_words, preview_record
from bench.campaign.run.plan_requirements import require_swings
from bench.campaign.statistics.sample_size import blocks_needed, power_of_shift, same_power_of_error
from bench.commands.cli import app
from bench.config import Configuration, load_configuration

TWO = """
[campaign]
name = "two"
[design]
balls = ["tour", "range"]
blocks = 4
[control]
ball = "tour"
"""


VARIANTS = {"bag": "bag", "wedge": "bag"}
"""Configurations of the shipped campaigns; default: the shipped one."""


def _plan(folder: Path, configuration: Configuration, text: str) -> CampaignPlan:
    file = folder / "plan.toml"
    file.write_text(text)
    return load_plan(file, configuration)


def _faults(folder: Path, configuration: Configuration, text: str) -> dict[str, BenchError]:
    with pytest.raises(ExceptionGroup) as caught:
        _plan(folder, configuration, text)
    faults = [fault for fault in caught.value.exceptions if isinstance(fault, BenchError)]
    return {fault.location.rsplit(": ", 1)[-1]: fault for fault in faults}


@pytest.mark.parametrize("name", campaign_names())
def test_load_plan_shipped_campaign_is_valid_and_swings_fit(name: str) -> None:
    configuration = load_configuration(Path(VARIANTS.get(name, "shipped")))
    plan = load_plan(Path(name), configuration)
    assert plan.campaign.name == name
    assert plan.campaign.title
    require_swings(plan, configuration)


def test_campaign_names_lists_shipped_examples() -> None:
    assert campaign_names() == [
        *("bag", "clubs", "clubs-split-plot", "distance", "face-map", "repeatability", "symmetry"),
        *("ten-balls", "two-balls", "wedge"),
    ]
    assert find_plan(Path("two-balls")) == EXAMPLES / "two-balls.toml"


@pytest.mark.parametrize(
    ("change", "location", "found"),
    [
        (('"range"]', '"rnage"]'), "design.balls", "rnage"),
        (("blocks = 4", "blocks = 0"), "design.blocks", "0"),
        (("blocks = 4", "blocks = 4\nseeed = 1"), "design.seeed", "unknown"),
        (('["tour", "range"]', '["tour", "tour"]'), "design.balls", "tour"),
        (("blocks = 4", "blocks = 400"), "ball_handling.samples", "hits of"),
        (('name = "two"', 'name = "../two"'), "campaign.name", "../two"),
        (('ball = "tour"', 'ball = "tuor"'), "control.ball", "tuor"),
        (('ball = "tour"', 'ball = "tour"\n[stop]\nrule = "width"'), "stop.width", "0"),
        (
            ('ball = "tour"', 'ball = "tour"\n[stop]\nrule = "equivalence"'),
            "analysis.equivalence_margin",
            "0",
        ),
        (('ball = "tour"', 'ball = "tour"\n[gate]\nclub_speed = nan'), "gate.club_speed", "nan"),
        (('ball = "tour"', 'ball = "tour"\n[warm_up]\nat_most = 0'), "gate.reference", "warm-up"),
        (('ball = "tour"', 'ball = "tour"\n[rules]\napply = ["ods-1066"]'), "rules.apply", "ods-1066"),
        (
            ('ball = "tour"', 'ball = "tour"\n[set_up]\ncontrol_restitution = 0.8'),
            "set_up.control_contact_time",
            "0",
        ),
        (
            ('ball = "tour"', 'ball = "tour"\n[rules.uncertainty]\ncarry = 1.0'),
            "rules.uncertainty.carry",
            "carry",
        ),
        (('ball = "tour"', 'ball = "tour"\n[analysis]\nreference = "tuor"'), "analysis.reference", "tuor"),
        (('ball = "tour"', 'ball = "tour"\n[balls.x]\nlike = "y"'), "balls.x.like", "y"),
        (('ball = "tour"', 'ball = "tour"\n[balls.x]\nlike = "tour"\nmass = 3'), "balls.x.mass", "3"),
        (('"range"]\nblocks = 4', '""]\nblocks = 4\n[balls.""]\nlike = "tour"'), "design.balls", '""'),
        (('"range"]\nblocks = 4', '" "]\nblocks = 4\n[balls." "]\nlike = "tour"'), "design.balls", '" "'),
        (('"range"]\nblocks = 4', '"a "]\nblocks = 4\n[balls."a "]\nlike = "tour"'), "design.balls", '"a "'),
        (("blocks = 4", 'blocks = 4\nclubs = [""]\n[clubs.""]\nlike = "driver"'), "design.clubs", '""'),
        (('balls = ["tour", "range"]', "balls = []"), "design.balls", "[]"),
        (('ball = "tour"', 'ball = "tour"\n[balls.x]\nlike = ["tour"]'), "balls.x.like", "['tour']"),
        (('ball = "tour"', 'ball = "tour"\n[gate]\nsources = []'), "gate.sources", "[]"),
        (('ball = "tour"', 'ball = "tour"\n[gate]\nsources = ["foo"]'), "gate.sources[0]", "foo"),
        (
            ('ball = "tour"', 'ball = "tour"\n[rules.uncertainty]\nlaunch_angle_deg = 0.1'),
            "rules.uncertainty.launch_angle_deg",
            "launch_angle_deg",
        ),
        (('ball = "tour"', 'ball = "tour"\n[items.tuor]'), "items.tuor", "tuor"),
        (
            ('ball = "tour"', 'ball = "tour"\n[items.tour]\nreceived = "20.12.2025"'),
            "items.tour.received",
            "20.12.2025",
        ),
        (
            (
                'ball = "tour"',
                'ball = "tour"\n[calibrations.m]\ninstrument = "x"\nuncertainty = {speed = 1.0}',
            ),
            "calibrations.m.uncertainty.speed",
            "speed",
        ),
    ],
)
def test_load_plan_mistake_reports_location(
    tmp_path: Path, configuration: Configuration, change: tuple[str, str], location: str, found: str
) -> None:
    assert change[0] in TWO
    faults = _faults(tmp_path, configuration, TWO.replace(*change))
    assert found in faults[location].found


@pytest.mark.parametrize(
    ("name", "change", "location", "found"),
    [
        ("symmetry", ('carry = "monitor"', 'carry = "reference"'), "analysis.carry", "pole and seam"),
        (
            "symmetry",
            ('quantity = "carry_m"', 'quantity = "total_m"'),
            "analysis.carry",
            "total_m is compared",
        ),
        ("clubs-split-plot", ('compare = "club"', 'compare = "ball"'), "design.hits_per_mounting", "balls"),
        ("clubs-split-plot", ("blocks = 5", "blocks = 1"), "design.blocks", "1"),
        ("clubs-split-plot", ("[gate]", '[control]\nball = "tour"\n[gate]'), "control.ball", "tour"),
    ],
)
def test_load_plan_mistake_in_shipped_plan_reports_location(
    tmp_path: Path,
    configuration: Configuration,
    name: str,
    change: tuple[str, str],
    location: str,
    found: str,
) -> None:
    text = (EXAMPLES / f"{name}.toml").read_text().replace(*change)
    ((place, fault),) = _faults(tmp_path, configuration, text).items()
    assert place == location
    assert found in fault.found


def test_reference_level_defaults_to_first_level(tmp_path: Path, configuration: Configuration) -> None:
    plain = _plan(tmp_path, configuration, TWO)
    named = _plan(tmp_path, configuration, f'{TWO}\n[analysis]\nreference = "range"\n')
    assert (reference_level(plain), reference_level(named)) == ("tour", "range")
    assert plan_from_record(plain.record(), "stored") == plain
    assert plan_from_record(named.record(), "stored") == named
    assert plain.digest != named.digest


def test_load_plan_reports_all_mistakes_at_once(tmp_path: Path, configuration: Configuration) -> None:
    text = TWO.replace('"range"', '"rnage"').replace('name = "two"', 'name = "T W O"')
    assert set(_faults(tmp_path, configuration, text)) == {"design.balls", "campaign.name"}


def test_load_plan_reports_key_and_value_mistakes_together(
    tmp_path: Path, configuration: Configuration
) -> None:
    wrong = TWO.replace('"range"', '"rnage"').replace("blocks = 4", 'blocks = "four"\nmany = 3')
    faults = _faults(
        tmp_path, configuration, wrong + '\n[stop]\ninterim_analyses = 0\n[preparation]\ndrivr = "x"\n'
    )
    assert set(faults) == {
        "design.balls",
        "design.blocks",
        "design.many",
        "stop.interim_analyses",
        "preparation.drivr",
    }


def test_require_swings_other_club_is_refused(tmp_path: Path, configuration: Configuration) -> None:
    plan = _plan(tmp_path, configuration, TWO.replace("blocks = 4", 'blocks = 4\nclubs = ["thesis"]'))
    with pytest.raises(ExceptionGroup) as caught:
        require_swings(plan, configuration)
    assert "'thesis'" in str(caught.value.exceptions[0])


def test_missing_club_change_includes_preparation_text(tmp_path: Path, configuration: Configuration) -> None:
    text = TWO.replace("blocks = 4", 'blocks = 4\nclubs = ["driver", "toe"]')
    text += '[clubs.toe]\nlike = "driver"\ntee_shift = 0.01\n[preparation]\ntoe = "Move the tee."\n'
    plan = _plan(tmp_path, configuration, text)
    texts = []
    for mounted, wanted in (("driver", "toe"), ("toe", "driver")):
        shot = PlannedShot(Role.TEST, 1, 1, 1, Arm("default", wanted, "tour"))
        needed = missing(plan, Fitting(mounted), Step(shot, 1, Centre()), 1, {})
        assert needed is not None
        texts.append(needed.text)
    assert texts == ["Mount club toe in place of driver. Move the tee.", "Mount club driver in place of toe."]
    (location,) = _faults(tmp_path, configuration, text.replace('toe = "Move', 'putter = "Move'))
    assert location.endswith("preparation.putter")


def test_require_swings_club_differing_only_in_loft_fits(
    tmp_path: Path, configuration: Configuration
) -> None:
    text = TWO.replace("blocks = 4", 'blocks = 4\nclubs = ["flat"]')
    plan = _plan(tmp_path, configuration, text + '[clubs.flat]\nlike = "driver"\nloft_deg = 8.0\n')
    assert require_swings(plan, configuration).keys() == {("default", "flat")}


def test_plan_from_record_restores_plan_and_digest(tmp_path: Path, configuration: Configuration) -> None:
    for name in campaign_names():
        plan = load_plan(Path(name), load_configuration(Path(VARIANTS.get(name, "shipped"))))
        again = plan_from_record(json.loads(json.dumps(plan.record())), "database")
        assert again == plan
        assert again.digest == plan.digest
    other = _plan(tmp_path, configuration, TWO)
    assert other.digest != _plan(tmp_path, configuration, TWO.replace("blocks = 4", "blocks = 5")).digest


def test_block_trials_are_complete_with_control_at_start_middle_end(
    configuration: Configuration,
) -> None:
    plan = load_plan(Path("ten-balls"), configuration)
    assert len(all_trials(plan)) == 3 * 20 * 13
    slow, middle, fast = sections(plan)
    assert [{arm.swing for arm in section.arms} for section in (slow, middle, fast)] == [
        {"driver-85mph"},
        {"driver-90mph"},
        {"default"},
    ]
    orders = set()
    for number in range(1, plan.design.blocks + 1):
        trials = block_trials(plan, slow, number)
        assert [trial.position for trial in trials] == list(range(1, len(trials) + 1))
        assert [t.position for t in trials if t.role is Role.CONTROL] == [1, 7, 13]
        tests = [t.arm.ball for t in trials if t.role is Role.TEST]
        assert sorted(tests) == sorted(plan.design.balls)
        orders.add(tuple(tests))
    assert len(orders) > 15


def test_all_trials_order_follows_seed_and_is_balanced(tmp_path: Path, configuration: Configuration) -> None:
    text = TWO.replace("blocks = 4", "blocks = 400\nseed = 3") + "[ball_handling]\nsamples = 1000\n"
    plan = _plan(tmp_path, configuration, text)
    again = _plan(tmp_path, configuration, text)
    other = _plan(tmp_path, configuration, text.replace("seed = 3", "seed = 4"))
    assert all_trials(plan) == all_trials(again)
    assert all_trials(plan) != all_trials(other)
    first = Counter(t.arm.ball for t in all_trials(plan) if t.position == 2)
    assert abs(first["tour"] - 200) < 60  # three standard errors


def test_sections_split_by_factors_not_compared(tmp_path: Path, configuration: Configuration) -> None:
    text = TWO.replace("blocks = 4", 'blocks = 2\ncompare = "club"\nclubs = ["driver", "flat"]')
    text += '[clubs.flat]\nlike = "driver"\nloft_deg = 8.0\n[warm_up]\nwindow = 2\nat_most = 3\n'
    plan = _plan(tmp_path, configuration, text)
    assert [section.name for section in sections(plan)] == ["default, tour", "default, range"]
    for trial in all_trials(plan):
        assert trial.role is Role.CONTROL or trial.arm.ball == ("tour", "range")[trial.section - 1]
    # Of the control ball, in each of two sections: two blocks of three, and a warm-up with each of two clubs.
    # Each compared ball: two blocks with two clubs.
    assert hits_needed(plan) == {"tour": 2 * (2 * 3 + 2 * 3) + 4, "range": 4}
    assert {trial.block for trial in all_trials(plan)} == {1, 2, 3, 4}


# Figures of the domain reference: n a ball for a standard deviation and a difference, normal approximation
# (two-sided 0.05, power 0.8); small numbers need one or two more.
@pytest.mark.parametrize(
    ("sd", "difference", "normal"),
    [(1.5, 1, 36), (1.5, 2, 9), (2.5, 1, 99), (2.5, 2, 25), (4, 2, 63), (6, 3, 63), (6, 5, 23)],
)
def test_blocks_needed_difference_matches_reference_sample_size(
    sd: float, difference: float, normal: int
) -> None:
    found = blocks_needed(lambda n: power_of_shift(difference / (sd * sqrt(2 / n)), n - 1, 0.05), 0.8)
    assert found is not None
    assert normal <= found <= normal + 3


def test_blocks_needed_equivalence_matches_reference_sample_size() -> None:
    for sd, normal in ((1.5, 10), (2.5, 27), (4.0, 69)):
        found = blocks_needed(
            lambda n, sd=sd: same_power_of_error(2.0, sd * sqrt(2 / n), n - 1, 0.05),  # type: ignore[misc]
            0.8,
        )
        assert found is not None
        assert normal <= found <= normal + 3


def test_power_of_shift_zero_is_alpha_and_large_is_one() -> None:
    assert power_of_shift(0.0, 9, 0.05) == pytest.approx(0.05)
    assert power_of_shift(100.0, 9, 0.05) == pytest.approx(1.0)
    assert same_power_of_error(0.1, 2.0 * sqrt(2 / 10), 9, 0.05) == 0.0
    assert same_power_of_error(2.0, sqrt(2 / 100), 99, 0.05, 2.0) == pytest.approx(0.05, abs=0.002)


def test_outlook_words_small_plan_reports_needed_shots(tmp_path: Path, configuration: Configuration) -> None:
    text = TWO + "[analysis]\nexpected_sd = 5.0\ntarget_difference = 1.0\n"
    words = " ".join(outlook_words(_plan(tmp_path, configuration, text)))
    assert "Not enough shots" in words
    assert str(outlook(_plan(tmp_path, configuration, text)).needed) in words


def test_rule_sets_are_dated_and_sourced() -> None:
    for rule in rule_sets().values():
        assert rule.begins < rule.ends
        assert rule.source
        assert rule.confidence in {"A", "B", "C"}
    standard = rule_sets()["ods-2004"]
    assert (standard.at_most, standard.unit, standard.scale) == (320.0, "yd", 0.9144)
    # At e = 0.77 and 450 us, by hand: 180.13 + 95.258 - 19.391 = 255.998 ft/s.
    assert control_ball_speed(0.77, 450e-6) == pytest.approx(255.998 * 0.3048, rel=1e-5)


def test_campaign_check_prints_order_and_json_holds_sequence() -> None:
    runner = CliRunner()
    shown = runner.invoke(app, ["--config", "shipped", "campaign", "check", "two-balls"])
    assert shown.exit_code == 0
    assert "order from seed 20261121" in shown.stdout
    result = runner.invoke(app, ["--config", "shipped", "campaign", "check", "two-balls", "--json"])
    record = json.loads(result.stdout)
    names = ("title", "needs", "needs_words", "free_bytes", "warnings", "series_warning")
    beside = {name: record.pop(name) for name in names}
    assert beside["free_bytes"] > 0
    plan = load_plan(Path("two-balls"), load_configuration(Path("shipped")))
    assert record["shots"] == len(record["sequence"]) == len(all_trials(plan))
    assert record == json.loads(json.dumps(preview_record(plan, {})))


def test_load_plan_club_of_other_variant_suggests_configuration(
    tmp_path: Path, configuration: Configuration
) -> None:
    faults = _faults(tmp_path, configuration, TWO.replace("blocks = 4", 'blocks = 4\nclubs = ["wood3"]'))
    assert "golfbench --config bag" in faults["design.clubs"].action
    faults = _faults(tmp_path, configuration, TWO.replace("blocks = 4", 'blocks = 4\nclubs = ["dirver"]'))
    assert faults["design.clubs"].action == "Did you mean driver?"
