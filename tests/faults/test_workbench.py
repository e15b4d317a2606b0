"""A workbench keeps the undisturbed runs of the latest instants, and no more."""

from __future__ import annotations

from bench.faults import case


def test_the_oldest_goes_when_there_are_too_many() -> None:
    kept = dict[int, str]()
    for number in range(case._KEPT + 3):
        case._keep(kept, number, str(number))
    assert list(kept) == list(range(3, case._KEPT + 3))
