"""Files of limits for the model-based check: stored, read back, stale, refused; which limits a bench uses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.config import load_configuration
from bench.control.estimate.residual_monitor import BRAKING, KINDS, LEARNING, SHOCK
from bench.control.residual_thresholds import (
    ENDING,
    FROM_SETTINGS,
    IGNORED_FIELDS,
    MIN_RELEVANT_TEE_SHIFT,
    REQUIRED,
    SHARE,
    TOLERANCES,
    LimitsFingerprint,
    ModelLimits,
    limits_in_use,
    limits_path,
    load_limits,
    save_limits,
)
from bench.control.settings import (
    ControlSettings,
    EnvelopeSettings,
    EstimatorSettings,
    ModelSettings,
    build_controller,
    for_learning,
    with_correction,
)
from bench.simulation.simulated_bench import Bench, Series
from bench.swing.correction import Correction
from bench.swing.library import find_profile
from bench.swing.profile import Profile
from sim.plant import PlantParameters
from tests.compiled_only import needs_speed

PLANT = PlantParameters()


def made_for(profile: Profile, **changed: Any) -> LimitsFingerprint:
    given: dict[str, Any] = {
        "plant": PLANT,
        "control": ControlSettings(),
        "envelope": EnvelopeSettings(),
        "estimator": EstimatorSettings(),
    } | changed
    return LimitsFingerprint.of(profile, **given)


@pytest.fixture
def limits(default_profile: Profile) -> ModelLimits:
    tables = {
        kind: {name: (k + 1.5, k + 2.25, k + 3.0) for name in sorted(REQUIRED)}
        | {"blow": (90.0, 91.0, 92.0), "braking_top": (50.0, 51.0, 52.0)}
        | {"learning_blow": (190.0, 191.0, 192.0), "learning_top": (70.0, 71.0, 72.0)}
        for k, kind in enumerate(KINDS)
    }
    return ModelLimits("default", 300, made_for(default_profile), tables)


@pytest.fixture
def file(limits: ModelLimits, tmp_path: Path) -> Path:
    path = limits_path(tmp_path / "default.toml")
    assert path.name == f"default{ENDING}"
    save_limits(path, limits)
    return path


def test_load_limits_returns_saved_limits(limits: ModelLimits, file: Path) -> None:
    assert load_limits(file) == limits


Edit = Callable[[str], str]


@pytest.mark.parametrize(
    ("edit", "location", "found"),
    [
        (lambda t: t.replace("limits/2", "limits/9"), "schema", '"golfbench-limits/9"'),
        (lambda t: t.replace("draws = 300\n", ""), "draws", "missing"),
        (lambda t: t.replace("draws = 300", "drows = 300"), "drows", "an unknown key"),
        (lambda t: t.replace("[flow]", "[flaw]"), "flaw", "an unknown key"),
        (lambda t: t.replace("made_for.plant", "made_for.planet"), "made_for", "planet"),
        (lambda t: t.replace("[made_for.plant]", "plant = 1\n[made_for.p]"), "made_for", "plant"),
        (lambda t: t.replace("hold = ", "held = ", 1), "air.held", "an unknown row"),
        (lambda t: t.replace("hold = [1.5, 2.25, 3.0]\n", "", 1), "air.hold", "missing"),
        (lambda t: t.replace("hold = [1.5, 2.25, 3.0]", "hold = [1.5, 2.25]", 1), "air.hold", "[1.5, 2.25]"),
        (lambda t: t.replace("hold = [1.5,", "hold = [0.0,", 1), "air.hold", "[0.0, 2.25, 3.0]"),
        (lambda t: t.replace("hold = [1.5,", "hold = [nan,", 1), "air.hold", "[nan, 2.25, 3.0]"),
        (lambda t: t.replace("hold = [1.5,", 'hold = ["1",', 1), "air.hold", "['1', 2.25, 3.0]"),
        (lambda t: t + "[", "", "invalid TOML"),
    ],
)
def test_load_limits_bad_file_reports_place(file: Path, edit: Edit, location: str, found: str) -> None:
    file.write_text(edit(file.read_text()))
    with pytest.raises(BenchError) as error:
        load_limits(file)
    assert str(file) in error.value.location
    assert error.value.location.endswith(location)
    assert found in error.value.found


def test_load_limits_missing_file_raises(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match="no such file"):
        load_limits(tmp_path / "no.limits.toml")


def test_limits_in_use_matching_file_applies_tables(limits: ModelLimits, file: Path) -> None:
    used = limits_in_use(ModelSettings(check="simulated"), limits.made_for, [file])
    assert (used.source, used.stale, used.settings.check) == (str(file), False, "simulated")
    for kind in KINDS:
        table = getattr(used.settings, kind)
        assert {row: table[row] for row in limits.tables[kind]} == limits.tables[kind]
        rest = {row: table[row] for row in table.keys() - limits.tables[kind].keys()}
        own = getattr(ModelSettings(), kind)
        assert rest == {row: own[row] for row in own.keys() & FROM_SETTINGS | {"arming"}}


def test_limits_in_use_resolved_settings_stay_unchanged(limits: ModelLimits, file: Path) -> None:
    used = limits_in_use(ModelSettings(check="always"), limits.made_for, [file])
    assert limits_in_use(used.settings, limits.made_for, []).settings == used.settings


def test_limits_in_use_configured_tables_take_precedence(limits: ModelLimits, file: Path) -> None:
    by_hand = replace(ModelSettings(check="always"), jump=ModelSettings().jump | {"hold": (1.0, 1.0, 1.0)})
    used = limits_in_use(by_hand, limits.made_for, [file])
    assert (used.settings, used.source) == (by_hand, "tables of the configuration")


def test_limits_in_use_without_file_keeps_default_tables(limits: ModelLimits, tmp_path: Path) -> None:
    used = limits_in_use(ModelSettings(check="always"), limits.made_for, [tmp_path / "none.limits.toml"])
    assert (used.settings, used.stale) == (ModelSettings(check="always"), False)
    assert "none were made for this profile" in used.source


@pytest.mark.parametrize(
    ("part", "changed"),
    [
        ("plant", {"plant": replace(PLANT, wrist_lever=0.9 * PLANT.wrist_lever)}),
        ("plant", {"plant": replace(PLANT, wrist_lever_angle=0.1)}),
        ("controller", {"control": ControlSettings(brake_timeout=1.4)}),
        ("controller", {"estimator": EstimatorSettings(noise=(1e-5, 0.0, 0.0))}),
        ("controller", {"envelope": EnvelopeSettings(max_slew=300.0)}),
    ],
)
def test_limits_in_use_stale_file_reports_part_and_keeps_defaults(
    default_profile: Profile, file: Path, part: str, changed: dict[str, Any]
) -> None:
    used = limits_in_use(ModelSettings(check="always"), made_for(default_profile, **changed), [file])
    assert (used.settings, used.stale) == (ModelSettings(check="always"), True)
    assert f"{file}: made for another {part} (" in used.source


def moved(plant: PlantParameters, by: float) -> PlantParameters:
    """Return `plant` with the measured values that drift most, each by `by` times its tolerance."""
    encoders = replace(
        plant.encoders, zero_count=(1.0, -700.0, 5e4), sign=(1, -1, -1), latency=1e-4 + by * 1e-4
    )
    club = replace(plant.robot.club, length_to_face=1.09 + 5e-4 * by, shaft_length=1.0668 - 5e-4 * by)
    valve = replace(plant.wrist.valve, centre=by * 0.005, conductance=7.9e-8 / (1 - by * SHARE))
    return replace(
        plant,
        robot=replace(plant.robot, club=club),
        encoders=encoders,
        wrist=replace(plant.wrist, valve=valve),
        site=replace(plant.site, ball_x=plant.site.ball_x - by * 0.005),
    )


def test_limits_in_use_drift_within_tolerance_stays_valid(default_profile: Profile, file: Path) -> None:
    for by in (-0.99, 0.2, 0.99):
        near = made_for(default_profile, plant=moved(PLANT, by))
        assert not limits_in_use(ModelSettings(), near, [file]).stale
    far = limits_in_use(ModelSettings(), made_for(default_profile, plant=moved(PLANT, 1.5)), [file])
    assert far.stale
    assert "wrist.valve.conductance 7.9e-08, here 8.14" in far.source
    assert "and 3 more" in far.source


def test_tolerances_and_ignored_fields_exist_in_plant(default_profile: Profile) -> None:
    nested = asdict(PLANT)
    for name in (*IGNORED_FIELDS, *TOLERANCES):
        value: Any = nested
        for part in name.split("."):
            value = value[part]
    assert TOLERANCES.keys() <= made_for(default_profile).plant.keys()


def test_limits_in_use_changed_profile_reports_stale(default_profile: Profile, file: Path) -> None:
    shifted = replace(default_profile, angle=default_profile.angle + 1e-6)
    assert "another profile" in limits_in_use(ModelSettings(), made_for(shifted), [file]).source


def test_limits_in_use_ball_seed_and_ratings_stay_valid(default_profile: Profile, file: Path) -> None:
    stop = replace(PLANT.wrist.stop, rated=PLANT.wrist.stop.rated + 10.0)
    plant = replace(
        PLANT, ball=replace(PLANT.ball, mass=0.04), seed=77, wrist=replace(PLANT.wrist, stop=stop)
    )
    assert not limits_in_use(ModelSettings(), made_for(default_profile, plant=plant), [file]).stale


def with_club(**changed: Any) -> PlantParameters:
    club = replace(PLANT.robot.club, **changed)
    return replace(PLANT, robot=replace(PLANT.robot, club=club))


def test_limits_in_use_small_tee_shift_and_club_name_stay_valid(default_profile: Profile, file: Path) -> None:
    """The face map's clubs are the driver at another place of the tee."""
    near = 0.99 * MIN_RELEVANT_TEE_SHIFT
    for plant in (with_club(name="toe", tee_shift=near), with_club(name="heel", tee_shift=-near)):
        assert not limits_in_use(ModelSettings(), made_for(default_profile, plant=plant), [file]).stale


@pytest.mark.parametrize(
    "changed",
    [
        {"tee_shift": MIN_RELEVANT_TEE_SHIFT},
        {"tee_shift": -MIN_RELEVANT_TEE_SHIFT},
        {"head_mass": 0.21},
        {"friction_factor": 0.5},
    ],
)
def test_limits_in_use_other_club_or_large_tee_shift_reports_stale(
    default_profile: Profile, file: Path, changed: dict[str, float]
) -> None:
    seen = limits_in_use(ModelSettings(), made_for(default_profile, plant=with_club(**changed)), [file])
    assert "another plant" in seen.source


@needs_speed
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_min_relevant_tee_shift_changes_velocity_within_third_of_limit(
    default_profile: Profile, side: float
) -> None:
    """The joints' speeds after the impact differ by less than a third of the comparison's tolerance."""
    c = load_configuration(Path("shipped")).for_profile(default_profile, find_profile("default"))
    bench = Bench.of(c, default_profile)
    speeds = []
    for shift in (0.0, side * MIN_RELEVANT_TEE_SHIFT):
        club = replace(c.plant.robot.club, tee_shift=shift)
        swing = Series(bench, replace(c.plant, robot=replace(c.plant.robot, club=club))).swing(
            default_profile
        )
        assert not swing.cause
        speeds.append(swing.cycles["plant_velocity"][default_profile.begins[5] :][:60])
    allowed = np.array(c.envelope.model.velocity["impact"])
    assert np.all(np.abs(speeds[1] - speeds[0]).max(axis=0) < allowed / 3.0)


def test_limits_fingerprint_turf_lift_counts_on_turf_only(default_profile: Profile) -> None:
    turf = replace(PLANT, site=replace(PLANT.site, surface="turf"))
    without = ControlSettings(turf_lift_gain=0.0)
    assert made_for(default_profile, control=without) == made_for(default_profile)
    assert made_for(default_profile, plant=turf, control=without) != made_for(default_profile, plant=turf)


def test_limits_in_use_several_files_uses_first_match(
    limits: ModelLimits, file: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other.limits.toml"
    save_limits(other, replace(limits, made_for=limits.made_for._replace(plant={"wrist_lever": 1.0})))
    assert limits_in_use(ModelSettings(), limits.made_for, [other, file]).source == str(file)


# What the controller makes of them -------------------------------------------------------------------


def test_build_controller_limits_fill_model_rows(
    default_profile: Profile, limits: ModelLimits, file: Path
) -> None:
    settings = limits_in_use(ModelSettings(check="always"), limits.made_for, [file]).settings
    envelope = EnvelopeSettings(model=settings)
    made = build_controller(PLANT, default_profile, envelope=envelope)
    model = made.model[0]
    assert (bool(model["check"]), int(model["first_row"])) == (True, 0)
    assert model["air"][Phase.TOP].tolist() == [1.5, 2.25, 3.0]
    assert model["air"][BRAKING + Phase.TOP].tolist() == [50.0, 51.0, 52.0]
    assert model["air"][BRAKING + Phase.HOLD].tolist() == [1.5, 2.25, 3.0]  # not given: as its phase
    assert model["air"][SHOCK].tolist() == [90.0, 91.0, 92.0]
    assert model["air"][LEARNING + Phase.TOP].tolist() == [70.0, 71.0, 72.0]
    assert model["air"][LEARNING + SHOCK].tolist() == [190.0, 191.0, 192.0]
    shift = 0.0 * default_profile.angle
    corrected = Correction(shift, shift, shift).applied_to(default_profile)
    learned = with_correction(made, corrected, ControlSettings(), envelope, PLANT)
    assert learned.model["first_row"][0] == LEARNING
    back = with_correction(learned, default_profile, ControlSettings(), envelope, PLANT)
    assert back.model["first_row"][0] == 0
    assert build_controller(PLANT, corrected, envelope=envelope).model["first_row"][0] == LEARNING
    teaching = for_learning(made, settings).model[0]
    assert (bool(teaching["check"]), int(teaching["first_row"])) == (True, LEARNING)


def test_for_learning_default_tables_check_only_if_always(default_profile: Profile) -> None:
    settings = ModelSettings(check="always")
    made = build_controller(PLANT, default_profile, envelope=EnvelopeSettings(model=settings))
    teaching = for_learning(made, settings).model[0]
    assert (bool(teaching["check"]), int(teaching["first_row"])) == (True, 0)
    assert not for_learning(made, replace(settings, check="simulated")).model["check"][0]
    model, follow_through = made.model[0], Phase.FOLLOW_THROUGH
    assert (model["velocity"][SHOCK] == model["velocity"][follow_through]).all()
    assert (model["jump"][SHOCK] == model["jump"][follow_through]).all()
    assert (model["air"][SHOCK] == model["air"][follow_through]).all()
