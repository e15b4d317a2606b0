"""Profiles: a saved profile loads unchanged, and an invalid one is refused with its location."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields, replace
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import parquet as pq

from bench.base.errors import BenchError
from bench.base.lifecycle import Phase
from bench.control.moves.pressure_plan import planned_air
from bench.swing.correction import digest_of
from bench.swing.library import find_profile, profile_names
from bench.swing.profile import (
    FollowedGolfer,
    Profile,
    as_written,
    decode_table,
    encode_table,
    load_profile,
    profile_text,
    save_profile,
)
from sim.plant import PlantParameters

TABLES = ("angle", "velocity", "valve", "blind_brake")
FOLLOWED: FollowedGolfer = {
    "sha256": "5e1f",
    "follow": "club",
    "head_speed_mps": 43.8,
    "deviation": [0.045, 0.04, 0.053, 0.034],
    "rms_rad": [0.099, 0.023, 0.091],
    "rms_head_m": 0.083,
    "definition": 'root mean square, "aligned" at the ball',
}


@pytest.fixture(scope="module")
def short(slow_swing: Profile) -> Profile:
    """Fifty samples of the slow swing, quick to write and read."""
    return replace(
        slow_swing,
        angle=slow_swing.angle[::40],
        velocity=slow_swing.velocity[::40],
        valve=slow_swing.valve[::40],
        begins=(0, 1, 10, 12, 22, 24, 26),
        impact_time=0.025,
        blind_spacing=10,
        blind_brake=slow_swing.blind_brake[:5],
        followed=FOLLOWED,
    )


@pytest.fixture
def path(short: Profile, tmp_path: Path) -> Path:
    """Write the short swing as a pair of files, and return the TOML one."""
    save_profile(tmp_path / "short.toml", short)
    return tmp_path / "short.toml"


@pytest.fixture
def one_file(short: Profile, tmp_path: Path) -> Path:
    """Write the short swing as one TOML file with its tables."""
    (tmp_path / "one.toml").write_text(profile_text(short))
    return tmp_path / "one.toml"


def bits(profile: Profile) -> list[bytes]:
    return [getattr(profile, name).tobytes() for name in TABLES]


@pytest.mark.parametrize("form", ["path", "one_file"])
def test_load_profile_returns_saved_profile(
    form: str, short: Profile, request: pytest.FixtureRequest
) -> None:
    found = load_profile(request.getfixturevalue(form))
    for field in fields(Profile):
        if field.name not in TABLES:
            assert getattr(found, field.name) == getattr(short, field.name)
    for name, error in zip(TABLES, (5.1e-7, 5.1e-5, 5.1e-6, 5.1e-5), strict=True):
        np.testing.assert_allclose(getattr(found, name), getattr(short, name), rtol=0, atol=error)


def test_save_profile_of_loaded_profile_changes_nothing(path: Path, tmp_path: Path) -> None:
    save_profile(tmp_path / "again.toml", load_profile(path))
    found, wanted = (tmp_path / "again.toml").read_text(), path.read_text()
    assert found.replace("again.parquet", "short.parquet") == wanted
    assert (tmp_path / "again.parquet").read_bytes() == path.with_suffix(".parquet").read_bytes()


def test_load_profile_pair_and_one_file_hold_same_bits(path: Path, one_file: Path, short: Profile) -> None:
    pair, whole = load_profile(path), load_profile(one_file)
    assert bits(pair) == bits(whole) == bits(as_written(short))
    assert profile_text(pair) == one_file.read_text()


@pytest.mark.parametrize("name", profile_names())
def test_profile_text_of_shipped_profile_keeps_bits(name: str, tmp_path: Path) -> None:
    shipped = load_profile(find_profile(name))
    (tmp_path / "text.toml").write_text(profile_text(shipped))
    assert bits(load_profile(tmp_path / "text.toml")) == bits(shipped)


@settings(max_examples=50, deadline=None)
@given(
    rows=st.lists(st.tuples(*[st.floats(-100, 100)] * 12), min_size=1, max_size=40),
    spacing=st.integers(1, 50),
)
def test_encode_table_round_trip_is_bit_exact(rows: list[tuple[float, ...]], spacing: int) -> None:
    values = np.array(rows)
    tables = {
        "angle": np.round(values[:, :3] / 10, 6),
        "velocity": np.round(values[:, 3:6], 4),
        "valve": np.round(values[:, 6:9] / 100, 5),
        "blind_brake": np.round(np.hstack([values[::spacing, 9:12]] * 2), 4),
    }
    tables["valve"][0] = -0.0
    tables["blind_brake"][0, 0] = -0.0
    found = decode_table(encode_table(tables, spacing), spacing)
    assert {key: table.tobytes() for key, table in found.items()} == {
        key: table.tobytes() for key, table in tables.items()
    }


def test_load_profile_changed_table_names_both_digests(path: Path) -> None:
    table = path.with_suffix(".parquet")
    wanted = re.search(r'table_sha256 = "(\w+)"', path.read_text())
    assert wanted is not None
    content = bytearray(table.read_bytes())
    content[100] ^= 1
    table.write_bytes(content)
    with pytest.raises(BenchError) as raised:
        load_profile(path)
    assert raised.value.location == str(table)
    assert raised.value.found == f"SHA-256 {sha256(content).hexdigest()}"
    assert wanted[1][:50] in raised.value.expected
    assert f"as {path} says" in raised.value.expected
    assert "Copy both files" in raised.value.action


def test_load_profile_missing_or_foreign_table_is_refused(path: Path) -> None:
    table, text = path.with_suffix(".parquet"), path.read_text()

    def refused(content: bytes) -> BenchError:
        table.write_bytes(content)
        digest = f'table_sha256 = "{sha256(content).hexdigest()}"'
        path.write_text(re.sub("table_sha256 = .*", digest, text))
        with pytest.raises(BenchError) as raised:
            load_profile(path)
        return raised.value

    def parquet_of(columns: dict[str, object]) -> bytes:
        file = BytesIO()
        pq.write_table(pa.table(columns), file)
        return file.getvalue()

    found = refused(b"no table")
    assert found.location == str(table)
    assert found.found.startswith("no Parquet file: ")
    assert refused(parquet_of({"a": [1]})).found == "no column angle_shoulder_rad"
    names = ("shoulder", "arm", "wrist")
    floats = parquet_of({f"angle_{name}_rad": [0.5] for name in names})
    assert refused(floats).found == "column angle_shoulder_rad of type double, not decimal"
    table.unlink()
    with pytest.raises(BenchError, match=r"short\.parquet: found no such file, expected the table of"):
        load_profile(path)
    path.write_text(text.replace("begins =", "valve = [[0.0, 0.0, 0.0]]\nbegins ="))
    with pytest.raises(BenchError, match=r"valve: found a key, expected table, table_sha256 in"):
        load_profile(path)
    path.write_text(text.replace('table = "short.parquet"', 'table = "."'))
    with pytest.raises(BenchError, match="Is a directory"):
        load_profile(path)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.text(st.characters(codec="utf-8"), max_size=40))
def test_save_profile_any_text_is_kept(text: str, short: Profile, tmp_path: Path) -> None:
    save_profile(tmp_path / "text.toml", replace(short, text=text))
    assert load_profile(tmp_path / "text.toml").text == text


def test_phase_of_matches_phase_starts(short: Profile) -> None:
    wanted = [Phase.HOLD, Phase.BACKSWING, Phase.TOP, Phase.IMPACT, Phase.FOLLOW_THROUGH]
    assert [short.phase_of(k) for k in (0, 1, 11, 24, 49)] == wanted
    assert list(short.phases) == [short.phase_of(k) for k in range(len(short.angle))]


AIR = (6.1e5, 5.9e5, 5.6e5, 6.4e5, 5.5e5, 6.5e5)


@pytest.mark.parametrize("save", [save_profile, lambda path, profile: path.write_text(profile_text(profile))])
def test_save_profile_keeps_planned_pressures(
    save: Callable[[Path, Profile], object], short: Profile, tmp_path: Path
) -> None:
    planned = replace(short, air=AIR, air_supply=8e5)
    save(tmp_path / "air.toml", planned)
    found = load_profile(tmp_path / "air.toml")
    assert (found.air, found.air_supply) == (AIR, 8e5)
    assert digest_of(found) == digest_of(as_written(planned)) != digest_of(as_written(short))


def test_shipped_profile_air_matches_planned_air() -> None:
    profile, plant = load_profile(find_profile("default")), PlantParameters()
    assert profile.air == pytest.approx(planned_air(plant, profile.angle[0]), rel=1e-6)
    assert profile.air_supply == plant.supply.pressure


def test_save_profile_without_planned_pressures_omits_address(tmp_path: Path) -> None:
    planned = load_profile(find_profile("default"))
    file = tmp_path / "free.toml"
    save_profile(file, replace(planned, air=(), air_supply=0.0))
    assert "[address]" not in file.read_text()
    assert load_profile(file).air == ()


GOOD_ADDRESS = {"supply_pressure_pa": "8e5", "chamber_pressures_pa": f"{list(AIR)}"}


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("other", "1.0", "chamber_pressures_pa"),
        ("supply_pressure_pa", None, "a finite number, 100000 to 2e6 Pa absolute"),
        *(("supply_pressure_pa", bad, "2e6 Pa absolute") for bad in ('"8 bar"', "nan", "[8e5]", "8.0")),
        ("", f"{[*AIR[:5], 8.1e5]}", "less than the supply's"),
        *(("chamber_pressures_pa", bad, "6 values in brackets") for bad in ("5.9e5", "[5.9e5]")),
        *(("chamber_pressures_pa[5]", f"[{'5e5, ' * 5}{bad}]", "2e6 Pa absolute") for bad in ("inf", "true")),
    ],
)
def test_load_profile_invalid_planned_pressures_are_refused(
    key: str, value: str | None, expected: str, one_file: Path
) -> None:
    changed = key.partition("[")[0] or "chamber_pressures_pa"
    table = {name: text for name, text in (GOOD_ADDRESS | {changed: value}).items() if text}
    lines = "\n".join(f"{name} = {text}" for name, text in table.items())
    one_file.write_text(f"{one_file.read_text()}\n[address]\n{lines}\n")
    with pytest.raises(BenchError) as raised:
        load_profile(one_file)
    assert raised.value.location == f"{one_file}: address.{key}".rstrip(".")
    assert expected in raised.value.expected
    assert "profile address" in raised.value.action


ROW = r"angle_rad = \[\n  \[[^\]]*\]"


@pytest.mark.parametrize(
    ("pattern", "text", "location", "found", "expected"),
    [
        ('golfer = "nobody"', 'golfr = "nobody"', "golfr", "an unknown key", "golfer"),
        ('golfer = "nobody"\n', "", "golfer", "nothing", "a text in quotes"),
        ('golfer = "nobody"', "golfer = 3", "golfer", "3", "a text"),
        ('schema = "[^"]*"', 'schema = "other/7"', "schema", '"other/7"', "golfbench-profile/1"),
        ("period_s = 0.001", 'period_s = "fast"', "period_s", '"fast"', "0.0001 to 0.02 s"),
        ("period_s = 0.001", "period_s = nan", "period_s", "nan", "finite"),
        ("period_s = 0.001", "period_s = 1.0", "period_s", "1", "0.0001 to 0.02 s"),
        ("impact_time_s = 0.025", "impact_time_s = nan", "impact_time_s", "nan", "finite"),
        ("impact_time_s = 0.025", "impact_time_s = 7.0", "impact_time_s", "7", "within the swing"),
        ('schema = "[^"]*"', 'schema = "golfbench-profile/2"', "table", "nothing", "table, table_sha256 in"),
        ("blind_spacing = 10", "blind_spacing = 0", "blind_spacing", "0", "at least 1"),
        ("blind_spacing = 10", "blind_spacing = true", "blind_spacing", "true", "whole number"),
        ("blind_spacing = 10", "blind_spacing = 20", "blind_brake", "shape (5, 6)", "shape (3, 6)"),
        (ROW, "angle_rad = [\n  [1.0, 2.0]", "angle_rad[0]", "[1.0, 2.0]", "3 values"),
        (ROW, 'angle_rad = [\n  ["1", "2", "3"]', "angle_rad[0][0]", '"1"', "number"),
        (ROW, "angle_rad = [\n  [true, true, true]", "angle_rad[0][0]", "true", "number"),
        (ROW, "angle_rad = [\n  [nan, 2.0, 3.0]", "angle_rad[0][0]", "nan", "a finite number"),
        (ROW, "angle_rad = [\n  [1.0, inf, 3.0]", "angle_rad[0][1]", "inf", "a finite number"),
        (ROW, "angle_rad = [\n  [1.0, 200.0, 3.0]", "angle_rad", "200", "-10 to 10 rad"),
        (ROW + ",", "angle_rad = [", "velocity_rad_per_s", "shape (50, 3)", "shape (49, 3)"),
        (r"valve = \[\n  \[0\.00000", "valve = [\n  [1.5", "valve", "1.5", "openings -1 to 1"),
        (r"begins = \[0, 1", "begins = [0, 60", "begins", "(0, 60", "rising samples"),
        (r"begins = \[0, 1", "begins = [0, 1.5", "begins[1]", "1.5", "a whole number"),
        (r"begins = \[0, 1,", "begins = [0,", "begins", "[0, 10", "7 values"),
        (r"ball_m = \[", "ball_m = [9", "ball_m[0]", "90.25", "-3 to 3 m"),
        ("head_speed_mps = 0.7", 'head_speed_mps = "fast"', "delivery.head_speed_mps", "fast", "a number"),
        ("head_speed_mps = 0.7", "head_speed_mps = inf", "delivery.head_speed_mps", "Infinity", "a number"),
        ('follow = "club"', 'follow = "hands"', "followed.follow", "hands", "body, club"),
        (r"deviation = \[0.045, ", "deviation = [", "followed.deviation", "[0.04, ", "an array"),
        ("head_speed_mps = 43.8", "head_speed_mps = nan", "followed.head_speed_mps", "NaN", "a number"),
        ('sha256 = "5e1f"\n', "", "followed.sha256", "nothing", "this key"),
    ],
)
def test_load_profile_invalid_key_names_location(
    pattern: str, text: str, location: str, found: str, expected: str, one_file: Path
) -> None:
    good = one_file.read_text()
    bad = re.sub(pattern, text.replace("\\", r"\\"), good, count=1)
    assert bad != good
    one_file.write_text(bad)
    with pytest.raises(BenchError) as raised:
        load_profile(one_file)
    assert raised.value.location == f"{one_file}: {location}"
    assert found in raised.value.found
    assert expected in raised.value.expected
    assert raised.value.action


def test_load_profile_missing_file_or_invalid_toml_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BenchError, match=r"none\.toml: found no such file, expected a swing profile"):
        load_profile(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("angle_rad = [[1,\n2")
    with pytest.raises(BenchError, match=r"bad\.toml: found invalid TOML: .*at end of document"):
        load_profile(tmp_path / "bad.toml")
