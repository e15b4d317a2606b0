"""Encoder zeros reported by devices, kept next to the ring and compared with the calibration."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.records.telemetry.encoder_preset import (
    ZERO_SHIFT_FILE,
    CalibratedShifts,
    moved_zero,
    read_shifts,
    write_shifts,
)

PLAIN = "preset 0, offset 0"
CALIBRATED = CalibratedShifts("calibration encoders version 3", (PLAIN, PLAIN, ""))


def test_moved_zero_unchanged_preset_returns_no_reason() -> None:
    assert moved_zero(0, PLAIN, CALIBRATED) == ""
    assert moved_zero(2, "", CALIBRATED) == ""


@pytest.mark.parametrize(
    ("joint", "found", "told"),
    [
        (
            0,
            "preset 9, offset 5",
            "encoder of the shoulder: found preset 9, offset 5, expected the values at ",
        ),
        (
            1,
            "",
            "encoder of the arm: found neither preset nor offset, expected the values at calibration en",
        ),
        (2, PLAIN, "calibration encoders version 3: unknown, as no bench was running when it was entered"),
    ],
    ids=["moved", "another device", "not known"],
)
def test_moved_zero_changed_preset_reports_values_and_action(joint: int, found: str, told: str) -> None:
    text = moved_zero(joint, found, CALIBRATED)
    assert told in text
    assert "golfbench run --read-only, then golfbench calibrate encoders" in text


def test_read_shifts_restores_written_shifts(tmp_path: Path) -> None:
    assert read_shifts(tmp_path / "no bench") is None
    write_shifts(tmp_path, (PLAIN, "", "offset -3"))
    assert read_shifts(tmp_path) == (PLAIN, "", "offset -3")
    assert [path.name for path in tmp_path.iterdir()] == [ZERO_SHIFT_FILE]


@pytest.mark.parametrize("text", ["", "[", "null", '["a"]', "{}", "3"])
def test_read_shifts_damaged_file_returns_none(tmp_path: Path, text: str) -> None:
    (tmp_path / ZERO_SHIFT_FILE).write_text(text)
    assert read_shifts(tmp_path) is None
