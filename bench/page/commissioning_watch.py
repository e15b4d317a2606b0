"""Publishes the commissionings whenever one has changed, in a thread of its own."""

from __future__ import annotations

import logging
from collections.abc import Callable
from threading import Event, Thread
from typing import Any

from bench.page.commissioning_store import CommissioningStore

TOPIC = "commissioning"
"""Topic on which the page publishes the commissionings."""
_LOOK = 1.0
"""Period of the looks, s."""

_log = logging.getLogger("golfbench")


class CommissioningWatch:
    """Looks at a shelf until it is closed."""

    def __init__(self, shelf: CommissioningStore, publish: Callable[[str, Any], None]) -> None:
        """`publish` gets topic and content."""
        self._shelf, self._publish = shelf, publish
        self._ended = Event()
        self._thread = Thread(target=self._work, name="page-commissioning", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _work(self) -> None:
        shown: dict[str, Any] | None = None
        while True:
            try:
                view = self._shelf.view()
            except OSError as error:  # a folder that goes while it is read
                _log.debug("page: commissionings: %s", error)
            else:
                if view != shown:
                    self._publish(TOPIC, view)
                    shown = view
            if self._ended.wait(_LOOK):
                return
