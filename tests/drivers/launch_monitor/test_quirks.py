"""Known monitors' conversations: what they measured is taken, what they did not is absent, never 0."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from drivers.launch_monitor.conversation import Conversation
from drivers.launch_monitor.open_connect import quirk_of, quirks, read_message
from drivers.launch_monitor.record import LaunchRecord

FOLDER = Path(__file__).with_name("conversations")
CONVERSATIONS = {file.stem: json.loads(file.read_text(encoding="utf-8")) for file in FOLDER.glob("*.json")}


def figure(record: LaunchRecord, name: str) -> float | None:
    _, of_club, plain = name.rpartition("club.")
    found: float | None = getattr(record.club if of_club else record, plain)
    return found


@pytest.mark.parametrize("name", CONVERSATIONS)
@pytest.mark.parametrize("size", [1, 100, 100_000])
def test_conversation_known_monitor_gives_expected_record(name: str, size: int) -> None:
    talk: dict[str, Any] = CONVERSATIONS[name]
    conversation = Conversation(0.0)
    records, answers = [], b""
    data = "".join(talk["sends"]).encode()
    for start in range(0, len(data), size):
        parsed = conversation.receive(data[start : start + size], 0.0)
        records += parsed.records
        answers += parsed.answer
        assert parsed.keep_open
    assert [int(code) for code in re.findall(rb'"Code": (\d+)', answers)] == talk["answers"]
    assert conversation.counts.refused == conversation.counts.cut_off == 0
    (record,) = records
    assert talk.get("reason", "") in record.reason
    assert record.valid is ("reason" not in talk), record.reason
    for field, value in talk["measured"].items():
        assert figure(record, field) == pytest.approx(value, rel=2e-3), field
    assert [field for field in talk["absent"] if figure(record, field) is not None] == []
    assert set(talk["absent"]) <= {field for field, _ in record.absent} | {"carry"}


def test_quirks_each_have_conversation() -> None:
    said = {quirk.name for quirk in quirks().values()}
    held = {
        quirk.name
        for talk in CONVERSATIONS.values()
        if (quirk := quirk_of(json.loads(talk["sends"][0])["DeviceID"])) is not None
    }
    assert said == held


def club(**figures: object) -> LaunchRecord:
    ball = {"Speed": 140, "VLA": 12, "HLA": 0.5, "TotalSpin": 2500, "SpinAxis": 1}
    options = {"ContainsBallData": True, "ContainsClubData": True}
    tree = {"DeviceID": "x", "BallData": ball, "ClubData": figures, "ShotDataOptions": options}
    record = read_message(json.dumps(tree).encode(), 0.0)
    assert isinstance(record, LaunchRecord)
    return record


def test_club_zero_among_measured_figures_is_kept() -> None:
    record = club(Speed=100, AngleOfAttack=0, Path=0.0, HorizontalFaceImpact=0, VerticalFaceImpact=3)
    assert (record.club.attack_angle, record.club.path, record.club.strike_x) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("speed", [{}, {"Speed": 0}, {"Speed": None}, {"Speed": "0.0"}])
def test_club_zeros_without_speed_are_absent(speed: dict[str, object]) -> None:
    record = club(**speed, AngleOfAttack=0, Path=0, FaceToTarget=0, Loft=0, HorizontalFaceImpact=0)
    assert record.club == (None,) * 7
    assert ("club.path", "0: not measured") in record.absent


@pytest.mark.parametrize("other", ["monitor", "Rapsodo MLM2PRO 2", ""])
def test_quirk_of_unknown_monitor_is_none(other: str) -> None:
    assert quirk_of(other) is None
    record = club(Speed=100, HorizontalFaceImpact=2, VerticalFaceImpact=0, Loft=13)
    assert record.club.strike_x == pytest.approx(0.002)
