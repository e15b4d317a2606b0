"""Prompts to the person at the bench, and the load list of one: the balls of the magazine in their order."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

from bench.base.errors import Refused
from bench.store.records import Prompt


class PromptKind(StrEnum):
    """Kind of a prompt."""

    CLUB = "club"
    BALLS = "balls"
    BENCH = "bench"
    """Restart of the bench, never automatic in simulation."""


Numbered = tuple[str, int]
"""A ball: its model and the number on it."""


def places(balls: Sequence[Numbered]) -> list[str]:
    """Return the places of the magazine with their balls, in the order of hitting."""
    return [f"{location}. {name} {number}" for location, (name, number) in enumerate(balls, 1)]


def balls_of(prompt: Prompt) -> list[Numbered]:
    """Return the load list of `prompt`; empty if it asks for something else."""
    return [(str(name), int(number)) for name, number in prompt.content.get("balls", ())]


def require_count(prompt: Prompt, count: int) -> None:
    """Refuse a number of loaded balls that is not that of the load list.

    Raises:
        Refused: too few or too many, or `prompt` asks for no balls.
    """
    balls = balls_of(prompt)
    location, found = f"before shot {prompt.before_shot}", f"{count} balls loaded"
    if not balls:
        expected = f"no number, as the prompt reads: {prompt.text}"
        raise Refused(location, found, expected, "Answer without a number of balls.")
    if count < len(balls):
        action = (
            f"Load the rest from {places(balls)[count]} on, if the others are by the list; then answer again."
        )
    else:
        action = "Empty the feeder and load it by the list; then answer again."
    if count != len(balls):
        raise Refused(location, found, f"{len(balls)}, as listed", action)
