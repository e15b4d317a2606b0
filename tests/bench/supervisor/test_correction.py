"""A correction on its way into the loop: taken at rest only, whole or not at all, and taken back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bench.supervisor._supervision import CorrectionReader
from bench.supervisor.child_process import (
    CORRECTED,
    CORRECTED_FILE,
    CORRECTION,
    CORRECTION_FILE,
    pack_correction,
    weights_of,
)
from bench.swing.correction import basis_of
from bench.swing.library import find_profile
from bench.swing.profile import load_profile
from drivers.base.shared_memory import SharedRecord

PROFILE = load_profile(find_profile("default"))
BASIS = basis_of(PROFILE)


class Bench:
    """The supervisor's side of the files."""

    def __init__(self, folder: Path) -> None:
        self.orders = SharedRecord.create(folder / CORRECTION_FILE, CORRECTION)
        self.loop = CorrectionReader(folder, PROFILE, BASIS)
        self._told = SharedRecord.open(folder / CORRECTED_FILE, CORRECTED)

    def order(self, number: int, weights: list[float]) -> None:
        self.orders.write(pack_correction(number, weights))

    @property
    def told(self) -> np.void:
        told = np.zeros(1, CORRECTED)
        self._told.read(told)
        record: np.void = told[0]
        return record

    def close(self) -> None:
        self._told.close()
        self.loop.close()
        self.orders.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(tmp_path)
    yield bench
    bench.close()


def test_correction_reader_order_at_rest_applies_and_reports_tick(bench: Bench) -> None:
    assert bench.loop.take(1, resting=True) is None
    weights = np.random.default_rng(1).uniform(-1, 1, BASIS.size)
    bench.order(1, weights.tolist())
    taken = bench.loop.take(7, resting=True)
    assert taken is not None
    wanted = BASIS.correction(weights).applied_to(PROFILE)
    for name in ("angle", "velocity", "valve"):
        table = getattr(taken, name)
        assert np.array_equal(table, getattr(wanted, name))
        assert table.flags.c_contiguous  # the compiled controller takes no other
    assert np.array_equal(taken.angle[0], PROFILE.angle[0])
    assert (bench.told["asked"], bench.told["tick"]) == (1, 7)
    assert weights_of(bench.told["order"]) == weights.tolist()
    assert bench.loop.take(8, resting=True) is None


@pytest.mark.parametrize(("weights", "resting"), [(BASIS.size, False), (BASIS.size - 1, True)])
def test_correction_reader_order_in_motion_or_of_wrong_size_is_answered_and_dropped(
    bench: Bench, weights: int, resting: bool
) -> None:
    bench.order(1, [0.5] * weights)
    assert bench.loop.take(3, resting=resting) is None
    assert (bench.told["asked"], bench.told["order"]["number"]) == (1, 0)
    assert bench.loop.take(4, resting=True) is None


def test_correction_reader_empty_weights_restores_profile(bench: Bench) -> None:
    bench.order(1, [0.5] * BASIS.size)
    bench.loop.take(3, resting=True)
    bench.order(2, [])
    assert bench.loop.take(4, resting=True) is PROFILE
    assert (bench.told["tick"], bench.told["order"]["number"], bench.told["order"]["size"]) == (4, 2, 0)
