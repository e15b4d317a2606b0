"""Split an unframed byte stream into JSON objects.

Open Connect sends bare objects: one segment may hold several, and one object may span several segments.
Bytes between objects (line ends, commas, noise) are skipped.
"""

from __future__ import annotations

import re

MAX_OBJECT_SIZE = 64 * 1024
"""Maximum bytes of one object; a shot has about 700."""
MAX_DEPTH = 8
"""Maximum nesting depth; a shot has two levels."""

_OUTSIDE_STRING = re.compile(rb'["{}]')
_IN_STRING = re.compile(rb'["\\]')
_QUOTE, _OPEN, _BACKSLASH = b'"', b"{", b"\\"


class ObjectStream:
    """Collects received bytes and returns complete objects, with their braces, as bytes."""

    def __init__(self) -> None:
        self.passed_over = 0
        """Number of bytes outside objects."""
        self.error = ""
        """Why the stream is invalid: an object too long or too deep; empty while valid."""
        self._forget()

    def _forget(self) -> None:
        self._part = bytearray()
        self._seen, self._depth, self._in_string = 0, 0, False

    @property
    def pending(self) -> int:
        """Number of bytes of the incomplete object."""
        return len(self._part)

    def drop(self) -> None:
        """Drop the incomplete object."""
        self.passed_over += len(self._part)
        self._forget()

    def feed(self, more: bytes) -> list[bytes]:
        """Return the objects that `more` completes, up to the first that is too large or too deep."""
        part = self._part
        part += more
        found: list[bytes] = []
        while not self.error and (self._depth or self._begin()):
            end = self._find_end()
            if (len(part) if end is None else end) > MAX_OBJECT_SIZE:
                self.error = f"an object of more than {MAX_OBJECT_SIZE} bytes"
            elif self._depth > MAX_DEPTH:
                self.error = f"objects in objects more than {MAX_DEPTH} deep"
            if end is None or self.error:
                break
            found.append(bytes(part[:end]))
            del part[:end]
            self._seen = 0
        if self.error:
            self.drop()
        return found

    def _begin(self) -> bool:
        """Skip the bytes before the next object; return whether an object begins."""
        part = self._part
        start = part.find(_OPEN)
        skipped = len(part) if start < 0 else start
        self.passed_over += skipped
        del part[:skipped]
        self._seen = 0
        return start >= 0

    def _find_end(self) -> int | None:
        """Return the length of the object at the begin of `_part`, None while incomplete."""
        part = self._part
        while self._seen < len(part):
            mark = (_IN_STRING if self._in_string else _OUTSIDE_STRING).search(part, self._seen)
            if mark is None:
                self._seen = len(part)
                return None
            symbol, self._seen = mark.group(), mark.end()
            if symbol == _BACKSLASH:
                if self._seen == len(part):  # the escaped character is missing
                    self._seen -= 1
                    return None
                self._seen += 1
            elif symbol == _QUOTE:
                self._in_string = not self._in_string
            elif symbol == _OPEN:
                self._depth += 1
                if self._depth > MAX_DEPTH:
                    return None
            else:
                self._depth -= 1
                if not self._depth:
                    return self._seen
        return None
