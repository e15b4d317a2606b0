"""A story made short: steps are left out, waits cut and the bench made plain while it breaks the same."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import replace

from tests.adversary.player import play
from tests.adversary.story import Setup, Step, Story


def kind_of(found: str) -> str:
    """Return the violation, without ticks and values."""
    return re.sub(r"tick \d+: |[-\d.]+", "", found.split(";", 1)[0]).strip()


def breaks(story: Story) -> str:
    """Return what `story` breaks; empty when everything holds."""
    try:
        return "; ".join(play(story).broken[:3])
    except (KeyError, ValueError) as error:
        return f"cannot be played: {error}"


def _shorter(steps: tuple[Step, ...]) -> Iterator[tuple[Step, ...]]:
    """Yield `steps` with less in them, the greatest savings first."""
    size = len(steps) // 2
    while size:
        for begin in range(len(steps) - size, -1, -size):
            yield steps[:begin] + steps[begin + size :]
        size //= 2
    for k, (verb, what, how) in enumerate(steps):
        if verb == "wait" and what > 1:
            for less in (what // 10, what // 2):
                yield (*steps[:k], (verb, max(less, 1), how), *steps[k + 1 :])


def shrink(story: Story, longest: float = 120.0) -> Story:
    """Return a short story that breaks the same kind of thing, as far as `longest` seconds go."""
    wanted, end = kind_of(story.found), time.monotonic() + longest
    plain = Setup(configuration=story.setup.configuration, seed=story.setup.seed)
    for name in ("turned", "incremental", "sensors", "check", "local_reset", "series", "armed_timeout"):
        simpler = replace(story, setup=replace(story.setup, **{name: getattr(plain, name)}))
        if simpler.setup != story.setup and kind_of(found := breaks(simpler)) == wanted:
            story = replace(simpler, found=found)
    going = True
    while going and time.monotonic() < end:
        going = False
        for steps in _shorter(story.steps):
            if time.monotonic() > end:
                break
            found = breaks(story.with_steps(steps))
            if found and kind_of(found) == wanted:
                story, going = replace(story.with_steps(steps), found=found), True
                break
    return story
