"""The shipped configuration is complete and documented; every mistake is reported with its location."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import pi, radians
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.base.errors import BenchError
from bench.config import (
    VARIANTS,
    Configuration,
    find_configuration,
    load_configuration,
    shipped_configuration,
    unheard_phases,
)
from bench.config.files import configuration_text, default_tables
from bench.control.settings import MODEL_ROWS, build_controller
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from sim.ball import Ball
from sim.robot import Club

TEXT = configuration_text(load_configuration(shipped_configuration()))
SHIPPED = tomllib.loads(TEXT)

Overlay = Callable[[str], Path]


def faults(path: Path) -> list[BenchError]:
    try:
        load_configuration(path)
    except BenchError as error:
        return [error]
    except ExceptionGroup as group:
        return [fault for fault in group.exceptions if isinstance(fault, BenchError)]
    return []


def leaves(table: dict[str, Any], prefix: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*prefix, key))
        else:
            yield (*prefix, key), value


LEAVES = list(leaves(SHIPPED))


def setting(keys: tuple[str, ...], value: str) -> str:
    return f"[{'.'.join(keys[:-1])}]\n{keys[-1]} = {value}"


# The shipped files -----------------------------------------------------------------------------------


def test_configuration_text_loads_as_same_configuration(configuration: Configuration, tmp_path: Path) -> None:
    (tmp_path / "printed.toml").write_text(TEXT, encoding="utf-8")
    printed = load_configuration(tmp_path / "printed.toml")
    assert replace(printed, files=configuration.files).effective() == configuration.effective()
    assert "base" not in SHIPPED
    assert len(LEAVES) > 380


def test_shipped_config_toml_repeats_no_default(configuration: Configuration) -> None:
    given = tomllib.loads(shipped_configuration().read_text(encoding="utf-8"))
    assert given.pop("base") == "defaults"
    defaults = {keys for keys, _ in leaves(default_tables())}
    assert [keys for keys, _ in leaves(given) if keys in defaults] == []


def test_configuration_text_each_key_has_comment() -> None:
    above, bare = "", []
    for line in TEXT.splitlines():
        of_phases = any(f"{name} = [" in line for name in MODEL_ROWS)
        if "=" in line and not line.startswith("#") and "#" not in line and not of_phases:
            bare += [] if above.startswith("#") else [line]
        above = line
    assert bare == []


def test_configuration_text_shows_units_bounds_and_origins() -> None:
    for text in (
        "natural_frequency_hz = 100.0",
        "loft_deg = 15.0",
        "1 to 98",
        "assumption: 46 m/s at the ball need about 280 N m",
        '"off" or "prefer" or "require"',
    ):
        assert text in " ".join(TEXT.replace("\n# ", " ").split())


def test_shipped_balls_differ_by_1_to_2_percent_restitution(configuration: Configuration) -> None:
    tour, other = configuration.balls["tour"], configuration.balls["range"]
    assert 0.01 <= 1 - other.restitution_factor / tour.restitution_factor <= 0.02
    assert other.mass == tour.mass


@pytest.mark.parametrize("path", sorted(VARIANTS.glob("*.toml")), ids=lambda path: path.stem)
def test_variants_load_by_name(path: Path, configuration: Configuration) -> None:
    variant = load_configuration(Path(path.stem))
    assert variant != configuration
    assert [file.name for file in variant.files] == ["config.toml", path.name]


def test_variants_change_documented_values() -> None:
    small = load_configuration(Path("small_plant")).plant
    assert (small.shoulder.area_a, small.wrist.area_a, small.wrist_lever) == (3e-4, 12.57e-4, 0.05)
    assert {a.valve.conductance for a in small.actuators} == {5.4e-8}
    assert small.supply.pressure == 7e5
    wrist = load_configuration(Path("swing_through_wrist")).plant.wrist
    assert (wrist.lower, wrist.upper) == pytest.approx((2 * pi - radians(80), 2 * pi + radians(80)))


def test_find_configuration_without_name_prefers_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_configuration() == shipped_configuration()
    (tmp_path / "config.toml").write_text('base = "shipped"\n[bench]\nid = "here"\n')
    assert load_configuration().bench.id == "here"


def test_effective_configuration_is_plain_data(configuration: Configuration) -> None:
    effective = configuration.effective()
    assert effective["plant"]["wrist"]["stop"]["energy"] == 90.0
    assert effective["plant"]["wrist"]["stop"]["rated"] == 120.0
    assert effective["bench"]["data_dir"] == "data"


# Overlays --------------------------------------------------------------------------------------------


def test_overlay_changes_only_given_keys(overlay: Overlay, configuration: Configuration) -> None:
    found = load_configuration(overlay("[plant.wrist.stop]\ntravel = 0.16"))
    wanted = replace(configuration.plant.wrist, stop=replace(configuration.plant.wrist.stop, travel=0.16))
    assert found == replace(configuration, plant=replace(configuration.plant, wrist=wanted))


def test_overlay_degrees_and_hertz_equal_si_values(overlay: Overlay) -> None:
    degrees = load_configuration(overlay("[plant.shoulder]\nlower_deg = -90\n[loop]\nrate_hz = 2000"))
    plain = load_configuration(overlay(f"[plant.shoulder]\nlower = {radians(-90)!r}\n[loop]\nrate = 2000"))
    assert degrees == plain
    assert degrees.plant.tick == 0.0005


def test_overlay_si_value_replaces_base_in_degrees(overlay: Overlay) -> None:
    assert load_configuration(overlay("[clubs.driver]\nloft = 0.2")).plant.robot.club.loft == 0.2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("loft_deg = 0.2", "0.2, expected a finite number, 0 to 70 deg, none between 0 and 1.5."),
        ("loft_deg = 1.22", "none between 0 and 1.5"),  # a wedge of 70 degrees
        ("loft = 0.003", "none between 0 and 0.0261799"),
        ("bulge_radius = 12", "12.0, expected a finite number, 0.05 to 1e6 m, none between 2 and 10000."),
        ("roll_radius = 305.0", "none between 2 and 10000"),
    ],
)
def test_overlay_club_value_in_another_unit_is_refused(overlay: Overlay, text: str, words: str) -> None:
    (fault,) = faults(overlay(f"[clubs.driver]\n{text}"))
    assert words in str(fault)


@pytest.mark.parametrize("loft", [0.0, 1.5, 2.0, 3.5, 7.0])
def test_overlay_loft_of_plate_putter_and_driver_is_accepted(overlay: Overlay, loft: float) -> None:
    found = load_configuration(overlay(f"[clubs.driver]\nloft_deg = {loft}\nbulge_radius = 2.0"))
    assert found.plant.robot.club.loft == pytest.approx(radians(loft))


def test_overlay_of_overlay_overrides_values(overlay: Overlay, tmp_path: Path) -> None:
    overlay('[swing]\nball = "range"\n[bench]\nid = "one"')
    (tmp_path / "top.toml").write_text('base = "mine.toml"\n[bench]\nid = "two"\n')
    found = load_configuration(tmp_path / "top.toml")
    assert (found.bench.id, found.plant.ball.name) == ("two", "range")


def test_overlay_like_copies_ball_and_club(overlay: Overlay) -> None:
    ball = '[balls.soft]\nlike = "tour"\nrestitution_factor = 0.97\n'
    club = '[clubs.short]\nlike = "driver"\nloft_deg = 12\n'
    found = load_configuration(overlay(ball + club + '[swing]\nball = "soft"\nclub = "short"'))
    assert found.plant.ball == Ball(name="soft", restitution_factor=0.97)
    assert found.plant.robot.club == replace(Club.driver(), name="short", loft=radians(12))
    assert found.plant_with(ball="range", club="driver").ball.name == "range"
    with pytest.raises(BenchError, match=r"balls: found no \"hard\", expected one of tour, range, soft"):
        found.plant_with(ball="hard")


def test_configuration_without_base_missing_key_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bare.toml"
    path.write_text(TEXT.replace("pressure = 800000.0", ""))
    (fault,) = faults(path)
    assert fault.location == f"{path}: plant.supply.pressure"
    assert (fault.found, fault.expected) == ("nothing", "a finite number, 200000 to 1.2e6 Pa absolute")
    assert 'base = "shipped"' in fault.action


def test_overlay_like_unknown_entry_reports_like_and_own_keys_only(overlay: Overlay) -> None:
    found = faults(overlay('[balls.soft]\nlike = "tuor"\nmas = 0.045'))
    assert [fault.location.split(": ")[1] for fault in found] == ["balls.soft.like", "balls.soft.mas"]


def test_overlay_ball_without_like_missing_keys_are_refused(overlay: Overlay) -> None:
    found = faults(overlay("[balls.soft]\nmass = 0.045"))
    assert len(found) == 6
    assert {fault.found for fault in found} == {"nothing"}
    assert all('write like = "NAME"' in fault.action for fault in found)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('base = "none.toml"', '"none.toml", no such file'),
        ("base = 3", "3"),
        ('base = "loop.toml"', '"loop.toml"'),
    ],
)
def test_configuration_invalid_base_is_refused(text: str, found: str, tmp_path: Path) -> None:
    (tmp_path / "loop.toml").write_text(text)
    (fault,) = faults(tmp_path / "loop.toml")
    assert fault.location.endswith("loop.toml: base")
    assert fault.found == found


def test_configuration_base_accepts_variant_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('base = "small_plant"\n[bench]\nid = "here"\n')
    found = load_configuration(path)
    small = load_configuration(Path("small_plant"))
    assert found == replace(small, bench=replace(small.bench, id="here"))
    assert [file.name for file in found.files] == ["config.toml", "small_plant.toml", "mine.toml"]
    # A file of that name in the folder comes first.
    (tmp_path / "small_plant").write_text('base = "shipped"\n[bench]\nid = "mine"\n')
    path.write_text('base = "small_plant"\n')
    assert load_configuration(path).bench.id == "mine"


# Mistakes --------------------------------------------------------------------------------------------


def check_each(overlay: Overlay, bad: Callable[[tuple[str, ...], Any], str | None]) -> None:
    """Set every key of the shipped file to `bad` of key and value; assert that each is reported."""
    wrong = {".".join(keys): text for keys, value in LEAVES if (text := bad(keys, value)) is not None}
    path = overlay("\n".join(f"{key} = {text}" for key, text in wrong.items()))
    named = {fault.location.removeprefix(f"{path}: ").partition("[")[0] for fault in faults(path)}
    assert wrong.keys() - named == set()


def test_configuration_each_key_wrong_type_is_refused(overlay: Overlay) -> None:
    check_each(overlay, lambda _, value: "{ a = 1 }" if isinstance(value, str) else '"text"')


def test_configuration_each_number_nan_is_refused(overlay: Overlay) -> None:
    def bad(_: tuple[str, ...], value: Any) -> str | None:
        if isinstance(value, list):
            return str([*value[:-1], "NaN"]).replace("'NaN'", "nan")
        return "nan" if isinstance(value, int | float) and not isinstance(value, bool) else None

    check_each(overlay, bad)


@pytest.mark.parametrize("other", ["inf", "-inf", "true"])
def test_configuration_each_number_infinity_or_true_is_refused(other: str, overlay: Overlay) -> None:
    def bad(_: tuple[str, ...], value: Any) -> str | None:
        if isinstance(value, bool | str):
            return None
        return f"[{other}, 1.0, 1.0]" if isinstance(value, list) else other

    check_each(overlay, bad)


@pytest.mark.parametrize("value", ["-1e30", "1e30"])
def test_configuration_each_physical_value_out_of_range_is_refused(value: str, overlay: Overlay) -> None:
    settings_of_control = {"control", "lifecycle", "homing", "estimator", "envelope"}
    physical = [k for k, v in LEAVES if isinstance(v, float) and k[0] not in settings_of_control]
    assert len(physical) > 100
    check_each(overlay, lambda keys, _: value if keys in physical else None)


def test_configuration_negative_control_setting_is_refused(overlay: Overlay) -> None:
    sections = {"control", "lifecycle", "homing", "estimator", "envelope"}
    check_each(overlay, lambda k, v: "-1.0" if k[0] in sections and isinstance(v, float) else None)


def test_configuration_misspelt_key_suggests_correct_key(overlay: Overlay) -> None:
    every = [keys for keys, _ in LEAVES if not {"max_following_error", "model", "like"} & {*keys}]
    path = overlay("\n".join(f"{'.'.join(keys)}x = 1.0" for keys in every))
    found = {fault.location.removeprefix(f"{path}: "): fault for fault in faults(path)}
    assert found.keys() == {f"{'.'.join(keys)}x" for keys in every}
    for keys in every:
        fault = found[f"{'.'.join(keys)}x"]
        assert fault.found == "an unknown key"
        assert keys[-1].removesuffix("_deg").removesuffix("_hz") in fault.action


@pytest.mark.parametrize(
    ("text", "location", "found", "expected"),
    [
        ("[plant.supply]\npressure = 8", "plant.supply.pressure", "8", "200000 to 1.2e6 Pa absolute"),
        ("[clubs.driver]\nhead_mass = 200.0", "clubs.driver.head_mass", "200.0", "0.02 to 0.6 kg"),
        ("[clubs.driver]\nloft_deg = 95", "clubs.driver.loft_deg", "95", "0 to 70 deg"),
        ("[clubs.driver]\nloft = 10.5", "clubs.driver.loft", "10.5", "0 to 1.22173 rad"),
        ("[plant]\nseed = 1.5", "plant.seed", "1.5", "a whole number"),
        ("[plant]\nsubsteps = true", "plant.substeps", "true", "a whole number"),
        ('[loop]\nrealtime = "yes"', "loop.realtime", '"yes"', '"off" or "prefer" or "require"'),
        ("[control.pid]\nproportional = [1.0, 2.0]", "control.pid.proportional", "[1.0, 2.0]", "3 values"),
        ("[control.pid]\nproportional = [1, -2, 3]", "control.pid.proportional[1]", "-2", "at least 0"),
        ("[plant]\nwrist = 3", "plant.wrist", "3", "a table"),
        ("[plant.wrist_lever]\na = 3", "plant.wrist_lever", "a table", "a finite number"),
        ("[wind]\nvelocity = [0.0, 0.0, 99.0]", "wind", "contradictory values", "-60 to 60 m/s"),
        ("[plant.right_arm]\nupper_deg = 12", "plant.right_arm.upper_deg", "12", "a rod extension in m"),
        ("[plant.supply]\npressure_deg = 12", "plant.supply.pressure_deg", "pressure_deg", "Pa"),
        ("[clubs.driver]\nloft = 0.2\nloft_deg = 12", "clubs.driver.loft_deg", "also loft", "one of the two"),
        ('[clubs.x]\nlike = "iron7"', "clubs.x.like", '"iron7"', "one of driver, thesis"),
        ('[bench]\nid = "a/b"', "bench.id", '"a/b"', "letters"),
        ('[bench]\ncommissioned = "may"', "bench.commissioned", '"may"', "a time such as"),
        (
            '[bench]\ncommissioned = "2026-05-01T12:00"',
            "bench.commissioned",
            '"2026-05-01T12:00"',
            "a time such as",
        ),
        ('[swing]\nclub = "putter"', "swing.club", '"putter"', "one of driver, thesis, iron7"),
        ('[driver]\nname = "smi"', "driver.name", '"smi"', "one of canopen, daq, mock, sim"),
        (
            '[driver]\nname = "daq"\n[homing]\nmethod = "absolute"',
            "homing.method",
            '"absolute"',
            'with driver "daq" "index"',
        ),
        ('[launch_monitor]\naddress = "0.0.0.0"', "launch_monitor", "values", "open to the network"),
        ('[launch_monitor]\nclients = ["here"]', "launch_monitor", "values", "an IP address"),
        ('[daq]\nwatchdog_relay = "K1"', "daq", "values", "the line feeds the relay"),
        ("[plant.shoulder]\nlower = 2.9", "plant.shoulder.lower", "2.9, with upper 2.7", "less than upper"),
        ("[plant.shoulder]\nupper = 4.5", "plant.shoulder.upper", "rad of travel", "less than one turn"),
        ("[plant.wrist.friction]\nstatic = 20.0", "plant.wrist.friction.static", "20", "at least coulomb"),
        ("[plant.right_arm]\nupper = 0.25", "plant.right_arm.upper", "0.25 m", "0 to 0.22 m"),
        ("[plant.wrist]\nlower_deg = 271", "plant.wrist.lower_deg", "271.0 deg", "278.6 to 441.4 deg"),
        (
            "[plant]\nwrist_lever_angle_deg = 30\n[plant.wrist]\nlower_deg = 240",
            "plant.wrist.lower_deg",
            "240.0 deg",
            "248.6 to 411.4 deg",
        ),
        ("[plant]\nsubsteps = 2", "plant.substeps", "2, internal steps of 0.5 ms", "at least 4"),
        (
            "[plant]\nsubsteps = 64\n[plant.encoders]\nlatency = 0.002",
            "plant.encoders.latency",
            "0.002 s",
            "at most 0.00096875 s",
        ),
        (
            "[envelope]\nencoder_timeout = 0.0005",
            "envelope.encoder_timeout",
            "0.0005 s",
            "more than one tick",
        ),
        (
            "[envelope]\nencoder_timeout = 0.011",
            "envelope.encoder_timeout",
            "0.011 s",
            "at most envelope.max_tick_interval",
        ),
        (
            '[loop]\nrate_hz = 333\n[driver]\nname = "canopen"\n[plant]\nsubsteps = 13\n'
            "[envelope]\nencoder_timeout = 0.006",
            "envelope.encoder_timeout",
            "0.006 s at 333 Hz",
            "2.2 ticks, 0.00660661 s",
        ),
        (
            "[envelope]\nmax_supply_pressure = 8e5",
            "envelope.max_supply_pressure",
            "800000 Pa",
            "more than 800000",
        ),
        (
            "[envelope]\nmin_supply_pressure = 9e5",
            "envelope.min_supply_pressure",
            "900000 Pa",
            "less than 800000 Pa",
        ),
        (
            "[plant.supply]\nmanifold_relief_ratio = 1.05",
            "plant.supply.manifold_relief_ratio",
            "1.05, 840000 Pa",
            "at least 1.1",
        ),
        (
            "[plant.supply]\nmanifold_relief_ratio = 1.5",
            "plant.supply.manifold_relief_ratio",
            "1.5, 1.2e6 Pa",
            "less than the lowest pressure_rating, 1.2e6 Pa",
        ),
        ("[envelope]\nabsorber_travel_fraction = 1.5", "envelope.absorber_travel_fraction", "1.5", "up to 1"),
        (
            "[envelope.max_following_error]\nswing = [1, 1, 1]",
            "envelope.max_following_error.swing",
            "an unknown phase",
            "hold",
        ),
        ("[plant.site]\nball_y = -1.7", "plant.site.ball_y", "-1.7 m", "at least -1.6127 m"),
        ("[plant.site]\nball_y = -2.0\nground = -2.1", "plant.site.ball_y", "2.016 m", "at most 1.900 m"),
        ("[plant.right_arm.stop]\ntravel = 0.03", "plant.right_arm.stop.travel", "dead volume", "less than"),
        ("[plant.wrist.stop]\nenergy = 60.0", "plant.wrist.stop.energy", "120 J", "both in one file"),
        ("[plant.wrist]\npressure_rating = 5e5", "plant.wrist.pressure_rating", "500000", "800000 Pa"),
    ],
)
def test_configuration_error_names_location_found_and_expected(
    text: str, location: str, found: str, expected: str, overlay: Overlay
) -> None:
    path = overlay(text)
    fault = next(fault for fault in faults(path) if fault.location.endswith(f": {location}"))
    assert fault.location == f"{path}: {location}"
    assert found in fault.found
    assert expected in fault.expected
    assert fault.action


@pytest.mark.parametrize(
    "text", ["damping = [0.0, 0.0, 0.0]", "move_gain = [0.1, 0.1, 0.1]", "pid.integral = [0.5, 0.8, 0.3]"]
)
def test_configuration_hand_gain_with_machine_gains_is_refused(text: str, overlay: Overlay) -> None:
    key = text.partition(" ")[0]
    (fault,) = faults(overlay(f'[control]\ngains = "machine"\n{text}'))
    assert fault.location.endswith(f"control.{key}")
    assert fault.action == 'Delete it, or set control.gains = "hand".'
    assert faults(overlay(f'[control]\ngains = "hand"\n{text}')) == []


def test_overlay_machine_gains_replace_hand_gains_of_base(overlay: Overlay, tmp_path: Path) -> None:
    overlay('[control]\ngains = "hand"\ndamping = [0.0, 0.0, 0.0]')
    over = tmp_path / "over.toml"
    over.write_text('base = "mine.toml"\n[control]\ngains = "machine"\n')
    assert faults(over) == []
    over.write_text('base = "mine.toml"\n[control]\ngains = "machine"\nmove_gain = [0.1, 0.1, 0.1]\n')
    (fault,) = faults(over)
    assert fault.location == f"{over}: control.move_gain"


def test_configuration_errors_of_all_files_are_reported_together(overlay: Overlay, tmp_path: Path) -> None:
    lower = overlay("[air]\nhumidity = 0.5\n[loop]\nrate_hz = 5")
    upper = tmp_path / "upper.toml"
    upper.write_text('base = "mine.toml"\n[turf]\nfriction = -1.0\n')
    assert {fault.location for fault in faults(upper)} == {
        f"{lower}: air.humidity",
        f"{lower}: loop.rate_hz",
        f"{upper}: turf.friction",
    }


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"[loop\nrate_hz = 5", "invalid TOML: "),
        (b"a = 1\na = ?", "(at line 2, column 5)"),
        (b"a = 1\na = 2", "Cannot overwrite a value"),
        (b'id = "\xff"', "not UTF-8 at offset 6"),
        ('base = "shipped"'.encode("utf-16"), "text in UTF-16"),
        ('base = "shipped"'.encode("utf-16-le"), "text in UTF-16, without a byte order mark"),
        ('base = "shipped"'.encode("utf-16-be"), "text in UTF-16, without a byte order mark"),
        ('base = "shipped"'.encode("utf-32"), "text in UTF-32"),
        (b"a = " + 9999 * b"[", "nested too deep"),
    ],
)
def test_configuration_invalid_toml_reports_location(content: bytes, found: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(content)
    (fault,) = faults(path)
    assert fault.location == str(path)
    assert found in fault.found


def test_configuration_with_byte_order_mark_loads(tmp_path: Path, configuration: Configuration) -> None:
    path = tmp_path / "notepad.toml"
    path.write_bytes(b'\xef\xbb\xbfbase = "shipped"\r\n')
    assert load_configuration(path) == configuration


def test_configuration_without_working_directory_loads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, configuration: Configuration
) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert load_configuration() == configuration


def test_configuration_missing_file_lists_variants(tmp_path: Path) -> None:
    (fault,) = faults(tmp_path / "none.toml")
    assert fault.found == "no such file"
    for variant in ("shipped", "small_plant", "swing_through_wrist"):
        assert variant in fault.expected


def test_configuration_folder_is_refused(tmp_path: Path) -> None:
    (fault,) = faults(tmp_path)
    assert fault.found == "a folder, or an empty text"


def test_configuration_misspelt_variant_suggests_name() -> None:
    (fault,) = faults(Path("high_sped"))
    assert fault.action == "Did you mean high_speed?"


@pytest.mark.parametrize("text", ["", "[swing]\nball = 'two-piece'\n"])
def test_configuration_without_base_and_tables_is_one_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(text)
    (fault,) = faults(tmp_path / "own.toml")
    assert "tables missing, such as bench" in fault.found
    assert 'base = "shipped"' in fault.action


VALUES = st.one_of(
    st.integers().map(str),
    st.floats().map(repr),
    st.sampled_from(
        ['"x"', '""', "true", "[]", "{}", "[[1], 2]", "[{a = 1}]", "1979-05-27", "07:32:00", "1e400"]
    ),
)


@pytest.mark.parametrize("examples", [25, pytest.param(500, marks=pytest.mark.release)])
def test_configuration_any_value_loads_or_raises_bench_error(examples: int, overlay: Overlay) -> None:
    @settings(max_examples=examples)
    @given(leaf=st.sampled_from(LEAVES), value=VALUES)
    def check(leaf: tuple[tuple[str, ...], Any], value: str) -> None:
        path = overlay(setting(leaf[0], value))
        refused: list[Exception] = []
        try:
            load_configuration(path)
        except (BenchError, ExceptionGroup) as error:
            refused = list(error.exceptions) if isinstance(error, ExceptionGroup) else [error]
        assert all(isinstance(fault, BenchError) and fault.expected and fault.action for fault in refused)

    check()


# Faults and the model-based check ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "location"),
    [
        ('[faults.a]\nsignal = "no such"\nkind = "off"', "faults.a"),
        ('[faults.a]\nsignal = "club head"\nkind = "stuck"', "faults.a"),
        ('[faults.a]\nsignal = "clock"\nkind = "stuck"', "faults.a.signal"),
        ('[faults.a]\nsignal = "arm valve"\nkind = "delayed"\nvalue = 0.2', "faults.a.value"),
        ('[faults.a]\nsignal = "tee"\nkind = "off"\n[driver]\nname = "mock"', "faults.a"),
        ('[faults.a]\nsignal = "tee"\nkind = "off"\n[driver]\nname = "canopen"', "faults.a"),
        ("[envelope.model.air]\nswing = [1.0, 1.0, 1.0]", "envelope.model.air.swing"),
    ],
)
def test_configuration_invalid_fault_is_refused(overlay: Overlay, text: str, location: str) -> None:
    assert any(location in fault.location for fault in faults(overlay(text)))


def test_unheard_phases_plant_with_separate_clock_reports_fault_phase(overlay: Overlay) -> None:
    text = '[faults.a]\nsignal = "tee"\nkind = "off"\nphase = "top"\n[driver]\nname = "canopen"\n'
    configuration = load_configuration(overlay(text + '[canopen]\ninterface = "local_socket"'))
    (fault,) = unheard_phases(configuration)
    assert fault.location.endswith("faults.a.phase")
    assert '"sim"' in fault.action
    assert not unheard_phases(configuration.with_driver(replace(configuration.driver, name="sim")))


def test_configuration_fault_omitted_keys_use_defaults(overlay: Overlay) -> None:
    text = '[faults.a]\nsignal = "tee"\nkind = "off"\nphase = "top"'
    configuration = load_configuration(overlay(text))
    assert not unheard_phases(configuration)
    (fault,) = configuration.faults.values()
    assert (fault.name, fault.signal, fault.phase, fault.duration) == ("a", "tee", "top", 0.0)


def test_build_controller_lower_supply_lowers_supply_limit(overlay: Overlay) -> None:
    """The relief valve opens lower with it, and the limit of the supply follows."""
    c = load_configuration(overlay("[plant.supply]\npressure = 7.2e5"))
    profile = load_profile(find_profile("default"))
    record = build_controller(c.plant, profile, c.control, c.envelope, c.estimator).envelope[0]
    assert record["max_supply_pressure"] == c.plant.supply.manifold_relief_pressure == pytest.approx(7.92e5)


def test_model_check_simulated_is_off_with_other_driver(overlay: Overlay) -> None:
    simulated = '[envelope.model]\ncheck = "simulated"'
    assert load_configuration(overlay(simulated)).envelope.model.check == "simulated"
    mock = f'[driver]\nname = "mock"\n{simulated}'
    assert load_configuration(overlay(simulated)).running().envelope.model.check == "simulated"
    nodes = f'[driver]\nname = "canopen"\n[canopen]\ninterface = "local_socket"\n{simulated}'
    assert load_configuration(overlay(nodes)).running().envelope.model.check == "off"
    assert load_configuration(overlay(mock)).envelope.model.check == "off"
    always = '[driver]\nname = "mock"\n[envelope.model]\ncheck = "always"'
    assert load_configuration(overlay(always)).envelope.model.check == "always"
