"""The lease of a bench: one named holder at a time, with a secret key and an expiry.

A restart of the daemon begins a new book and so voids every lease.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from bench.base.lifecycle import REFUSAL_WORDS, Refusal, Words, in_one

MAX_HOLDER_LENGTH = 64
"""Characters of a holder's name."""

CAMPAIGN_HOLDER = "campaign "
"""Prefix of a campaign's id as holder of the lease."""

MIN_SECONDS, DEFAULT_SECONDS, MAX_SECONDS = 5.0, 30.0, 600.0
"""Min, default and max duration of a lease, s."""

WARNING = 10.0
"""Longest time before its end for which a lease is called lapsing, s."""


class LeaseRefused(Exception):
    """A refused lease or an invalid key; its `words` never repeat a key."""

    def __init__(self, refusal: Refusal, words: Words | None = None) -> None:
        self.refusal, self.words = refusal, words or REFUSAL_WORDS[refusal]
        super().__init__(in_one(self.words))


@dataclass(frozen=True)
class Lease:
    """One holder's right to move the bench."""

    holder: str
    key: str = field(repr=False)
    """Known to the book and to the holder only."""
    expiry: float
    """Expiry on the clock that every call of the book is given (s)."""
    number: int
    """Counts the leases of a book from 1: no two have the same, also of one holder."""
    seconds: float
    """Duration from each take or renewal, s."""
    sequence: int = 0
    """Sequence number of the newest command with the key; the next one must be higher."""

    def lapses_soon(self, now: float) -> bool:
        """Return whether it lapses within `WARNING` or a quarter of its duration, unless it is renewed."""
        return self.expiry - now < min(WARNING, self.seconds / 4)


def new_key() -> str:
    """Return a key of 128 random bits, 22 characters."""
    from secrets import token_urlsafe  # not for a stop

    return token_urlsafe(16)


def is_holder(name: str) -> bool:
    """Return whether `name` is valid in a lease, in logs and on a terminal."""
    return 0 < len(name) <= MAX_HOLDER_LENGTH and name.isprintable() and name == name.strip()


class LeaseBook:
    """The one lease of a bench. `now` is s on a clock that never goes back.

    Holders and durations are checked before, see `bench.network.command`.
    """

    def __init__(self) -> None:
        self._lease: Lease | None = None
        self._given = 0

    def held(self, now: float) -> Lease | None:
        """Return the lease that is valid at `now`."""
        if self._lease is not None and now >= self._lease.expiry:
            self._lease = None
        return self._lease

    def take(self, holder: str, seconds: float, now: float) -> Lease:
        """Grant the lease to `holder` for `seconds`.

        Raises:
            LeaseRefused: it is held, even by a holder of the same name, who has a separate key.
        """
        if lease := self.held(now):
            raise LeaseRefused(Refusal.HELD, _held_by(lease, now))
        self._given += 1
        self._lease = Lease(holder, new_key(), now + seconds, self._given, seconds)
        return self._lease

    def use(self, key: str, sequence: int, now: float) -> Lease:
        """Accept one command with `key` and `sequence`, and return its lease.

        Raises:
            LeaseRefused: the key is not the holder's, or the sequence does not rise.
        """
        from secrets import compare_digest

        lease = self.held(now)
        if lease is None:
            raise LeaseRefused(Refusal.NO_LEASE)
        if not compare_digest(key.encode(), lease.key.encode()):
            raise LeaseRefused(Refusal.HELD, _held_by(lease, now))
        if sequence <= lease.sequence:
            found = f"sequence {sequence} after {lease.sequence}, repeated or out of order: it was not done"
            raise LeaseRefused(Refusal.SEQUENCE, (found, REFUSAL_WORDS[Refusal.SEQUENCE][1]))
        self._lease = replace(lease, sequence=sequence)
        return self._lease

    def renew(self, key: str, sequence: int, seconds: float, now: float) -> Lease:
        """Renew the lease of `key` for `seconds` from `now`, even if more was left; raises as `use`."""
        self._lease = replace(self.use(key, sequence, now), expiry=now + seconds, seconds=seconds)
        return self._lease

    def release(self, key: str, sequence: int, now: float) -> None:
        """End the lease of `key`; raises as `use`."""
        self.use(key, sequence, now)
        self._lease = None


def _held_by(lease: Lease, now: float) -> Words:
    left = max(0.0, lease.expiry - now)
    fact = f"{lease.holder} holds the bench for {left:.0f} s more"
    return fact, f"wait, or ask {lease.holder} to release it"
