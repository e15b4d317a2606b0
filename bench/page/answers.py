"""Answers of the page to a browser, as JSON."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from bench.errors import BenchError
from bench.network.client import CommandRefused
from bench.network.status_words import sentence
from bench.network.zenoh_session import NoAnswer

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


class InvalidBody(Exception):
    """A request whose body is not what the page sends."""


def json_answer(content: Any, status: int = 200) -> Response:
    """Return `content` as a response."""
    from starlette.responses import Response

    return Response(json.dumps(content, allow_nan=False), status, media_type="application/json")


def refusal_answer(error: BenchError) -> Response:
    """Return `error` in the operator's words: `what` was found, and the `cure`."""
    if isinstance(error, CommandRefused):
        what, cure = sentence(error.answer.reason), sentence(error.answer.cure)
        return json_answer({"what": what, "cure": cure or "Look at the state of the bench."}, 409)
    if isinstance(error, NoAnswer):
        what = "The bench does not answer: it is unknown whether the command arrived."
        return json_answer({"what": what, "cure": "Look at the robot. Nothing is sent again by itself."}, 504)
    what = f"{error.place}: {error.found}; expected {error.expected}."
    return json_answer({"what": f"{what[:1].upper()}{what[1:]}", "cure": error.cure}, 409)


async def body_of(request: Request) -> dict[str, Any]:
    """Return the JSON object in the body of `request`.

    Raises:
        InvalidBody: it is no object.
    """
    try:
        read = json.loads(await request.body())
    except (ValueError, RecursionError):
        read = None
    if not isinstance(read, dict):
        raise InvalidBody("no JSON object")
    return read


def text_in(body: dict[str, Any], name: str, longest: int, shortest: int = 1) -> str:
    """Return the text `name` of `body`, without surrounding blanks.

    Raises:
        InvalidBody: it is missing, no text, too short or too long, or has control characters.
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
