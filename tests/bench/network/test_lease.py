"""One holder at a time, a key that only the holder knows, automatic expiry."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from bench.network.lease import (
    MAX_HOLDER_LENGTH,
    MAX_SECONDS,
    MIN_SECONDS,
    LeaseBook,
    LeaseRefused,
    is_holder,
    new_key,
)

DURATIONS = st.floats(MIN_SECONDS, MAX_SECONDS)
NAMES = st.sampled_from(["Ann", "Bob", "Dr. Ó Súilleabháin", "x" * MAX_HOLDER_LENGTH])


def test_lease_book_second_holder_refusal_omits_key() -> None:
    book = LeaseBook()
    lease = book.take("Ann", 30.0, now=100.0)
    with pytest.raises(LeaseRefused, match="Ann holds the bench for 12 s more") as refused:
        book.take("Bob", 30.0, now=118.0)
    assert lease.key not in str(refused.value)
    assert lease.key not in repr(lease)


def test_lease_book_lease_numbers_are_unique() -> None:
    """However soon one follows the other, also of one holder."""
    book = LeaseBook()
    numbers = []
    for _ in range(3):
        lease = book.take("Ann", 30.0, now=0.0)
        numbers.append(lease.number)
        assert book.renew(lease.key, 1, 60.0, now=0.0).number == lease.number
        book.release(lease.key, 2, now=0.0)
    numbers.append(book.take("Bob", 5.0, now=0.0).number)
    assert numbers == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "name", ["", " ", " Ann", "Ann ", "A\nB", "A\x1b[31m", "x" * 65, "\ud800", "A\u202eB"]
)
def test_is_holder_unprintable_or_blank_name_is_rejected(name: str) -> None:
    assert not is_holder(name)


@given(st.text())
def test_lease_book_every_valid_holder_is_accepted(name: str) -> None:
    if is_holder(name):
        assert name in str(LeaseBook().take(name, 30.0, 0.0).holder)


def test_new_key_returns_unique_keys() -> None:
    assert len({new_key() for _ in range(1000)}) == 1000


class OneHolderAtATime(RuleBasedStateMachine):
    """Whatever is asked in whatever order: only the newest key counts, only until its end, only rising."""

    def __init__(self) -> None:
        super().__init__()
        self.book = LeaseBook()
        self.now = 0.0
        self.keys: list[str] = []
        self.key: str | None = None
        self.holder, self.end, self.sequence = "", 0.0, 0

    def held(self) -> bool:
        return self.key is not None and self.now < self.end

    def allowed(self, key: str, sequence: int) -> bool:
        return self.held() and key == self.key and sequence > self.sequence

    @rule(seconds=st.floats(0.0, 100.0))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    @rule()
    def wait_until_end(self) -> None:
        self.now = max(self.now, self.end)

    @rule(holder=NAMES, seconds=DURATIONS)
    def take(self, holder: str, seconds: float) -> None:
        if self.held():
            with pytest.raises(LeaseRefused) as refused:
                self.book.take(holder, seconds, self.now)
            assert self.holder in str(refused.value)
            assert not any(key in str(refused.value) for key in self.keys)
            return
        lease = self.book.take(holder, seconds, self.now)
        assert lease.key not in self.keys
        assert lease.key not in repr(lease)
        self.keys.append(lease.key)
        self.key, self.holder, self.end, self.sequence = lease.key, holder, self.now + seconds, 0

    @precondition(lambda self: self.keys)
    @rule(data=st.data(), sequence=st.integers(0, 12), what=st.sampled_from(["use", "renew", "release"]))
    def command(self, data: st.DataObject, sequence: int, what: str) -> None:
        key = data.draw(st.sampled_from([*self.keys, new_key()]))
        seconds = data.draw(DURATIONS)
        commands: dict[str, Callable[[], object]] = {
            "use": lambda: self.book.use(key, sequence, self.now),
            "renew": lambda: self.book.renew(key, sequence, seconds, self.now),
            "release": lambda: self.book.release(key, sequence, self.now),
        }
        if not self.allowed(key, sequence):
            with pytest.raises(LeaseRefused) as refused:
                commands[what]()
            assert key not in str(refused.value)
            return
        commands[what]()
        self.sequence = sequence
        if what == "renew":
            self.end = self.now + seconds
        elif what == "release":
            self.key = None

    @invariant()
    def the_book_knows_who_holds_the_bench(self) -> None:
        lease = self.book.held(self.now)
        assert (lease is not None) == self.held()
        if lease is not None:
            assert (lease.holder, lease.key, lease.expiry) == (self.holder, self.key, self.end)


class LongOneHolderAtATime(OneHolderAtATime):
    """The same more often, before a release."""


few = settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
many = settings(few, max_examples=100)
OneHolderAtATime.TestCase.settings, LongOneHolderAtATime.TestCase.settings = few, many
TestOneHolderAtATime = OneHolderAtATime.TestCase
TestLongOneHolderAtATime = pytest.mark.release(LongOneHolderAtATime.TestCase)
