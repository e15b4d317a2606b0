"""A case is judged by what endangers: a head that came off by its own speed, not by the bare shaft's."""

from __future__ import annotations

import pytest

from bench.faults import matrix
from bench.faults.catalogue import Breakage, Instant
from bench.faults.matrix import Workbench
from sim.faults import Fault
from tests.compiled_only import needs_speed


def test_keep_above_limit_drops_oldest() -> None:
    kept = dict[int, str]()
    for number in range(matrix._KEPT + 3):
        matrix._keep(kept, number, str(number))
    assert list(kept) == list(range(3, matrix._KEPT + 3))


HEAD_LOST = Breakage(Fault("club head lost", "club head", "off"))


@needs_speed
@pytest.mark.parametrize(("before_ball", "share"), [(42, 0.72), (6, 0.99)], ids=["42 ms", "6 ms"])
def test_lost_club_head_share_uses_release_speed(
    workbench: Workbench, before_ball: int, share: float
) -> None:
    at = Instant("downswing", workbench.profile.begins[6] - 2 - before_ball)
    outcome = workbench.run(HEAD_LOST, at)
    assert outcome.head_share == pytest.approx(share, abs=0.05)
    assert outcome.verdict == "safe"
