"""Stories that once broke the bench, or only nearly: each is played again, to the end."""

from __future__ import annotations

from pathlib import Path

import numba
import pytest

from tests.adversary.player import play
from tests.adversary.story import read_story

STORIES = sorted((Path(__file__).parent / "stories").glob("*.json"))

pytestmark = pytest.mark.skipif(
    bool(numba.config.DISABLE_JIT), reason="minutes of the plant take hours without compilation"
)


@pytest.mark.parametrize("path", STORIES, ids=lambda path: path.stem)
def test_play_stored_story_breaks_no_property(path: Path) -> None:
    assert play(read_story(path)).broken == []
