"""JSON objects in a stream of bytes that marks neither their begin nor their end.

Open Connect sends bare objects: two may come in one segment and one in several. What stands between objects
(line ends, commas, noise) is passed over.
"""

from __future__ import annotations

import re

GREATEST = 64 * 1024
"""Bytes of one object; a shot has about 700."""
DEEPEST = 8
"""Objects in objects; a shot has two levels."""

_OUTSIDE_STRING = re.compile(rb'["{}]')
_IN_STRING = re.compile(rb'["\\]')
_QUOTE, _OPEN, _BACKSLASH = b'"', b"{", b"\\"


class ObjectStream:
    """Takes bytes as they come and gives whole objects, braces and all, as bytes."""

    def __init__(self) -> None:
        self.passed_over = 0
        """Bytes that belong to no object, so far."""
        self.useless = ""
        """Why the stream is of no more use: an object too long or too deep for this protocol."""
        self._forget()

    def _forget(self) -> None:
        self._part = bytearray()
        self._seen, self._depth, self._in_string = 0, 0, False

    @property
    def pending(self) -> int:
        """Bytes of an object whose end has not come."""
        return len(self._part)

    def drop(self) -> None:
        """Give up the object whose end has not come."""
        self.passed_over += len(self._part)
        self._forget()

    def feed(self, more: bytes) -> list[bytes]:
        """Return the objects that `more` completes; none after the first that exceeds GREATEST or DEEPEST."""
        part = self._part
        part += more
        found: list[bytes] = []
        while not self.useless and (self._depth or self._begin()):
            end = self._find_end()
            if (len(part) if end is None else end) > GREATEST:
                self.useless = f"an object of more than {GREATEST} bytes"
            elif self._depth > DEEPEST:
                self.useless = f"objects in objects more than {DEEPEST} deep"
            if end is None or self.useless:
                break
            found.append(bytes(part[:end]))
            del part[:end]
            self._seen = 0
        if self.useless:
            self.drop()
        return found

    def _begin(self) -> bool:
        """Pass over what stands before the next object; tell whether there is one."""
        part = self._part
        start = part.find(_OPEN)
        skipped = len(part) if start < 0 else start
        self.passed_over += skipped
        del part[:skipped]
        self._seen = 0
        return start >= 0

    def _find_end(self) -> int | None:
        """Return the length of the object that begins `_part`, None while its end has not come."""
        part = self._part
        while self._seen < len(part):
            mark = (_IN_STRING if self._in_string else _OUTSIDE_STRING).search(part, self._seen)
            if mark is None:
                self._seen = len(part)
                return None
            symbol, self._seen = mark.group(), mark.end()
            if symbol == _BACKSLASH:
                if self._seen == len(part):  # what it escapes has not come
                    self._seen -= 1
                    return None
                self._seen += 1
            elif symbol == _QUOTE:
                self._in_string = not self._in_string
            elif symbol == _OPEN:
                self._depth += 1
                if self._depth > DEEPEST:
                    return None
            else:
                self._depth -= 1
                if not self._depth:
                    return self._seen
        return None
