"""Ctrl-C, SIGTERM and a closed terminal as a wish."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from bench.base.interrupt import Terminated, deferred_interrupt, stop_on_signals

_STRUCK_EVERYWHERE = """
import signal, sys
from bench.base.interrupt import stop_on_signals

def struck_at(step):  # SIGTERM before the step-th line of StopFlag.wait and of all it calls
    with stop_on_signals() as wish:
        left = step
        def trace(frame, event, argument):
            nonlocal left
            left -= 1
            if left == 0:
                signal.raise_signal(signal.SIGTERM)
            return trace
        sys.settrace(trace)
        wish.wait(0.001)
        sys.settrace(None)
        assert wish.is_made() == (left <= 0)
        return left > 0

step = 1
while not struck_at(step):
    step += 1
print(step)
"""


def test_stop_flag_wait_signal_at_any_line_never_hangs() -> None:
    """A lock that `wait` held when the handler wanted it once kept a process alive for ever."""
    struck = subprocess.run(
        [sys.executable, "-c", _STRUCK_EVERYWHERE], check=True, timeout=60.0, capture_output=True, text=True
    )
    assert int(struck.stdout) > 3


def test_deferred_interrupt_sigint_raises_at_block_end() -> None:
    before, steps = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with deferred_interrupt() as asked:
            for k in range(3):
                if k == 1:
                    signal.raise_signal(signal.SIGINT)
                steps.append(asked.is_made())

    with pytest.raises(KeyboardInterrupt):
        work()
    assert steps == [False, True, True]
    assert signal.getsignal(signal.SIGINT) is before


def test_deferred_interrupt_within_another_leaves_end_to_outer() -> None:
    done = list[str]()

    def nested() -> None:
        with deferred_interrupt() as outer:
            with deferred_interrupt() as inner:
                signal.raise_signal(signal.SIGINT)
            assert inner is outer
            assert outer.is_made()
            done.append("the outer block continues")

    with pytest.raises(KeyboardInterrupt):
        nested()
    assert done


def test_deferred_interrupt_defers_sigterm_only_with_terminate() -> None:
    before, causes = signal.getsignal(signal.SIGTERM), []

    def work() -> None:
        with deferred_interrupt(terminate=True) as asked:
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGINT)
            causes.append((asked.is_made(), asked.cause))

    with pytest.raises(Terminated):
        work()
    assert causes == [(True, "SIGTERM")]
    assert signal.getsignal(signal.SIGTERM) is before
    with deferred_interrupt():
        assert signal.getsignal(signal.SIGTERM) is before


_ON_A_TERMINAL = """
import fcntl, signal, sys, termios, time
from bench.base.interrupt import deferred_interrupt
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
with deferred_interrupt(terminate=True) as asked:
    print("started", flush=True)
    while not asked.is_made():
        time.sleep(0.01)
    print("to a terminal that is closed", flush=True)
    open(sys.argv[1], "w").write(asked.cause)
"""


def test_deferred_interrupt_closed_terminal_reports_sighup(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    command = [sys.executable, "-c", _ON_A_TERMINAL, str(tmp_path / "ended")]
    with subprocess.Popen(
        command, stdin=slave, stdout=slave, stderr=slave, start_new_session=True
    ) as process:
        os.close(slave)
        assert b"started" in os.read(master, 100)
        os.close(master)
        assert process.wait(60.0) == 1  # Terminated
    assert (tmp_path / "ended").read_text() == "SIGHUP"


def test_stop_on_signals_ignored_sighup_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals() as asked:
            signal.raise_signal(signal.SIGHUP)
            assert not asked.is_made()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_deferred_interrupt_sigint_keeps_block_error() -> None:
    before = signal.getsignal(signal.SIGINT)

    def work() -> None:
        with deferred_interrupt():
            signal.raise_signal(signal.SIGINT)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert signal.getsignal(signal.SIGINT) is before


def test_deferred_interrupt_other_thread_gets_no_signal() -> None:
    seen = []

    def work() -> None:
        with deferred_interrupt() as asked:
            seen.append(asked.is_made())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
