"""Exported text is decoded by its byte order mark, or by the zeros of UTF-16."""

from __future__ import annotations

import pytest

from bench.base.from_toml import encoding_of


@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
def test_encoding_of_decodes_exported_text(codec: str) -> None:
    content = "name\tvalue\nMüller\t1.5\n".encode(codec)
    assert content.decode(encoding_of(content)) == "name\tvalue\nMüller\t1.5\n"


def test_encoding_of_empty_file_is_utf_8() -> None:
    assert encoding_of(b"") == "utf-8-sig"
