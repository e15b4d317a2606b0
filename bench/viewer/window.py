"""Rerun's viewer as a separate process, in a window or behind a web page, on the loopback only.

By default Rerun listens on all interfaces and sends usage statistics. Therefore it is started with
`--bind 127.0.0.1` and with a separate configuration folder in which the statistics are disabled, verified
before the start. Its web page requests fonts, a script and news from the internet and sends usage statistics:
it is served by a proxy with a policy (Content-Security-Policy), so that the browser contacts this machine
only.
"""

from __future__ import annotations

import http.client
import importlib.util
import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self
from urllib.parse import quote

from bench.base.address import free_port
from bench.base.errors import BenchError, ExitCode

LOOPBACK = "127.0.0.1"

_PASSED_ON = ("Content-Type", "Content-Encoding", "Cache-Control", "ETag")
_TIMEOUT = 30.0
_MAX_PATH = 4096


def content_policy(data_port: int) -> str:
    """Return the policy of a page with its data at `data_port` of the loopback."""
    return "; ".join(
        (
            "default-src 'none'",
            "script-src 'self' 'unsafe-inline' 'unsafe-eval' 'wasm-unsafe-eval' blob:",
            "worker-src 'self' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src 'self' data:",
            f"connect-src 'self' data: blob: http://{LOOPBACK}:{data_port}",
            "frame-ancestors 'none'",
            "form-action 'none'",
            "base-uri 'self'",
        )
    )


@contextmanager
def viewer_page(source_port: int, data_port: int) -> Iterator[int]:
    """Forward the pages of Rerun's server at `source_port` from a server on the loopback; yield its port."""
    policy = content_policy(data_port)

    class Handler(BaseHTTPRequestHandler):
        """Answers GET and HEAD."""

        protocol_version = "HTTP/1.1"
        timeout = _TIMEOUT

        def do_GET(self) -> None:
            """Forward a file."""
            if not self.path.startswith("/") or len(self.path) > _MAX_PATH:
                self.send_error(404)
                return
            source = http.client.HTTPConnection(LOOPBACK, source_port, timeout=_TIMEOUT)
            try:
                asked = {"Accept-Encoding": self.headers.get("Accept-Encoding", "identity")}
                source.request("GET", self.path, headers=asked)
                answer = source.getresponse()
                body = answer.read()
            except (OSError, http.client.HTTPException):
                self.send_error(502)
                return
            finally:
                source.close()
            self.send_response(answer.status)
            for name in _PASSED_ON:
                if (value := answer.getheader(name)) is not None:
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Content-Security-Policy", policy)
            self.send_header("Referrer-Policy", "no-referrer")
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(body)

        do_HEAD = do_GET  # noqa: N815 - the library's name

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing."""

    with ThreadingHTTPServer((LOOPBACK, 0), Handler) as server:
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, name="viewer page", daemon=True)
        thread.start()
        try:
            yield int(server.server_address[1])
        finally:
            server.shutdown()
            thread.join()


MEMORY = "2GB"
"""Memory limit of the viewer."""
_START = 30.0
"""Startup time-out, s."""
_END = 5.0
_FORCED = "FORCE_RERUN_ANALYTICS"
"""Environment variable that would enable the statistics."""
_PROXIES = tuple(f(f"{name}_proxy") for name in ("all", "http", "https") for f in (str.lower, str.upper))


class ViewerFailed(BenchError):
    """Rerun's viewer is not running."""

    exit_code = ExitCode.DEVICE


def rerun_program() -> Path:
    """Return the path of Rerun's executable.

    Not the script of that name in the environment: ending the script leaves the viewer running.

    Raises:
        ViewerFailed: the package has no executable for this machine.
    """
    found = importlib.util.find_spec("rerun_cli")
    for folder in (found and found.submodule_search_locations) or ():
        if (program := Path(folder) / "rerun").exists():
            return program
    raise ViewerFailed(
        "Rerun's viewer",
        "no program in the package rerun-sdk",
        "rerun-sdk with its viewer",
        "Reinstall rerun-sdk, or write a file with --save and open it on another machine.",
    )


def quiet_environment(folder: Path, environment: Mapping[str, str]) -> dict[str, str]:
    """Return `environment` for Rerun with its usage statistics disabled in `folder`, verified.

    Raises:
        ViewerFailed: they could not be disabled.
    """
    quiet = {key: value for key, value in environment.items() if key != _FORCED}
    # It also checks the internet for updates: block that with a proxy that does not exist.
    quiet |= dict.fromkeys(_PROXIES, f"http://{LOOPBACK}:9")
    quiet |= {"NO_PROXY": LOOPBACK, "no_proxy": LOOPBACK}
    quiet |= {"XDG_CONFIG_HOME": str(folder / "config"), "XDG_DATA_HOME": str(folder / "data")}
    command = [str(rerun_program()), "analytics", "disable"]
    subprocess.run(command, env=quiet, capture_output=True, timeout=_START, check=False)
    try:
        settings = json.loads((folder / "config" / "rerun" / "analytics.json").read_text(encoding="utf-8"))
        if settings["analytics_enabled"] is False:
            return quiet
        found = f"analytics_enabled {settings['analytics_enabled']}"
    except (OSError, ValueError, KeyError, TypeError) as error:
        found = f"no settings to read back ({error})"
    raise ViewerFailed(
        "Rerun's usage statistics", found, "them disabled", "Report it; --save FILE works without viewer."
    )


class RerunWindow:
    """A viewer that runs until closed by its user or at the end of a `with`."""

    def __init__(self, *, web: bool) -> None:
        """Start the viewer, for a browser or on the screen, and wait until it listens, at free ports.

        Beyond MEMORY old data are dropped.

        Raises:
            BenchError: there is no screen.
            ViewerFailed: it does not start.
        """
        if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            expected, action = "one for the viewer's window", "Use --web and a browser, or --save FILE."
            raise BenchError("screen", "none (neither DISPLAY nor WAYLAND_DISPLAY is set)", expected, action)
        self._page_port: int | None = None
        self._stack = ExitStack()
        try:
            folder = Path(self._stack.enter_context(TemporaryDirectory(prefix="golfbench-view-")))
            environment = quiet_environment(folder, os.environ)
            environment.setdefault("XDG_RUNTIME_DIR", str(folder))
            self.port = free_port()
            source_port = free_port() if web else None
            arguments = ["--bind", LOOPBACK, "--port", str(self.port), "--hide-welcome-screen"]
            shown = ["--memory-limit", MEMORY]
            served = ["--serve-web", "--web-viewer-port", str(source_port), "--server-memory-limit", MEMORY]
            arguments += served if web else shown
            self._said = self._stack.enter_context((folder / "said").open("w+b"))
            self._process = subprocess.Popen(
                [str(rerun_program()), *arguments],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=self._said,
                stderr=self._said,
            )
            self._stack.callback(self._end)
            self._wait_until_it_listens([port for port in (self.port, source_port) if port is not None])
            if source_port is not None:
                self._page_port = self._stack.enter_context(viewer_page(source_port, self.port))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it is still open."""
        return self._process.poll() is None

    @property
    def url(self) -> str:
        """URL for sending recordings."""
        return f"rerun+http://{LOOPBACK}:{self.port}/proxy"

    @property
    def page(self) -> str | None:
        """URL for a browser on this machine; None without --web."""
        if self._page_port is None:
            return None
        return f"http://{LOOPBACK}:{self._page_port}/?url={quote(self.url, safe='')}"

    def close(self) -> None:
        """Close the viewer. May be called twice."""
        self._stack.close()

    def _end(self) -> None:
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END)
        self._process.kill()
        self._process.wait()

    def _wait_until_it_listens(self, ports: list[int]) -> None:
        deadline = time.monotonic() + _START
        while not all(map(_listens, ports)):
            if not self.alive or time.monotonic() > deadline:
                self._said.seek(0)
                lines = self._said.read().decode("utf-8", "replace").strip().splitlines()
                what = "does not listen" if self.alive else f"ended with {self._process.returncode}"
                raise ViewerFailed(
                    "Rerun's viewer",
                    f"{what}: {lines[-1][:200] if lines else 'no output'}",
                    "an open window and port",
                    "Try --web, or --save FILE.",
                )
            time.sleep(0.05)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.5)
        return probe.connect_ex((LOOPBACK, port)) == 0
