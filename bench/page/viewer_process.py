"""Rerun's viewer of the running bench: `golfbench view --web` beside the page, for browsers on this machine.

It is started when it is first opened and ends with the page. It subscribes to what the bench publishes, as
any viewer does: the loop does not notice.
"""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Callable
from tempfile import TemporaryFile
from threading import Lock
from typing import Any

from bench.errors import BenchError
from bench.page.command_line import CommandLine, fault_of, lower_priority, plain_environment

TOPIC = "viewer"
"""Topic on which the page publishes whether the viewer runs."""
START = 120.0
"""Time within which the viewer is to listen, s; the first start compiles."""
_END = 10.0
_LOOK = 0.1
_LONGEST = 20_000
_URL = re.compile(r"http://127\.0\.0\.1:[0-9]{1,5}/\?url=[A-Za-z0-9%._~+-]+")


class ViewerProcess:
    """The viewer, while there is one."""

    def __init__(self, golfbench: CommandLine, publish: Callable[[str, Any], None]) -> None:
        """`publish` gets topic and content."""
        self._golfbench, self._publish = golfbench, publish
        self._process: subprocess.Popen[bytes] | None = None
        self._url = ""
        self._lock = Lock()
        publish(TOPIC, {"open": False})

    def url(self) -> str:
        """Return the URL of the viewer, which is started unless it runs.

        Raises:
            BenchError: it does not start, in its own words.
        """
        with self._lock:
            if self._process is None or self._process.poll() is not None or not self._url:
                self._end()
                self._url = self._started()
                self._publish(TOPIC, {"open": True})
            return self._url

    def close(self) -> None:
        """End the viewer, also while it starts. Allowed twice."""
        if (process := self._process) is not None:
            process.terminate()
        with self._lock:
            self._end()
            self._publish(TOPIC, {"open": False})

    def _started(self) -> str:
        """Start the viewer; return the URL that it prints."""
        with TemporaryFile() as said:
            self._process = process = subprocess.Popen(
                self._golfbench.arguments("view", "--web"),
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=plain_environment(),
            )
            lower_priority(process.pid)
            deadline = time.monotonic() + START
            while True:
                running = process.poll() is None
                text = os.pread(said.fileno(), _LONGEST, 0).decode("utf-8", "replace")
                if url := _URL.search(text):
                    return url[0]
                if not running or time.monotonic() > deadline:
                    break
                time.sleep(_LOOK)
        self._end()
        if running:
            raise BenchError("viewer", "no URL", f"one within {START:g} s", "Try golfbench view --web.")
        raise fault_of("viewer", process.returncode, text)

    def _end(self) -> None:
        """End the process, if there is one."""
        process, self._process, self._url = self._process, None, ""
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
