"""The adversary, for as long as `make test-all` has time; hours: `python -m tests.benchmarks adversary`."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest

from bench.lifecycle import State
from tests.adversary.drawing import improvise
from tests.adversary.player import play
from tests.adversary.story import Setup, Story, read_story

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="minutes of the plant take hours without compilation"
)

DAY = (
    ("press", None, None),
    ("ask", "reset", None),
    ("wait", 3000, None),
    ("ask", "home", None),
    ("wait", 20000, None),
    ("ask", "arm", None),
    ("wait", 9000, None),
    ("ask", "tee", None),
    ("ask", "swing", None),
    ("wait", 9000, None),
)


def test_a_day_without_trouble_breaks_nothing() -> None:
    player = play(Story(Setup(), (("wait", 300, None), *DAY)))
    assert player.broken == []
    assert player.accepted >= 5


@pytest.mark.parametrize("signal", ["guard locked", "local reset"])
def test_a_fault_alone_breaks_nothing(signal: str) -> None:
    fault = ("break", {"signal": signal, "kind": "off"}, None)
    assert play(Story(Setup(), (("wait", 300, None), *DAY[:-2], fault, *DAY[-2:]))).broken == []


def test_the_judge_sees_what_it_is_there_for() -> None:
    player = play(Story(Setup(), (("wait", 300, None), *DAY)), recover=False)
    player.control["state"] = State.SWINGING  # from READY or ARMED, without a request
    player.do(("wait", 10, None))
    assert any("SWINGING" in text for text in player.broken)


def test_a_story_is_read_as_it_was_written(tmp_path: Path) -> None:
    story, player = improvise(3, steps=12)
    path = tmp_path / "story.json"
    path.write_text(story.to_text())
    assert read_story(path) == story
    assert play(story, recover=False).bench.tick <= player.bench.tick


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("seed", range(1000, 1030))
def test_random_requests_and_faults_break_nothing(seed: int) -> None:
    story, _ = improvise(seed)
    assert not story.found, story.to_text()
