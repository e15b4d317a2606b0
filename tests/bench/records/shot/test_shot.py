from __future__ import annotations

import csv
from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bench.records.shot.shot import Shot, ShotStatus, shot_table_text
from tests.bench.records.shot.read_shots import KINDS, read_shot_table

HEADER = (
    "shot,block,position,club,ball,status,reason,club_speed_mps,attack_angle_deg,club_path_deg,"
    "face_angle_deg,dynamic_loft_deg,strike_x_mm,strike_y_mm,ball_speed_mps,launch_angle_deg,direction_deg,"
    "spin_rpm,spin_axis_deg,carry_m,total_m,apex_m,landing_angle_deg,delivery_source,launch_source,"
    "carry_source,time_utc,carry_side_m,swing,role,section,attempt,sample,air_temperature_k,air_pressure_pa,"
    "relative_humidity,carry_reference_m,carry_monitor_m,carry_measured_m,carry_measured_error_m,flight_source,"
    "gate_figure"
)
SHOT = Shot(1, 1, 1, "driver", "A", ShotStatus.VALID, time_utc=datetime(2026, 11, 1, 9, 30, tzinfo=UTC))

_text = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)


def _value(kind: type, optional: bool) -> st.SearchStrategy[Any]:
    kinds = {
        int: st.integers(0, 10**6),
        float: st.floats(allow_nan=False, allow_infinity=False),
        str: _text,
        datetime: st.datetimes(
            min_value=datetime(1, 1, 2),  # the calendar's first hours east of Greenwich have no time in UTC
            timezones=st.sampled_from([UTC, timezone(timedelta(hours=2))]),
        ),
    }
    return st.none() | kinds[kind] if optional else kinds[kind]


_OTHERS = {name: _value(*kind) for name, kind in KINDS.items() if name not in ("status", "reason")}
_FATES = st.just((ShotStatus.VALID, "")) | st.tuples(
    st.sampled_from([ShotStatus.EXCLUDED, ShotStatus.FAILED]), _text.filter(bool)
)
shots = st.builds(
    lambda others, fate: Shot(**others, status=fate[0], reason=fate[1]),
    st.fixed_dictionaries(_OTHERS),
    _FATES,
)


@settings(deadline=None)
@given(st.lists(shots, max_size=4))
def test_shot_table_text_restores_every_shot(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Shot]
) -> None:
    path = tmp_path_factory.mktemp("table") / "shots.csv"
    path.write_bytes(shot_table_text(rows).encode())
    assert read_shot_table(path) == rows


def test_shot_table_text_header_matches_export_columns() -> None:
    assert shot_table_text([SHOT]).split("\r\n")[0] == HEADER


def test_shot_table_text_uses_crlf_and_plain_decimal_numbers() -> None:
    shot = Shot(2, 1, 1, 'the "old" one', "A, soft", ShotStatus.VALID, spin_axis_deg=1e-7, carry_m=212.0)
    text = shot_table_text([shot])
    assert text.count("\r\n") == text.count("\n") == 2
    assert '"the ""old"" one","A, soft"' in text
    assert ",0.0000001,212.0," in text


@pytest.mark.parametrize("name", ["=1+1", "+A", "-A", "@A", "\tA", "'=A", "''=A"])
def test_shot_table_text_escapes_spreadsheet_formulas(tmp_path: Path, name: str) -> None:
    shot = replace(SHOT, ball=name, status=ShotStatus.EXCLUDED, reason=name)
    (tmp_path / "shots.csv").write_bytes(shot_table_text([shot]).encode())
    with (tmp_path / "shots.csv").open(encoding="utf-8", newline="") as stream:
        row = next(csv.DictReader(stream))
    assert row["ball"] == row["reason"] == f"'{name}"
    assert read_shot_table(tmp_path / "shots.csv") == [shot]


def test_shot_table_text_negative_number_is_not_escaped() -> None:
    assert ",-1.5," in shot_table_text([replace(SHOT, club_path_deg=-1.5)])


def test_shot_table_text_converts_times_to_utc() -> None:
    late = datetime(2026, 11, 1, 1, 30, tzinfo=timezone(timedelta(hours=2)))
    shot = Shot(1, 1, 1, "c", "b", ShotStatus.VALID, time_utc=late)
    assert ",2026-10-31T23:30:00.000000Z,," in shot_table_text([shot])


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"carry_m": float("nan")}, "carry_m"),
        ({"spin_rpm": float("inf")}, "spin_rpm"),
        ({"time_utc": datetime(2026, 1, 1)}, "time zone"),
        ({"status": ShotStatus.EXCLUDED}, "reason"),
        ({"reason": "late"}, "reason"),
    ],
)
def test_shot_invalid_value_raises_error(change: dict[str, Any], match: str) -> None:
    values: dict[str, Any] = {"status": ShotStatus.VALID} | change
    with pytest.raises(ValueError, match=match):
        Shot(1, 1, 1, "driver", "A", **values)
