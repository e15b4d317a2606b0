"""Tables of flights as people and devices write them: understood, or refused by what they are."""

from __future__ import annotations

from math import pi, radians
from pathlib import Path

import pytest

from bench.base.errors import BenchError
from bench.calibration.flight_table import FlightTable, read_flights
from sim.ball import Air

ROOT = Path(__file__).parents[3]
HEADER = "ball_speed_mph,launch_angle_deg,spin_rpm,carry_yd"
FLIGHT = "171,10.4,2545,282"
# Columns as in exports of TPS; the figures are made up.
TRACKMAN = """sep=,
Date,Club,Ball Speed,Launch Angle,Launch Direction,Spin Rate,Spin Rate Type,Spin Axis,Max Height - Height,\
Carry Flat - Length,Carry Flat - Side,Carry Flat - Time,Carry (Sim),Use In Stat
,,[mph],[deg],[deg],[rpm],[],[deg],[ft],[yds],[yds],[s],[yds],
10/1/2026 1:02:03 PM,Driver,171,10.4,-0.4,2545,Measured,1.2,105.3,282.1,3.1,6.4,283,TRUE
10/1/2026 1:03:03 PM,Driver,165,10.6,-0.4,2645,Estimated,1.2,105.3,272.1,3.1,6.4,273,TRUE
10/1/2026 1:04:03 PM,Driver,160,10.8,-0.4,2745,Measured,1.2,105.3,262.1,3.1,6.4,263,FALSE
"""
# Of FSX 2020, LastShot.CSV.
FORESIGHT = """Shot ID, Club, Ball Speed (m/s), Launch Angle (deg), Azimuth (deg), Side Spin (rpm), \
Back Spin (rpm), Total Spin (rpm), Carry (m), Offline (m), Peak Height (m), Lie (deg),
1, 1w, 76.44384, 10.4, 0.6, 100, 2000, 2545, 257.9, 0.0, 16777215.000000, 16777215.000000,
"""
# Of an FSX session: blocks by club, each with its header and its averages.
SESSION = """Ann,Shot Analysis

,Date,Time,Carry (yd),Peak Height (ft),Offline (yd),Ball Speed (mph),Launch Angle (deg),\
Launch Direction (deg),Total Spin (rpm),Spin Axis Tilt (deg)
Dr,,,
1,06/24/2026,3:35:37 PM Central,282,105,3.4 L,171,10.4,1.2 R,2545,3.4L
Average,,,282,105,3.4 L,171,10.4,1.2 R,2545,3.4L
Std. Dev.,,,1,1,1,1,1,1,1,1

,Date,Time,Carry (yd),Peak Height (ft),Offline (yd),Ball Speed (mph),Launch Angle (deg),\
Launch Direction (deg),Total Spin (rpm),Spin Axis Tilt (deg)
9i
1,06/24/2026,3:36:37 PM Central,148,96,3.4 L,109,20.4,1.2 R,8647,3.4L
"""
GERMAN = "Datum;Ball Speed (km/h);Launch Angle;Spin Rate;Carry Distance (m)\n1.2.26;275,2;10,4;2545;257,9\n"


def read(folder: Path, text: str | bytes) -> FlightTable:
    file = folder / "flights.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_flights(file)


def test_read_flights_trackman_export_converts_units(tmp_path: Path) -> None:
    (flight,), notes = read(tmp_path, TRACKMAN)
    assert flight.launch == pytest.approx(
        (171 * 0.44704, radians(10.4), radians(-0.4), 2545 * pi / 30, radians(1.2))
    )
    assert (flight.carry, flight.apex, flight.time) == pytest.approx((282.1 * 0.9144, 105.3 * 0.3048, 6.4))
    assert notes == (
        "line 5: spin estimated, not measured",
        "line 6: Use In Stat is false",
        "columns Date, Club, Carry Flat - Side, Carry (Sim)",
    )


def test_read_flights_foresight_shot_derives_spin_axis(tmp_path: Path) -> None:
    (flight,), _ = read(tmp_path, FORESIGHT)
    assert flight.launch == pytest.approx(
        (76.44384, radians(10.4), radians(0.6), 2545 * pi / 30, 0.049958), rel=1e-4
    )
    assert (flight.carry, flight.apex) == (257.9, None)


def test_read_flights_foresight_session_notes_other_rows(tmp_path: Path) -> None:
    (one, two), notes = read(tmp_path, SESSION)
    assert one.launch == pytest.approx(
        (171 * 0.44704, radians(10.4), radians(1.2), 2545 * pi / 30, radians(-3.4))
    )
    assert (one.apex, two.carry) == pytest.approx((105 * 0.3048, 148 * 0.9144))
    assert notes == (
        "line 1: Ann Shot Analysis",
        "line 6: Average",
        "line 7: Std. Dev.",
        "line 4: Dr",
        "line 10: 9i",
        "columns Date, Time, Offline (yd)",
    )


def test_read_flights_manual_templates_give_one_flight(tmp_path: Path) -> None:
    blocks = (ROOT / "bench/manual/test_engineer/ball_data.md").read_text().split("```text\n")[1:]
    templates = [read(tmp_path, block.split("```")[0]) for block in blocks]
    assert [(len(table.flights), table.notes) for table in templates] == [(1, ()), (1, ())]
    assert [table.flights[0].carry for table in templates] == pytest.approx([257.95, 257.9], abs=0.1)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_read_flights_semicolons_with_decimal_commas_are_read(tmp_path: Path, encoding: str) -> None:
    (flight,), notes = read(tmp_path, GERMAN.encode(encoding))
    assert (flight.launch.speed, flight.carry) == pytest.approx((275.2 / 3.6, 257.9))
    assert flight.launch.launch_angle == pytest.approx(radians(10.4))
    assert notes == ("columns Datum",)


@pytest.mark.parametrize(
    "header",
    [
        HEADER,
        " Ball Speed MPH ,Launch_Angle_Deg,SPIN (rpm),Carry [yd]",
        "BallSpeed (mph),VLA,TotalSpin,CarryDistance (yds)",
    ],
)
def test_read_flights_header_spelling_variants_are_read(tmp_path: Path, header: str) -> None:
    (flight,), notes = read(tmp_path, f"{header}\n{FLIGHT}\n")
    assert (flight.launch.speed, flight.carry) == pytest.approx((171 * 0.44704, 282 * 0.9144))
    assert notes == ()


@pytest.mark.parametrize(
    ("column", "cell", "figure", "value"),
    [
        ("apex_ft", "105", "apex", 105 * 0.3048),
        ("Apex Height (feet)", "105", "apex", 105 * 0.3048),
        ("carry_m", "257.9", "carry", 282 * 0.9144),  # the same as carry_yd
        ("hang time", "6.4", "time", 6.4),
    ],
)
def test_read_flights_known_unit_is_converted(
    tmp_path: Path, column: str, cell: str, figure: str, value: float
) -> None:
    (flight,), _ = read(tmp_path, f"{HEADER},{column}\n{FLIGHT},{cell}\n")
    assert getattr(flight, figure) == pytest.approx(value)


@pytest.mark.parametrize(("column", "cell"), [("Side Spin", "100 R"), ("Spin Axis (deg)", "2.862405R")])
def test_read_flights_spin_components_give_spin_and_axis(tmp_path: Path, column: str, cell: str) -> None:
    header = f"ball_speed_mph,VLA,Back Spin,{column},carry_yd"
    (flight,), _ = read(tmp_path, f"{header}\n171,10.4,2000,{cell},282\n")
    assert flight.launch.spin == pytest.approx(2002.498 * pi / 30)
    assert flight.launch.spin_axis == pytest.approx(radians(2.862405))


def test_read_flights_weather_station_units_are_converted(tmp_path: Path) -> None:
    more = "Temperature (°F),Air Pressure (kPa),Relative Humidity (%)"
    (flight,), _ = read(tmp_path, f"{HEADER},{more}\n{FLIGHT},68,100.4,39\n")
    air = flight.air
    assert (air.temperature, air.pressure, air.relative_humidity) == pytest.approx((293.15, 100_400, 0.39))


@pytest.mark.parametrize("row", ["Average,1,2,3", "Std. Dev.,1,2,3", "AVG (3),1,2,3", "max,1,2,3"])
def test_read_flights_summary_row_is_skipped_and_noted(tmp_path: Path, row: str) -> None:
    flights, notes = read(tmp_path, f"{HEADER}\n{FLIGHT}\n{row}\n")
    assert (len(flights), notes) == (1, (f"line 3: {row.split(',', maxsplit=1)[0]}",))


@pytest.mark.parametrize(("name", "count"), [("Max", 1), ("Average", 0)])
def test_read_flights_player_called_max_counts(tmp_path: Path, name: str, count: int) -> None:
    flights, _ = read(tmp_path, f"Player,{HEADER}\n{name},{FLIGHT}\n")
    assert len(flights) == count


@pytest.mark.parametrize(
    ("row", "figure"),
    [
        (",10.4,2545,282", "speed"),
        ("0,10.4,2545,282", "speed"),
        ("171,-,2545,282", "launch_angle"),
        ("171,10.4,,282", "spin"),
        ("171,10.4,0,282", "spin"),
        ("171,10.4,-21474836480,282", "spin"),
    ],
)
def test_read_flights_row_without_launch_is_left_out_and_noted(tmp_path: Path, row: str, figure: str) -> None:
    flights, notes = read(tmp_path, f"{HEADER}\n{FLIGHT}\n{row}\n")
    assert (len(flights), notes) == (1, (f"line 3: no {figure}",))


def test_read_flights_quoted_decimal_commas_between_commas_are_read(tmp_path: Path) -> None:
    header = "Ball Speed (km/h),Launch Angle (°),Spin (rpm),Spin Axis (°),Carry (m),Smash"
    (flight,), _ = read(tmp_path, f'{header}\n"180,9","19,2",6420,"4,2 L",145,"1,34"\n')
    assert flight.launch == pytest.approx((50.25, radians(19.2), 0.0, 6420 * pi / 30, radians(-4.2)))


def test_read_flights_comma_in_other_column_keeps_decimal_points(tmp_path: Path) -> None:
    (flight,), _ = read(tmp_path, f'{HEADER},Note\n{FLIGHT},"9,5"\n')
    assert flight.launch.launch_angle == pytest.approx(radians(10.4))


def test_read_flights_unknown_speed_column_names_all_units(tmp_path: Path) -> None:
    with pytest.raises(BenchError) as raised:
        read(tmp_path, "Ball (mph),Launch Angle (°),Spin (rpm)\n143,15.8,2253\n")
    assert raised.value.expected == "column ball_speed_mps (or _mph, _kmh: the unit of its numbers)"


@pytest.mark.parametrize(
    ("text", "location", "found"),
    [
        (f"{HEADER},carry_yd\n{FLIGHT},296\n", "line 1, carry_yd (column 5)", "name of another column"),
        (f"{HEADER},Carry (yd)\n{FLIGHT},282\n", "line 1, Carry (yd) (column 5)", "name of another column"),
        (f"{HEADER},carry_m\n{FLIGHT},250\n", "line 2, carry_m (column 5)", "250, and 282 in carry_yd"),
        (f"{HEADER}\n,,,[m]\n{FLIGHT}\n", "line 1, carry_yd (column 4)", "m in the row of units"),
        (f"{HEADER},Apex\n{FLIGHT},105\n", "line 2, Apex (column 5)", "no unit"),
        (f"{HEADER},Apex\n,,,,[in]\n{FLIGHT},105\n", "line 3, Apex (column 5)", "unit in"),
        (f"{HEADER}\n1_71,10.4,2545,282\n", "line 2, ball_speed_mph (column 1)", "'1_71'"),
        (f"{HEADER}\n171,1.2R,2545,282\n", "line 2, launch_angle_deg (column 2)", "'1.2R'"),
        (f"{HEADER},direction_deg\n{FLIGHT},-1.2L\n", "line 2, direction_deg (column 5)", "'-1.2L'"),
        (f"{HEADER}\n171,10,4,2545,282\n", "line 2", "5 cells"),
        (f'{HEADER}\n171,10.4,"2,545",282\n', "line 2, spin_rpm (column 3)", "'2,545'"),
        (
            f"{HEADER}\n{FLIGHT}\n".replace(",", ";").replace("2545", "2,545"),
            "line 2, spin_rpm (column 3)",
            "'2,545'",
        ),
        (GERMAN.replace("2545", "2.545"), "line 2, Spin Rate (column 4)", "'2.545'"),
        (
            "Datum;Ballgeschwindigkeit;Drehrate\n1.2.26;275;2545\n",
            "line 1",
            "no speed in columns Datum, Ballg",
        ),
        (f"{HEADER}\n1710,10.4,2545,282\n", "line 2", "speed 764.4384 m/s, outside 1 to 149 m/s"),
        (f"{HEADER}\n171,110.4,2545,282\n", "line 2", "launch_angle 110.4 deg, outside -85 to 85 deg"),
        (f"{HEADER}\n171,10.4,-2545,282\n", "line 2", "spin -2545 rpm, outside 48 to 19003 rpm"),
        (f"{HEADER}\n171,10.4,2545,-282\n", "line 2", "carry -257.8608 m, outside 0 to 500 m"),
        (f"{HEADER}\n171,10.4,many,282\n", "line 2, spin_rpm (column 3)", "'many'"),
        ("ball_speed_mps,launch_angle_deg,carry_m\n60,11,190\n", "line 1", "no spin"),
        (f"{HEADER},carry_source\n{FLIGHT},x\n", "flights.csv", "shot table"),
        (f"{HEADER},relative_humidity\n{FLIGHT},55\n", "line 2", "relative_humidity"),
        (b"PK\x03\x04", "flights.csv", "a workbook (xlsx)"),
        (f"{HEADER}\n171,10.4\xb0,2545,282\n".encode("latin-1"), "flights.csv", "not utf-8"),
        (HEADER, "flights.csv", "no rows"),
        (f'{HEADER}\n"{FLIGHT}\n' + 9000 * f"{FLIGHT}\n", "flights.csv", "row from line 2"),
        (f'{HEADER}\n{FLIGHT}\n"{FLIGHT}\n', "flights.csv", "row from line 3"),
    ],
)
def test_read_flights_invalid_table_is_refused_with_place(
    tmp_path: Path, text: str | bytes, location: str, found: str
) -> None:
    with pytest.raises(BenchError) as raised:
        read(tmp_path, text)
    assert location in raised.value.location
    assert found in raised.value.found


def test_read_flights_converts_units_and_reads_points(tmp_path: Path) -> None:
    table, points = tmp_path / "flights.csv", tmp_path / "points.csv"
    table.write_text(
        "flight,ball_speed_mph,launch_angle_deg,spin_rpm,carry_yd,apex_m,time_s,air_temperature_k,note\n"
        "1,150,12,2600,240,30,,293.15,first\n2,60,11,3000,,,6.1,,\n"
    )
    points.write_text("flight,time_s,distance_m,height_m\n2,0.1,5.9,1.1\n2,0.2,11.7,2.2\n")
    (one, two), notes = read_flights(table, points)
    assert notes == ("columns note",)
    assert one.launch.speed == pytest.approx(150 * 0.44704)
    assert one.launch.spin == pytest.approx(2600 * pi / 30)
    assert one.carry == pytest.approx(240 * 0.9144)
    assert (one.apex, one.time) == (30.0, None)
    assert (one.air.temperature, two.air) == (293.15, Air())
    assert two.points is not None
    assert two.observed.tolist() == [6.1, 5.9, 11.7, 1.1, 2.2]
