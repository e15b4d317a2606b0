"""The adversary: a few stories here, more before a release; hours: `python -m tests.benchmarks adversary`."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest

from bench.base.lifecycle import State
from sim.faults import MEANINGS, SIGNALS, sort_of
from tests.adversary.drawing import NOT_SHIPPED, drawn_fault, improvise
from tests.adversary.player import play
from tests.adversary.story import Setup, Story, read_story
from tests.sampling import release_except

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="minutes of the plant take hours without compilation"
)

DAY = (
    ("press", None, None),
    ("ask", "reset", None),
    ("wait", 3000, None),
    ("ask", "home", None),
    ("wait", 25000, None),
    ("ask", "arm", None),
    ("wait", 9000, None),
    ("ask", "tee", None),
    ("ask", "swing", None),
    ("wait", 9000, None),
)


def test_play_fault_free_day_breaks_no_property() -> None:
    player = play(Story(Setup(), (("wait", 300, None), *DAY)))
    assert player.broken == []
    assert player.accepted >= 5


@pytest.mark.parametrize("signal", ["guard locked", "local reset"])
def test_play_single_fault_breaks_no_property(signal: str) -> None:
    fault = ("break", {"signal": signal, "kind": "off"}, None)
    assert play(Story(Setup(), (("wait", 300, None), *DAY[:-2], fault, *DAY[-2:]))).broken == []


def test_judge_reports_swing_without_request() -> None:
    player = play(Story(Setup(), (("wait", 300, None), *DAY)), recover=False)
    player.control["state"] = State.SWINGING  # from READY or ARMED, without a request
    player.do(("wait", 10, None))
    assert any("SWINGING" in text for text in player.broken)


ENTERED = (
    ("wait", 300, None),
    ("press", None, None),
    ("ask", "reset", None),
    ("wait", 15000, None),
    ("ask", "access", None),
    ("input", "guard_closed", False),
    ("wait", 500, None),
    ("input", "guard_closed", True),
    ("input", "emergency_stop_clear", False),
    ("wait", 100, None),
    ("input", "emergency_stop_clear", True),
    ("wait", 100, None),
)
"""A person goes in, and the emergency stop is pressed."""


def test_recover_emergency_stop_during_access_reaches_ready() -> None:
    player = play(Story(Setup(), ENTERED), recover=False)
    assert player.state is State.ESTOP
    assert not player.bench.plant_state["guard_locked"][0]
    player.recover()
    assert player.broken == []  # it is READY


def test_judge_reports_person_locked_in() -> None:
    player = play(Story(Setup(), ENTERED), recover=False)
    player.control["guard_was_opened"] = False
    player.do(("wait", 10, None))
    assert any("locked in" in text for text in player.broken)


def test_judge_second_reset_without_press_is_reported() -> None:
    press = (("press", None, None), ("ask", "secure", None), ("wait", 100, None), ("ask", "reset", None))
    player = play(Story(Setup(), (*ENTERED, *press)), recover=False)
    assert player.state is State.ESTOP
    player.judge.pressed(player.bench.tick)
    player.control["reset_pressed"] = np.inf  # as if the press counted again
    player.do(("ask", "reset", None))
    assert player.broken == []
    player = play(Story(Setup(), (*ENTERED, *press)), recover=False)
    player.control["reset_pressed"] = np.inf
    player.do(("ask", "reset", None))
    assert any("reset without a press" in text for text in player.broken)


def test_read_story_restores_written_story(tmp_path: Path) -> None:
    story, player = improvise(3, steps=12)
    path = tmp_path / "story.json"
    path.write_text(story.to_text())
    assert read_story(path) == story
    assert play(story, recover=False).bench.tick <= player.bench.tick


def test_drawn_fault_covers_every_kind() -> None:
    random = np.random.default_rng(1)
    drawn = {(sort_of(fault.signal), fault.kind) for fault in (drawn_fault(random) for _ in range(5_000))}
    sorts = {sort_of(signal) for signal in SIGNALS if signal not in NOT_SHIPPED}
    assert drawn == {(sort, kind) for sort in sorts for kind in MEANINGS[sort]}


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", release_except(range(1000, 1004), range(1000, 1030)))
def test_improvise_random_story_breaks_no_property(seed: int) -> None:
    story, _ = improvise(seed)
    assert not story.found, story.to_text()
