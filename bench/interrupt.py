"""Ctrl-C as a question that a running swing asks, instead of an exception in the middle of a tick."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def deferred_interrupt() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets; at the block's end a Ctrl-C that came raises KeyboardInterrupt.

    Inside the block the robot is brought to rest and files are written whole; `golfbench` then ends with
    exit code 130. Outside the main thread, which gets no signals, the event is never set.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    before = signal.signal(signal.SIGINT, lambda *_: asked.set())
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
    if asked.is_set():
        raise KeyboardInterrupt


@contextmanager
def wish_to_end() -> Iterator[threading.Event]:
    """Yield an event that SIGTERM and Ctrl-C set."""
    wish = threading.Event()
    kept = {
        number: signal.signal(number, lambda *_: wish.set()) for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield wish
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
