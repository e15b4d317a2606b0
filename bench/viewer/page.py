"""Proxy of Rerun's web page with a policy that restricts the browser to this machine's viewer.

The page requests fonts, a script and news from the internet and sends usage statistics; with this policy
(Content-Security-Policy) the browser contacts this machine only.
"""

from __future__ import annotations

import http.client
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Self

LOOPBACK = "127.0.0.1"

_PASSED_ON = ("Content-Type", "Content-Encoding", "Content-Length", "Cache-Control", "ETag")
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


class ViewerPage:
    """A server on the loopback that forwards the pages of Rerun's server at `source_port`."""

    def __init__(self, port: int, source_port: int, data_port: int) -> None:
        """Listen at `port`; 0 chooses a free one.

        Raises:
            OSError: the port is in use.
        """
        policy = content_policy(data_port)

        class Handler(BaseHTTPRequestHandler):
            """Answers GET and HEAD."""

            protocol_version = "HTTP/1.1"
            timeout = _TIMEOUT

            def do_GET(self) -> None:
                """Forward a file."""
                self._pass_on()

            do_HEAD = do_GET  # noqa: N815 - the library's name

            def log_message(self, format: str, *args: object) -> None:
                """Log nothing."""

            def _pass_on(self) -> None:
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
                    if name != "Content-Length" and (value := answer.getheader(name)) is not None:
                        self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.send_header("Content-Security-Policy", policy)
                self.send_header("Referrer-Policy", "no-referrer")
                self.end_headers()
                if self.command == "GET":
                    self.wfile.write(body)

        self._server = ThreadingHTTPServer((LOOPBACK, port), Handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="viewer page", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
