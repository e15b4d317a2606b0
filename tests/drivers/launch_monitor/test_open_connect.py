from __future__ import annotations

import json
import math
from math import pi, radians
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.base import Launch
from drivers.launch_monitor.open_connect import (
    CLUB_CODE,
    Message,
    RejectedMessage,
    ReportedStatus,
    club_code,
    read_answer,
    read_message,
    write_answer,
    write_heartbeat,
    write_player,
    write_shot,
)
from drivers.launch_monitor.record import ClubFigures, ClubRecord, LaunchRecord

SPECIFICATION: dict[str, Any] = {
    "DeviceID": "UF-BENCH",
    "Units": "Yards",
    "ShotNumber": 13,
    "APIversion": "1",
    "BallData": {
        "Speed": 147.5,
        "SpinAxis": -13.2,
        "TotalSpin": 3250.0,
        "BackSpin": 2500.0,
        "SideSpin": -800.0,
        "HLA": 2.3,
        "VLA": 14.3,
        "CarryDistance": 256.5,
    },
    "ClubData": {
        "Speed": 101.2,
        "AngleOfAttack": -1.1,
        "FaceToTarget": 0.4,
        "Lie": 0.0,
        "Loft": 13.1,
        "Path": -0.6,
        "SpeedAtImpact": 101.2,
        "VerticalFaceImpact": 1.0,
        "HorizontalFaceImpact": -2.5,
        "ClosureRate": 0.0,
    },
    "ShotDataOptions": {
        "ContainsBallData": True,
        "ContainsClubData": True,
        "LaunchMonitorIsReady": True,
        "LaunchMonitorBallDetected": True,
        "IsHeartBeat": False,
    },
}


def read(**changes: Any) -> Message:
    return read_message(json.dumps({**SPECIFICATION, **changes}).encode(), 7.0)


def record(**ball: Any) -> LaunchRecord:
    """Return the record of the specification's shot with other ball data; ... leaves a figure out."""
    data = {name: value for name, value in {**SPECIFICATION["BallData"], **ball}.items() if value is not ...}
    message = read(BallData=data)
    assert isinstance(message, LaunchRecord)
    return message


def test_read_message_specification_shot_converts_units() -> None:
    shot = read()
    assert isinstance(shot, LaunchRecord)
    assert shot.launch == pytest.approx(
        (147.5 * 0.44704, radians(14.3), radians(2.3), 3250 * 2 * pi / 60, radians(-13.2))
    )
    assert (shot.time, shot.device, shot.number) == (7.0, "UF-BENCH", 13)
    assert shot.carry == pytest.approx(234.5436)  # 256.5 yd
    expected = ClubFigures(
        45.240448, radians(-1.1), radians(-0.6), radians(0.4), radians(13.1), -0.0025, 0.001
    )
    assert shot.club == pytest.approx(expected)
    assert shot.absent == ()
    assert shot.valid
    assert shot.source == "launch monitor"


def test_read_message_accepts_text_numbers_and_spellings() -> None:
    tree = {
        "deviceID": "PiTrac",
        "units": "yards",
        "Shot_Number": "13",
        "APIVersion": 1.0,
        "balldata": {
            "speed": "147.5",
            "TotalSpin": "0.0",
            "Backspin": "2500.0",
            "side_spin": " -800 ",
            "hla": "2.3",
            "VLA": "1.43e1",
        },
        "shotDataOptions": {"containsBallData": "true", "ContainsClubData": "false", "IsHeartBeat": 0},
    }
    shot = read_message(json.dumps(tree).encode(), 0.0)
    assert isinstance(shot, LaunchRecord)
    assert shot.number == 13
    assert shot.launch is not None
    assert shot.launch.spin == pytest.approx(math.hypot(2500, 800) * pi / 30)
    assert shot.launch.spin_axis == pytest.approx(math.atan2(-800, 2500))
    assert shot.launch.speed == pytest.approx(147.5 * 0.44704)
    assert shot.absent == (("carry", "no CarryDistance"),)


@pytest.mark.parametrize(
    "ball",
    [
        {"TotalSpin": ..., "SpinAxis": ..., "BackSpin": ..., "SideSpin": ...},
        {"TotalSpin": 0, "SpinAxis": 0, "BackSpin": 0, "SideSpin": 0},
        {"TotalSpin": None, "BackSpin": None},
        {"TotalSpin": "", "SideSpin": ""},
        {"TotalSpin": 99999, "BackSpin": "n/a"},
    ],
)
def test_read_message_unmeasured_spin_is_absent(ball: dict[str, Any]) -> None:
    shot = record(**ball)
    assert shot.spin is None
    assert shot.spin_axis is None
    assert shot.launch is None
    assert not shot.valid
    assert "no spin" in shot.reason
    assert shot.speed == pytest.approx(65.9384)  # the others stand


def test_read_message_side_spin_replaces_axis_of_0() -> None:
    shot = record(TotalSpin=2414, SpinAxis=0, BackSpin=2414, SideSpin=332)
    assert shot.spin_axis == pytest.approx(math.atan2(332, 2414))
    assert shot.spin == pytest.approx(2414 * pi / 30)


def test_read_message_total_spin_overrides_components() -> None:
    assert record(SideSpin=800.0).spin == pytest.approx(3250 * pi / 30)
    assert record(SpinAxis=...).spin_axis == pytest.approx(math.atan2(-800, 2500))


@pytest.mark.parametrize(
    "bad", ["NaN", "inf", "-1e999", "12,5", "1_2", "fast", True, [1], {"a": 1}, -3, 301, 10**400]
)
def test_read_message_impossible_speed_is_absent_with_reason(bad: Any) -> None:
    shot = record(Speed=bad)
    assert shot.speed is None
    assert shot.absent[0][0] == "speed"
    assert "Speed" in shot.absent[0][1]
    assert shot.launch_angle == pytest.approx(radians(14.3))


def test_read_message_nan_speed_is_absent() -> None:
    shot = read_message(json.dumps(SPECIFICATION).replace("147.5", "NaN").encode(), 0.0)
    assert isinstance(shot, LaunchRecord)
    assert shot.speed is None


@pytest.mark.parametrize(
    ("units", "carry"),
    [
        ("Yards", 256.5 * 0.9144),
        ("yd", 256.5 * 0.9144),
        ("", 256.5 * 0.9144),  # the specification's default
        ("Meters", 256.5),
        (" Metric ", 256.5),
        ("M", 256.5),
    ],
)
def test_read_message_carry_known_units_is_in_metres(units: str, carry: float) -> None:
    shot = read(Units=units)
    assert isinstance(shot, LaunchRecord)
    assert shot.carry == pytest.approx(carry)
    assert shot.speed == pytest.approx(65.9384)


def test_read_message_carry_unknown_units_is_absent_with_reason() -> None:
    shot = read(Units="Furlongs")
    assert isinstance(shot, LaunchRecord)
    assert (shot.carry, shot.valid) == (None, True)
    assert shot.absent == (("carry", "CarryDistance in Units 'Furlongs', expected Yards or Meters"),)


@pytest.mark.parametrize("version", ["2", "1.1", "v1", 3, None, "", [1]])
def test_read_message_ignores_api_version(version: Any) -> None:
    assert read(APIversion=version) == read()


@pytest.mark.parametrize("options", [{}, {"IsHeartBeat": True}, {"IsHeartBeat": "1"}])
def test_read_message_without_data_is_status(options: dict[str, Any]) -> None:
    given_options = {"ContainsBallData": False, "ContainsClubData": False, **options}
    assert read(ShotDataOptions={**given_options, "LaunchMonitorIsReady": False}) == ReportedStatus(
        "UF-BENCH", bool(options), False, None
    )


def test_read_message_status_at_top_level_is_read() -> None:
    data = {"DeviceID": "x", "ContainsBallData": False, "LaunchMonitorIsReady": True, "IsHeartBeat": True}
    assert read_message(json.dumps(data).encode(), 7.0) == ReportedStatus("x", heartbeat=True, ready=True)


def test_read_message_heartbeat_with_ball_data_is_launch() -> None:
    assert isinstance(read(ShotDataOptions={"ContainsBallData": True, "IsHeartBeat": True}), LaunchRecord)


def test_read_message_ball_data_without_options_is_launch() -> None:
    tree = {name: value for name, value in SPECIFICATION.items() if name != "ShotDataOptions"}
    assert isinstance(read_message(json.dumps(tree).encode(), 0.0), LaunchRecord)


CLUB_ALONE = {"ContainsBallData": False, "ContainsClubData": True}
BOTH = {"ContainsBallData": True, "ContainsClubData": True}
ZERO_BALL = {"Speed": 0, "SpinAxis": 0, "TotalSpin": 0, "HLA": 0, "VLA": 0}


@pytest.mark.parametrize(
    ("ball", "options"),
    [
        ({}, CLUB_ALONE),
        (ZERO_BALL, CLUB_ALONE),
        (SPECIFICATION["BallData"], CLUB_ALONE),  # of the shot before
        ({**ZERO_BALL, "Speed": "0.0", "VLA": 12.0}, BOTH),
        (None, BOTH),
    ],
)
def test_read_message_club_without_ball_is_club_record(ball: Any, options: dict[str, bool]) -> None:
    club = read(BallData=ball, ShotDataOptions=options)
    assert isinstance(club, ClubRecord)
    assert (club.time, club.device) == (7.0, "UF-BENCH")
    assert club.club.speed == pytest.approx(45.240448)


ZERO_CLUB = dict.fromkeys(SPECIFICATION["ClubData"], 0.0)


def test_read_message_zero_club_alone_is_status() -> None:
    message = read(BallData=ZERO_BALL, ClubData=ZERO_CLUB, ShotDataOptions=CLUB_ALONE)
    assert message == ReportedStatus("UF-BENCH", False, None, None)


@pytest.mark.parametrize("options", [{"ContainsBallData": True}, BOTH])
def test_read_message_zero_ball_without_club_is_refused_with_200(options: dict[str, bool]) -> None:
    message = read(BallData=ZERO_BALL, ClubData=ZERO_CLUB, ShotDataOptions=options)
    assert message == RejectedMessage(200, "a ball of speed 0, and no club")


def test_read_message_ball_of_speed_0_with_other_figures_is_refused() -> None:
    options = {"ContainsBallData": True, "LaunchMonitorIsReady": True, "LaunchMonitorBallDetected": True}
    message = read(BallData={**ZERO_BALL, "VLA": 12.0}, ClubData=None, ShotDataOptions=options)
    assert message == RejectedMessage(200, "a ball of speed 0, and no club")


def test_read_message_zeros_with_only_club_speed_are_absent() -> None:
    shot = read(ClubData={**ZERO_CLUB, "Speed": 101.2})
    assert isinstance(shot, LaunchRecord)
    assert shot.club.speed == pytest.approx(45.240448)
    assert shot.club._replace(speed=None) == ClubFigures()
    assert {name for name, _ in shot.absent} == {
        f"club.{name}" for name in ClubFigures._fields if name != "speed"
    }


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"{", "invalid JSON"),
        (b"{'a': 1}", "invalid JSON"),
        (b'{"a": \xff}', "invalid JSON"),
        (b"[1]", "not a JSON object"),
        (b"{}", "neither"),
        (b'{"DeviceID": "x"}', "neither"),
        (b'{"BallData": {}, "ShotDataOptions": {"ContainsBallData": true}}', "without BallData"),
        (b'{"BallData": 3, "ShotDataOptions": {"ContainsBallData": true}}', "without BallData"),
        (b'{"APIversion": "2", "Ball": {"Speed": 3}}', "ShotDataOptions; APIversion '2'"),
        (b'{"APIversion": "2", "BallData": {"BallSpeed": 3}}', "BallData of 'ballspeed', expected Speed"),
        (b'{"Speed": ' + b"9" * 5000 + b"}", "invalid JSON"),
        (b"{" * 100_000, "invalid JSON"),
        (b'{"a":' + b"[" * 100_000, "invalid JSON"),
    ],
)
def test_read_message_invalid_data_is_refused_with_reason(data: bytes, says: str) -> None:
    message = read_message(data, 0.0)
    assert isinstance(message, RejectedMessage)
    assert message.code == 501
    assert says in message.reason
    assert len(message.reason) < 200


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    [*SPECIFICATION, *SPECIFICATION["BallData"], *SPECIFICATION["ShotDataOptions"]]
                ),
                inner,
                max_size=6,
            )
        ),
        max_leaves=20,
    )
)
def test_read_message_any_json_gives_finite_or_absent_figures(tree: Any) -> None:
    message = read_message(json.dumps({"BallData": tree, "ShotDataOptions": tree}).encode(), 0.0)
    if isinstance(message, LaunchRecord):
        figures = (message.speed, message.launch_angle, message.direction, message.spin, message.spin_axis)
        assert all(figure is None or math.isfinite(figure) for figure in (*figures, message.carry))
        missing = {name for name, _ in message.absent}
        assert {
            name for name, figure in zip(Launch._fields, figures, strict=True) if figure is None
        } <= missing


@given(
    st.builds(
        Launch, st.floats(1, 100), st.floats(-1, 1), st.floats(-1, 1), st.floats(1, 2000), st.floats(-3, 3)
    ),
    st.integers(0, 10**6),
)
def test_write_shot_round_trip_preserves_figures(launch: Launch, number: int) -> None:
    data = write_shot(number, launch, "bench", ClubFigures(speed=40.0, strike_x=0.01), carry=200.0)
    assert data.endswith(b"}\n")
    shot = read_message(data, 1.0)
    assert isinstance(shot, LaunchRecord)
    assert shot.launch == pytest.approx(launch, abs=1e-4)
    assert shot.number == number
    assert shot.carry == pytest.approx(200.0, abs=1e-4)
    assert shot.club.speed == pytest.approx(40.0, abs=1e-4)
    assert shot.club.strike_x == pytest.approx(0.01, abs=1e-6)
    assert shot.club.path is None


def test_write_shot_sends_specified_fields() -> None:
    launch = Launch(65.9384, radians(14.3), radians(2.3), 3250 * pi / 30, radians(-13.2))
    tree = json.loads(write_shot(13, launch, "UF-BENCH", ClubFigures(45.0), 234.5436))
    for part in ("BallData", "ShotDataOptions"):
        assert tree[part].keys() == SPECIFICATION[part].keys()
    assert tree["ClubData"].keys() == {"Speed", "SpeedAtImpact"}  # what is not known is not sent
    assert tree.keys() == SPECIFICATION.keys()
    assert (tree["APIversion"], tree["Units"], tree["ShotNumber"]) == ("1", "Yards", 13)
    for name in ("Speed", "SpinAxis", "TotalSpin", "HLA", "VLA", "CarryDistance"):
        assert tree["BallData"][name] == pytest.approx(SPECIFICATION["BallData"][name], abs=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_write_shot_non_finite_figure_raises(bad: float) -> None:
    with pytest.raises(ValueError, match="JSON"):
        write_shot(1, Launch(bad, 0.1), "bench")


def test_heartbeat_and_answers_round_trip() -> None:
    assert read_message(write_heartbeat(3, "bench"), 0.0) == ReportedStatus("bench", True, True, False)
    answer = read_answer(write_answer(200, "Shot received successfully"))
    assert answer is not None
    assert (answer.code, answer.text) == (200, "Shot received successfully")
    player = read_answer(write_player("PT"))
    assert player is not None
    assert (player.code, player.club, player.handed) == (201, "PT", "RH")
    for bad in (b"{}", b"nonsense", b"[1]", b'{"Code": "x"}', b'{"Code": 5e9}', b'{"Code": true}'):
        assert read_answer(bad) is None


@pytest.mark.parametrize(
    ("name", "code"),
    [("driver", "DR"), ("iron7", "I7"), ("Wood 3", "W3"), ("hybrid-4", "H4"), ("pw", "PW"), ("putter", "PT")],
)
def test_club_code_known_club_returns_code(name: str, code: str) -> None:
    assert club_code(name) == code
    assert CLUB_CODE.fullmatch(code)


@pytest.mark.parametrize("name", ["thesis", "wood", "wood8", "iron", "", "iron77"])
def test_club_code_unknown_club_returns_driver(name: str) -> None:
    assert club_code(name) == "DR"
