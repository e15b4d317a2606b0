"""Encoding of text files that other programs export."""

from __future__ import annotations

from codecs import BOM_UTF16_BE, BOM_UTF16_LE


def encoding_of(content: bytes) -> str:
    """Return the codec of `content`: UTF-16 by its mark or its zero second byte, else UTF-8."""
    if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)):
        return "utf-16"
    return "utf-16-le" if content[1:2] == b"\0" else "utf-8-sig"
