"""Text reaches a terminal of any encoding."""

from __future__ import annotations

import sys
from io import BytesIO, TextIOWrapper

import pytest

from bench.commands.common.any_terminal import accept_any_text


@pytest.mark.parametrize(
    ("encoding", "written"),
    [
        ("ascii", "12.5 deg +- 3 um - ... <= ?"),
        ("iso8859-15", "12.5° ± 3 µm - ... <= ?"),
        ("cp437", "12.5° ± 3 µm - ... ≤ ?"),
        ("utf-8", "12.5° ± 3 µm – … ≤ \N{BLACK CHESS KING}"),
    ],
)
def test_accept_any_text_missing_characters_are_replaced(
    monkeypatch: pytest.MonkeyPatch, encoding: str, written: str
) -> None:
    kept = BytesIO()
    with TextIOWrapper(kept, encoding=encoding, write_through=True) as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        accept_any_text()
        print("12.5° ± 3 µm – … ≤ \N{BLACK CHESS KING}", end="")
        assert kept.getvalue().decode(encoding) == written


def test_accept_any_text_undecodable_file_name_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = BytesIO()
    with TextIOWrapper(kept, encoding="utf-8", write_through=True) as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        accept_any_text()
        print(b"a\xff.toml".decode("utf-8", "surrogateescape"), end="", file=sys.stderr)
        assert kept.getvalue() == b"a?.toml"
