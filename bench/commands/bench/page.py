"""`golfbench page`: the bench in a browser."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from bench.commands.common.options import option
from bench.commands.common.session import Session


def page(
    context: typer.Context,
    host: Annotated[
        str, option("IP address to listen at; 0.0.0.0: all of this machine.", "ADDRESS")
    ] = "127.0.0.1",
    port: Annotated[int, option("Port to listen at.", low=1, high=65535)] = 8600,
    identity: Annotated[str, option("Certificate and key for TLS, without ending.", "PATH")] = "",
    tokens: Annotated[
        Path | None, option("Tokens to sign in with, one a line: operator TOKEN.", "FILE")
    ] = None,
) -> None:
    """Serve the bench's page: its state, and its commands, in a browser.

    On this machine only, unless --host names an address for others, which needs --identity. Ctrl-C ends it;
    the bench does not notice.
    """
    from bench.web.page_access import PageAddress
    from bench.web.page_server import serve_page

    def say(url: str, _: Callable[[], None]) -> None:
        typer.echo(f"{url}  Ctrl-C ends the page")

    session = context.ensure_object(Session)
    given = ("--config", str(session.config)) if session.config else ()
    golfbench = (sys.executable, "-P", "-m", "bench", *given)
    serve_page(session.configuration(), PageAddress(host, port, identity, tokens), golfbench, say)
