"""Notifications by mail, webhook or chat when a campaign waits for a person, is suspended or finishes.

`apprise` sends them from a thread of its own, with retries: no shot waits for it. URLs of services hold
passwords and tokens. They are in a file that only its owner may read, and in no message, log or record.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import TYPE_CHECKING, NamedTuple

from bench.campaign.runner import Watcher
from bench.errors import BenchError
from bench.from_toml import read_text
from bench.store.records import CampaignEntry, CampaignState

if TYPE_CHECKING:
    from apprise import NotifyBase

WAITS = (0.0, 3.0, 15.0, 60.0)
"""Times before the attempts at a notification, s."""
LAST_PATIENCE = 10.0
"""Max time for notifications that are still on their way at the end of a run, s."""
_MOST = 50
"""Max number of waiting notifications; a newer one is dropped."""
_WORDS = {
    CampaignState.WAITING: "waits for a person",
    CampaignState.SUSPENDED: "is suspended",
    CampaignState.FINISHED: "is finished",
}


class Service(NamedTuple):
    """One service that receives notifications."""

    place: str
    """File and line of its URL, for messages."""
    send: Callable[[str, str], bool]
    """Send title and text; return whether it was accepted."""


def read_services(file: Path) -> list[Service]:
    """Return the services in `file`: one URL of apprise a line; empty lines and comments (#) do not count.

    Raises:
        BenchError: apprise is not installed; the file is missing or others may read it; a URL is unknown.
    """
    try:
        import apprise
    except ImportError as error:
        action = 'Run pip install "golfbench[notify]", or leave notifications.file empty.'
        raise BenchError(
            "notifications.file", f"package apprise is not installed ({error})", "apprise", action
        ) from error
    log = logging.getLogger("apprise")
    log.propagate = False  # its texts may name a URL
    log.addHandler(logging.NullHandler())
    text = read_text(file, "a text file", "Write the URLs of the services to it, one a line.")
    mode = file.stat().st_mode
    if mode & 0o077:
        expected, action = "readable by its owner only: it holds secrets", f"chmod 600 {file}"
        raise BenchError(f"notifications.file: {file}", f"mode {mode & 0o777:o}", expected, action)
    services = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        place, one = f"{file}, line {number}", apprise.Apprise.instantiate(line)
        if one is None:
            action = "See apprise's list of services. The line is not shown: it may hold a secret."
            raise BenchError(place, "a URL that apprise does not know", "the URL of a service", action)
        services.append(Service(place, _sender(one)))
    return services


def _sender(plugin: NotifyBase) -> Callable[[str, str], bool]:
    """Return what sends by `plugin` in the calling thread: apprise's own pool would outlive the run."""

    def send(title: str, text: str) -> bool:
        return bool(plugin.notify(title=title, body=text))

    return send


class Notifier(Watcher):
    """Sends each state of a campaign that a person should know, from a thread, to all services."""

    def __init__(
        self,
        entry: CampaignEntry,
        services: Sequence[Service],
        say: Callable[[str], None],
        waits: Sequence[float] = WAITS,
    ) -> None:
        """`say` shows that a notification could not be sent."""
        self._entry, self._services, self._say, self._waits = entry, services, say, waits
        self._queue: Queue[tuple[str, str]] = Queue(_MOST)
        self._closing = Event()
        self._thread = Thread(target=self._work, name="notifier", daemon=True)
        self._thread.start()

    def standing(self, state: CampaignState, reason: str) -> None:
        """Send a state that a person should know; returns at once."""
        if word := _WORDS.get(state):
            title = f"golfbench {self._entry.bench}: {self._entry.name} {word}"
            with suppress(Full):
                self._queue.put_nowait((title, f"{reason or self._entry.title}\ncampaign {self._entry.id}"))

    def close(self, patience: float = LAST_PATIENCE) -> None:
        """Wait up to `patience` (s) for what is on its way, then give it up."""
        self._closing.set()
        self._thread.join(patience)
        if self._thread.is_alive():
            self._say("Notifications were still on their way at the end; they are given up.")

    def _work(self) -> None:
        while True:
            try:
                title, text = self._queue.get(timeout=0.1)
            except Empty:
                if self._closing.is_set():
                    return
                continue
            for service in self._services:
                self._deliver(service, title, text)

    def _deliver(self, service: Service, title: str, text: str) -> None:
        for wait in self._waits:
            time.sleep(wait)
            with suppress(Exception):  # whatever a service does, the campaign goes on
                if service.send(title, text):
                    return
        self._say(f"A notification was not sent ({service.place}): {title}")


@contextmanager
def notifying(
    file: str, entry: CampaignEntry, say: Callable[[str], None], waits: Sequence[float] = WAITS
) -> Iterator[Watcher]:
    """Notify the services in `file` of the states of `entry`; none if `file` is empty.

    Raises:
        BenchError: as `read_services`.
    """
    if not file:
        yield Watcher()
        return
    notifier = Notifier(entry, read_services(Path(file)), say, waits)
    try:
        yield notifier
    finally:
        notifier.close()
