"""What explains a stop for lost encoders: the loop, all readings at once, or one encoder."""

from __future__ import annotations

import numpy as np
import pytest

from bench.base.lifecycle import CAUSE_TEXT, REFUSAL_WORDS, Cause, Phase, Refusal
from bench.records.telemetry.cycle_record import CYCLE
from bench.supervisor.status import cause_text, refusal_words, stall_note, supervisor_note

LOST_TIME, PERIOD = 0.0045, 0.001


def records() -> np.ndarray:
    """Return ten records of a loop in step, all encoders read."""
    cycles = np.zeros(10, CYCLE)
    cycles["measured_step"], cycles["encoder_valid"], cycles["encoder_age"] = PERIOD, 1, 2e-4
    return cycles


def note(cycles: np.ndarray, cause: Cause = Cause.SHOULDER_ENCODER) -> str:
    return stall_note(cycles, cause, LOST_TIME, PERIOD)


def test_stall_note_loop_stall_names_duration() -> None:
    cycles = records()
    cycles["measured_step"][-1], cycles["encoder_age"][-1] = 0.0083, 0.009
    assert "the loop stood still for 8.3 ms" in note(cycles)


def test_stall_note_all_encoders_lost_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"][-5:] += np.linspace(0.001, 0.005, 5)[:, None]
    assert "all three encoders were lost at once" in note(cycles)


def test_stall_note_encoder_lost_one_tick_before_others_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"][-5:] += np.linspace(-0.001, 0.0033, 5)[:, None] + [0.0, 0.0, 0.001]
    assert "all three encoders were lost at once" in note(cycles, Cause.WRIST_ENCODER)


def test_stall_note_encoder_back_in_last_tick_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"][-3:] += np.array([[0.003] * 3, [0.004] * 3, [0.0, 0.005, 0.005]])
    assert "all three encoders were lost at once" in note(cycles, Cause.ARM_ENCODER)


def test_stall_note_stall_longer_than_records_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"] = np.linspace(0.004, 0.0052, 10)[:, None]
    cycles["encoder_age"][2] = np.nan
    assert "all three encoders were lost at once" in note(cycles)


def test_stall_note_jump_after_one_missed_tick_names_all_three() -> None:
    cycles = records()
    cycles["encoder_age"] = -5e-5  # sampled at the tick, as over CANopen
    cycles["encoder_age"][-2, 0] += 0.001
    assert note(cycles, Cause.SHOULDER_JUMP) == "", "one encoder alone is its own"
    cycles["encoder_age"][-2] = 0.00096
    assert "all three encoders were late at once" in note(cycles, Cause.SHOULDER_JUMP)
    cycles["encoder_age"][-2], cycles["encoder_age"][-6] = -5e-5, 0.00096
    assert note(cycles, Cause.SHOULDER_JUMP) == "", "six ticks before it explains no jump"


def test_stall_note_jump_after_stall_names_stall() -> None:
    cycles = records()
    assert note(cycles, Cause.ARM_JUMP) == ""
    cycles["encoder_age"][-3, 1] = 0.004
    assert note(cycles, Cause.ARM_JUMP) == "", "one encoder alone is its own"
    cycles["encoder_age"][-3] = 0.004
    assert "all three encoders were late at once" in note(cycles, Cause.ARM_JUMP)
    cycles["measured_step"][-4] = 0.006
    assert "the loop stood still for 6.0 ms" in note(cycles, Cause.ARM_JUMP)


def test_stall_note_homing_failed_names_stall_anywhere_in_homing() -> None:
    cycles = np.concatenate([records() for _ in range(5)])
    cycles["measured_step"][3] = 0.0083  # before the homing
    cycles["phase"][10:] = Phase.HOMING
    assert note(cycles, Cause.HOMING_FAILED) == ""
    assert note(cycles[:10], Cause.HOMING_FAILED) == ""
    cycles["measured_step"][20] = 0.0083
    assert "the loop stood still for 8.3 ms while homing" in note(cycles, Cause.HOMING_FAILED)


def test_stall_note_device_fault_takes_precedence() -> None:
    cycles = records()
    cycles["encoder_valid"][-5:, 0] = 0
    fault = "node 1 has left the operational state: another master has commanded it"
    for cause in (Cause.SHOULDER_ENCODER, Cause.DEVICE_PASSIVE):
        assert stall_note(cycles, cause, LOST_TIME, PERIOD, fault) == fault
    assert stall_note(cycles, Cause.GUARD, LOST_TIME, PERIOD, fault) == ""


def test_refusal_words_device_fault_takes_precedence() -> None:
    fault = "another master has commanded node 1"
    assert refusal_words(Refusal.READINGS, fault) == ("an encoder yields no valid readings", fault)
    assert refusal_words(Refusal.READINGS, "") == REFUSAL_WORDS[Refusal.READINGS]
    assert refusal_words(Refusal.GUARD, fault) == REFUSAL_WORDS[Refusal.GUARD]


@pytest.mark.parametrize("lost", [0, 2])
def test_stall_note_one_encoder_lost_is_empty(lost: int) -> None:
    cycles = records()
    cycles["encoder_valid"][-5:, lost] = 0
    assert note(cycles, Cause(Cause.SHOULDER_ENCODER + lost)) == ""


def test_stall_note_other_cause_is_empty() -> None:
    cycles = records()
    cycles["measured_step"][-1] = 0.0083
    assert note(cycles, Cause.WRIST_FOLLOWING) == ""
    assert cause_text(Cause.GUARD, "") == CAUSE_TEXT[Cause.GUARD]


def test_cause_text_stall_note_replaces_action() -> None:
    text = cause_text(Cause.SHOULDER_ENCODER, "the loop stood still")
    assert text == "shoulder encoder R1 without a valid reading: the loop stood still"


def test_supervisor_note_stall_names_duration() -> None:
    found = supervisor_note(Cause.SUPERVISOR, 0.62, 0.5)
    assert "the supervisor stood still for 0.6 s" in found
    text = cause_text(Cause.SUPERVISOR, found)
    assert text.startswith("no heartbeat from the supervisor: the supervisor stood still")


def test_supervisor_note_without_stall_is_empty() -> None:
    assert not supervisor_note(Cause.SUPERVISOR, 0.02, 0.5)
    assert not supervisor_note(Cause.GUARD, 0.62, 0.5)
