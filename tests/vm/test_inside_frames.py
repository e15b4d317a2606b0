"""How the guest's frames are read: answers, and the first sign of closed valves."""

from __future__ import annotations

import pytest

from tests.vm.guest import COMMAND, EMERGENCY, SYNC
from tests.vm.guest_bus import Frame
from tests.vm.inside_frames import _reaction, _thirds

OPEN, PASSIVE = bytes([0, 0, 0, 0, 0, 0, 1]), bytes(7)


def test_thirds_answer_ends_with_third_position() -> None:
    frames = [
        Frame(t, i, b"")
        for t, i in [
            (0.0, 0x281),
            (1.0, SYNC),
            (1.2, 0x282),
            (1.3, 0x281),
            (1.4, COMMAND),
            (1.5, 0x283),
            (2.0, SYNC),
            (2.1, 0x281),
            (3.0, SYNC),
        ]
    ]
    assert _thirds(frames) == pytest.approx([0.5])


def test_reaction_is_passive_command_or_node_emergency() -> None:
    passive, own = Frame(2.0, COMMAND, PASSIVE), Frame(3.0, EMERGENCY, bytes([0x50, 0x82, 0x11]))
    earlier, over = Frame(0.5, COMMAND, PASSIVE), Frame(1.5, EMERGENCY, bytes(8))
    assert _reaction([earlier, Frame(1.2, COMMAND, OPEN), over, passive, own], 1.0) == passive
    assert _reaction([earlier, over, own], 1.0) == own
    assert _reaction([earlier, over], 1.0) is None
