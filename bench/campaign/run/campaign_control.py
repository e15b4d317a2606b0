"""Requests to a campaign from other processes, and its locks: one runner of a campaign, one of a bench."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime
from pathlib import Path

from bench.base.errors import BenchError, Refused
from bench.store.campaigns import CampaignStore
from bench.store.rows import ENDED, CampaignEntry, CampaignState, Standing
from bench.supervisor.ownership import try_lock

MIN_PREFIX_LENGTH = 4
"""Min number of characters of an abbreviated campaign id."""


def answer(
    store: CampaignStore,
    data_dir: Path,
    campaign: str,
    by: str,
    now: datetime,
    balls: int | None = None,
    *,
    number: int | None = None,
) -> tuple[str, bool]:
    """Confirm the work that `campaign` requests; return its prompt, and whether a runner waits for it.

    `balls` is the number of loaded balls, to be checked; None: as listed. `number` is that of the prompt;
    None: the open one.

    Raises:
        Refused: no prompt is open, it requires another number of balls, or its runner has not granted access.
    """
    location, running = f"campaign {campaign}", is_running(data_dir, store.entry(campaign).id)
    prompt = next((one for one in store.prompts(campaign)[-1:] if one.answered is None), None)
    if number is not None and (prompt is None or prompt.number != number):
        found = "this prompt does not wait any more"
        raise Refused(location, found, "the prompt that waits", "Read the present prompt.")
    if prompt is not None:
        if balls is not None:
            prompt.require_count(balls)
        standing = store.standing(campaign)
        if running and (standing.state is not CampaignState.WAITING or standing.reason != prompt.text):
            found = f"no access yet: {standing.reason or standing.state}"
            raise Refused(location, found, "an unlocked guard", "Answer once the prompt is shown.")
    if prompt is None or not store.answer(campaign, prompt.number, by, now):
        expected = "a prompt that waits for an answer"
        raise Refused(location, "no open prompt", expected, "See golfbench campaign list.")
    return prompt.text, running


def ask(store: CampaignStore, data_dir: Path, campaign: str, request: str, by: str = "") -> str:
    """Request "pause", "stop", "abort" or "" (continue) of a campaign's runner; return the effect.

    `by` is the person who requests it.

    Raises:
        Refused: it is over, or has no runner.
    """
    store.entry(campaign)
    standing = store.standing(campaign)
    if standing.state in ENDED:
        location = f"campaign {campaign}"
        raise Refused(location, str(standing.state), "an unfinished campaign", "See golfbench campaign list.")
    if not is_running(data_dir, campaign):
        if request == "abort":
            reason = f"aborted by request{f' of {by}' if by else ''}"
            store.change(campaign, state=CampaignState.ABORTED, reason=reason, requested="")
            return "aborted; it had no runner"
        action = f"golfbench campaign resume {campaign}"
        raise Refused(f"campaign {campaign}", "no runner", "a running campaign", action)
    store.change(campaign, requested=request, requested_by=by)
    return {
        "pause": "pauses after the current shot",
        "stop": "stops after the current shot",
        "abort": "is aborted",
        "": "continues",
    }[request]


def runner_lock(data_dir: Path, campaign: str) -> AbstractContextManager[None]:
    """Return the lock of the only runner of `campaign`; Refused on entering if another process holds it."""
    return _locked(_lock_file(data_dir, campaign), f"campaign {campaign}", campaign)


def bench_lock(data_dir: Path, bench: str, campaign: str = "") -> AbstractContextManager[None]:
    """Return the lock of the only runner on `bench`; Refused on entering if another process holds it."""
    return _locked(data_dir / "campaigns" / f".runner-of-{bench}", f"bench {bench}", campaign)


@contextmanager
def _locked(path: Path, location: str, name: str) -> Iterator[None]:
    """Hold the lock at `path` as the runner of campaign `name`; it ends with the process."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="ascii") as file:
        if not try_lock(file.fileno()):
            file.seek(0)
            process, _, campaign = file.read().strip().partition(" ")
            found = f"process {process}, which runs campaign {campaign}"
            action = f"Wait for it, or end it: golfbench campaign stop {campaign}"
            raise Refused(location, found, "no other runner", action)
        file.truncate(0)
        file.write(f"{os.getpid()} {name}")
        file.flush()
        yield


def is_running(data_dir: Path, name: str) -> bool:
    """Return whether a process runs `name`."""
    path = _lock_file(data_dir, name)
    if not path.exists():
        return False
    with path.open("rb") as file:  # the lock needs no right to write
        return not try_lock(file.fileno())


def standing_now(data_dir: Path, campaign: str, stored: Standing) -> Standing:
    """Return the standing of `campaign`: as `stored`, or interrupted if its runner here has died."""
    open_states = {CampaignState.RUNNING, CampaignState.WAITING, CampaignState.PAUSED}
    if stored.state not in open_states or not _lock_file(data_dir, campaign).exists():
        return stored
    if is_running(data_dir, campaign):
        return stored
    reason = f"its runner ended without closing it; resume it: golfbench campaign resume {campaign}"
    return stored._replace(state=CampaignState.INTERRUPTED, reason=reason)


def _lock_file(data_dir: Path, name: str) -> Path:
    return data_dir / "campaigns" / name / "runner"


def find_campaign(store: CampaignStore, wanted: str) -> CampaignEntry:
    """Return the campaign with id `wanted`, or the only one of that name or whose id begins so.

    Raises:
        BenchError: no campaign, several campaigns, or fewer than `MIN_PREFIX_LENGTH` characters to go by.
    """
    location = f"campaign {wanted}"
    found = [entry for entry, _, _ in store.entries() if entry.id.startswith(wanted)]
    for entry in found:
        if entry.id == wanted:
            return entry
    if not found:
        expected = f"an id, or at least its first {MIN_PREFIX_LENGTH} characters"
        raise BenchError(location, "no such campaign", expected, "See golfbench campaign list.")
    named = [entry for entry in found if entry.name == wanted]
    if len(named) == 1:
        return named[0]
    if len(found) > 1 or len(wanted) < MIN_PREFIX_LENGTH:
        shown = ", ".join(entry.id for entry in found[:5]) + ", ..." * (len(found) > 5)
        number = "1 campaign begins" if len(found) == 1 else f"{len(found)} campaigns begin"
        expected = f"an id, or its beginning that fits one campaign, at least {MIN_PREFIX_LENGTH} characters"
        action = f"Give the id: for the newest, {found[0].id}."
        raise BenchError(location, f"{number} so: {shown}", expected, action)
    return found[0]
