"""Parts that all commands share."""

from __future__ import annotations

import os
import pty
import select
import sys

import pytest

from bench.commands.common import discard_typed


def test_discard_typed_drops_earlier_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    typist, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin, os.fdopen(typist, "wb", buffering=0) as keys:
        monkeypatch.setattr(sys, "stdin", stdin)
        keys.write(b"\n\n")
        assert select.select([stdin], [], [], 5.0)[0]
        discard_typed()
        assert not select.select([stdin], [], [], 0.0)[0]
        keys.write(b"3.0\n")
        assert stdin.readline() == "3.0\n"
