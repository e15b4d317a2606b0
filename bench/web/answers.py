"""Requests of a browser and the page's answers to them, both JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from bench.base.errors import BenchError
from bench.base.json_schema import json_object
from bench.network.client import CommandRefused
from bench.network.status_words import sentence
from bench.network.zenoh_session import NoAnswer

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

MAX_NAME_LENGTH = 64
"""Max length of a person's name, characters."""


class InvalidBody(Exception):
    """A request with a body that the page does not send."""


class UnknownName(Exception):
    """A request whose path names nothing that there is."""


class Asked(NamedTuple):
    """A request of a reader whose role allows it."""

    path: Mapping[str, str]
    """Names in its path."""
    body: dict[str, Any]
    ticket: str
    """Ticket of the tab's lease; empty: none."""
    check: Callable[[str, float | None], None]
    """Takes each number once, as `CommandNumbers.check`."""

    def text(self, name: str, longest: int = MAX_NAME_LENGTH, shortest: int = 1) -> str:
        """Return the text `name` of the body; raises as `text_in`."""
        return text_in(self.body, name, longest, shortest)

    def number(self, name: str) -> float:
        """Return the number `name` of the body; raises as `number_in`."""
        return number_in(self.body, name)

    def units(self) -> str:
        """Return the reader's units, "si" or "us"; raises InvalidBody if they are neither."""
        if (units := self.body.get("units")) not in ("si", "us"):
            raise InvalidBody("units: si or us")
        return str(units)

    def once(self, *, fresh: bool = False) -> None:
        """Refuse a repeated request; with `fresh` also one from an outdated screen.

        Raises:
            InvalidBody: it has no number; `fresh`: or no time.
            Refused: as `CommandNumbers.check`.
        """
        self.check(self.text("number", 64, 8), self.number("seen") if fresh else None)


def json_answer(content: Any, status: int = 200) -> Response:
    """Return `content` as a response."""
    from starlette.responses import Response

    return Response(json.dumps(content, allow_nan=False), status, media_type="application/json")


def refusal_answer(error: BenchError) -> Response:
    """Return `error` in the operator's words: `what` was found, and the `action`."""
    if isinstance(error, CommandRefused):
        what, action = sentence(error.answer.reason), sentence(error.answer.action)
        return json_answer({"what": what, "action": action or "Look at the state of the bench."}, 409)
    if isinstance(error, NoAnswer):
        what = "The bench does not answer: it is unknown whether the command arrived."
        return json_answer(
            {"what": what, "action": "Look at the robot. No command is repeated automatically."}, 504
        )
    what = f"{error.location}: {error.found}; expected {error.expected}."
    return json_answer({"what": f"{what[:1].upper()}{what[1:]}", "action": error.action}, 409)


async def body_of(request: Request) -> dict[str, Any]:
    """Return the JSON object in the body of `request`, whose length the request filter has checked.

    Raises:
        InvalidBody: it is no object, or the connection ended before all of it had arrived.
    """
    from starlette.requests import ClientDisconnect

    try:
        body = await request.body()
    except ClientDisconnect:
        raise InvalidBody("cut off") from None
    if (read := json_object(body)) is None:
        raise InvalidBody("no JSON object")
    return read


def text_in(body: dict[str, Any], name: str, longest: int, shortest: int = 1) -> str:
    """Return the text `name` of `body`, without surrounding blanks.

    Raises:
        InvalidBody: it is missing, no text, of invalid length, or has control characters.
    """
    value = body.get(name)
    if not isinstance(value, str) or not shortest <= len(value.strip()) <= longest:
        raise InvalidBody(f"{name}: a text of {shortest} to {longest} characters")
    if not value.strip().isprintable():
        raise InvalidBody(f"{name}: printable characters only")
    return value.strip()


def number_in(body: dict[str, Any], name: str) -> float:
    """Return the finite number `name` of `body`.

    Raises:
        InvalidBody: it is missing or no such number.
    """
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
        raise InvalidBody(f"{name}: a number")
    return float(value)
