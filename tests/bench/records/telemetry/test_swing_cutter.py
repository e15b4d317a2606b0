from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.base.lifecycle import Cause, State
from bench.records.telemetry.swing_cutter import RecordSegment, SwingSegmenter

Cycles = np.ndarray[Any, Any]
MakeDay = Callable[..., Cycles]

S = State
LEAD, TAIL = 0.125, 0.25  # 128 and 256 ticks
SWING = [(S.READY, 1000), (S.ARMED, 700), (S.SWINGING, 300), (S.RECOVERING, 400), (S.READY, 900)]


def cut_up(
    cycles: Cycles, *, chunk: int = 17, room: int = 8192, lead: float = LEAD, tail: float = TAIL
) -> list[RecordSegment]:
    cutter = SwingSegmenter(lead=lead, tail=tail, room=room)
    return [cut for i in range(0, len(cycles), chunk) for cut in cutter.take(cycles[i : i + chunk])]


def ticks(cut: RecordSegment) -> tuple[int, int]:
    return int(cut.cycles["tick"][0]), int(cut.cycles["tick"][-1])


def test_swing_segmenter_swing_includes_lead_and_tail(make_day: MakeDay) -> None:
    day = make_day(SWING)
    (cut,) = cut_up(day)
    assert cut.kind == "swing"
    assert ticks(cut) == (1001 - 128, 2400 + 256)
    assert cut.cycles.tobytes() == day[872:2656].tobytes()
    assert (cut.lost, cut.ended, cut.continued) == (0, "", False)


@pytest.mark.parametrize("end", [S.FAULT, S.ESTOP])
@pytest.mark.parametrize("moving", [S.HOMING, S.ARMED, S.SWINGING, S.RECOVERING])
def test_swing_segmenter_stop_in_motion_gives_record_with_lead(
    make_day: MakeDay, moving: State, end: State
) -> None:
    before = [(S.READY, 500), *([(S.ARMED, 200)] if moving is S.SWINGING else []), (moving, 300)]
    (cut,) = cut_up(make_day([*before, (end, 500)]))
    assert cut.kind == ("swing" if moving is S.SWINGING else "stop")
    assert ticks(cut)[0] == 501 - 128
    assert cut.cycles["state"][-1] == end


def test_swing_segmenter_brake_with_cause_gives_stop_record(make_day: MakeDay) -> None:
    plan = [(S.READY, 500), (S.ARMED, 300), (S.RECOVERING, 200), (S.READY, 500)]
    (cut,) = cut_up(make_day(plan, cause=(850, Cause.SUPERVISOR)))
    assert cut.kind == "stop"
    assert not cut_up(make_day(plan))


def test_swing_segmenter_requested_end_gives_no_record(make_day: MakeDay) -> None:
    homed = [(S.ESTOP, 300), (S.SAFE, 300), (S.HOMING, 900), (S.READY, 900), (S.ACCESS, 300)]
    armed = [(S.READY, 300), (S.ARMED, 900), (S.READY, 900), (S.FAULT, 300), (S.ESTOP, 300)]
    assert not cut_up(make_day(homed))
    assert not cut_up(make_day(armed, cause=(2101, Cause.GUARD)))


def test_swing_segmenter_series_gives_record_per_swing(make_day: MakeDay) -> None:
    once = [(S.ARMED, 700), (S.SWINGING, 300), (S.RECOVERING, 400)]
    day = make_day([(S.READY, 500), *once, *once, (S.READY, 500)])
    first, second = cut_up(day)
    assert ticks(first) == (501 - 128, 1900 + 256)
    assert ticks(second) == (2601 - 128, 3300 + 256)
    assert first.kind == second.kind == "swing"


def test_swing_segmenter_swings_within_tail_do_not_overlap(make_day: MakeDay) -> None:
    once = [(S.ARMED, 50), (S.SWINGING, 300), (S.RECOVERING, 400)]
    first, second = cut_up(make_day([(S.READY, 500), *once, *once, (S.READY, 500)]))
    assert ticks(first) == (501 - 128, 1250 + 256)
    assert ticks(second)[0] == 1251  # not before the end of the swing before


def test_swing_segmenter_long_hold_record_starts_before_swing(make_day: MakeDay) -> None:
    plan = [(S.READY, 500), (S.ARMED, 5000), (S.SWINGING, 300), (S.RECOVERING, 400), (S.READY, 500)]
    (cut,) = cut_up(make_day(plan), room=2048)
    assert ticks(cut) == (5501 - 128, 6200 + 256)
    assert cut.kind == "swing"
    assert not cut.continued


def test_swing_segmenter_fault_after_long_hold_keeps_memory(make_day: MakeDay) -> None:
    (cut,) = cut_up(make_day([(S.READY, 500), (S.ARMED, 5000), (S.FAULT, 500)]), room=2048)
    assert cut.kind == "stop"
    assert 5501 - 1024 <= ticks(cut)[0] <= 5501 - 1024 + 17


def test_swing_segmenter_record_beyond_memory_continues_in_next(make_day: MakeDay) -> None:
    day = make_day([(S.READY, 500), (S.ARMED, 500), (S.SWINGING, 6000), (S.FAULT, 500)])
    cuts = cut_up(day, room=2048)
    assert len(cuts) > 3
    joined = b"".join(cut.cycles.tobytes() for cut in cuts)
    assert joined == day[500 - 128 : 7000 + 256].tobytes()
    assert [cut.continued for cut in cuts] == [False] + [True] * (len(cuts) - 1)
    assert all(cut.ended for cut in cuts[:-1])
    assert not cuts[-1].ended


@pytest.mark.slow
@given(st.data())
def test_swing_segmenter_records_are_independent_of_chunk_size(
    make_day: MakeDay, data: st.DataObject
) -> None:
    states = data.draw(st.lists(st.tuples(st.sampled_from(list(S)), st.integers(1, 400)), max_size=12))
    day = make_day(states) if states else make_day([(S.READY, 1)])
    whole = cut_up(day, chunk=1)
    cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
    cuts: list[RecordSegment] = []
    at = 0
    while at < len(day):
        count = data.draw(st.integers(1, 900))
        cuts += cutter.take(day[at : at + count])
        at += count
    assert [(c.kind, c.cycles.tobytes()) for c in cuts] == [(c.kind, c.cycles.tobytes()) for c in whole]
    for cut in cuts + cutter.finish("over", keep=True):
        assert np.all(np.diff(cut.cycles["tick"]) == 1)
        assert np.isin(cut.cycles["state"], [S.HOMING, S.ARMED, S.SWINGING, S.RECOVERING]).any()
    for number in np.flatnonzero(day["state"] == S.SWINGING):
        tick = day["tick"][number]
        assert any(ticks(cut)[0] <= tick <= ticks(cut)[1] for cut in [*cuts, *_rest(day)])


def _rest(day: Cycles) -> list[RecordSegment]:
    """Return the unfinished segments at the end of `day`."""
    cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
    cutter.take(day)
    return cutter.finish("over", keep=True)


def test_swing_segmenter_counts_losses_within_record(make_day: MakeDay) -> None:
    day = make_day(SWING)
    cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
    cuts = cutter.take(day[:300])
    cuts += cutter.take(day[310:1500], lost=10)  # before the record
    cuts += cutter.take(day[1500:1500], lost=7)  # a read that found nothing but losses
    cuts += cutter.take(np.concatenate([day[1507:1600], day[1620:2650]]), lost=20)  # in the middle of a read
    cuts += cutter.take(day[2665:3300], lost=15)  # at the record's end and behind it
    (cut,) = cuts
    assert cut.lost == 27
    assert ticks(cut) == (1001 - 128, 2650)


def test_swing_segmenter_finish_keeps_swings_and_requested_stops(make_day: MakeDay) -> None:
    day = make_day(SWING)
    for end, keep, kind in ((1500, False, ""), (1500, True, "stop"), (1800, False, "swing")):
        cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
        assert not cutter.take(day[:end])
        assert (cutter.moving, cutter.worth_waiting) == (True, kind == "swing")
        cuts = cutter.finish("the power failed", keep=keep)
        assert [(cut.kind, cut.ended, len(cut.cycles)) for cut in cuts] == (
            [(kind, "the power failed", end - 872)] if kind else []
        )
        assert not cutter.moving
        assert not cutter.finish("twice", keep=True)


def test_swing_segmenter_motion_after_finish_opens_continued_record(make_day: MakeDay) -> None:
    day = make_day(SWING)
    cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
    cutter.take(day[:1800])
    cutter.finish("the loop fell silent", keep=True)
    (cut,) = cutter.take(day[1800:])
    assert ticks(cut) == (1801 - 128, 2400 + 256)
    assert cut.continued


def test_swing_segmenter_late_start_marks_record_continued(make_day: MakeDay) -> None:
    day = make_day(SWING)
    for begin, first, continued in ((1050, 1701 - 128, False), (1600, 1701 - 100, False), (1800, 1801, True)):
        (cut,) = cut_up(day[begin:])
        assert (ticks(cut)[0], cut.continued) == (first, continued)
    (stop,) = cut_up(make_day([(S.HOMING, 300), (S.FAULT, 500)]))
    assert stop.continued


def test_swing_segmenter_finish_in_tail_is_not_early_end(make_day: MakeDay) -> None:
    cutter = SwingSegmenter(lead=LEAD, tail=TAIL, room=8192)
    assert not cutter.take(make_day(SWING)[:2500])
    (cut,) = cutter.finish("over", keep=False)
    assert not cut.ended
    assert ticks(cut) == (1001 - 128, 2500)
