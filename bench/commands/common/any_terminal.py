"""Output on terminals that cannot show every character, or are not there to be written to."""

from __future__ import annotations

import codecs
import sys
from io import TextIOWrapper

_PLAIN = {"°": " deg", "±": "+-", "µ": "u", "×": "x", "²": "^2", "³": "^3", "·": "*"}
_PLAIN |= {"–": "-", "—": "-", "…": "..."}
_PLAIN |= {"−": "-", "→": "->", "←": "<-", "≤": "<=", "≥": ">=", "∞": "inf", "θ": "theta", "β": "beta"}
_PLAIN |= {"✓": "ok", "✗": "x", "●": "*", "○": "o", "’": "'", "“": '"', "”": '"'}
_PLAIN |= dict(zip("▁▂▃▄▅▆▇█▏", "__..-=+#|", strict=True))
"""Replacements for characters that a terminal's encoding lacks; all others become "?"."""

_HANDLER = "golfbench.plain"


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Return plain characters for those that cannot be encoded, and the position after them."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_PLAIN.get(character, "?") for character in lacking), error.end


def accept_any_text() -> None:
    """Let standard output and errors take any text, whatever the encoding of the terminal."""
    codecs.register_error(_HANDLER, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)
