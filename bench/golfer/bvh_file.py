"""BVH: a skeleton with rotations; gives the positions of its joints, a body without a club."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from bench.golfer.capture import Array, Capture, damaged, number


@dataclass
class _Joint:
    """A joint of the skeleton."""

    name: str
    parent: int
    offset: Array = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path, content: bytes) -> Capture:
    """Return the joint positions of a BVH file; its unit is not declared.

    Raises:
        BenchError: the skeleton or a frame is damaged; the place has the line.
    """
    lines = content.decode("utf-8", errors="replace").splitlines()
    motion = next((k for k, line in enumerate(lines) if line.strip() == "MOTION"), -1)
    if motion < 0 or not lines[0].strip().startswith("HIERARCHY") or len(lines) < motion + 4:
        raise damaged(path, "no HIERARCHY with MOTION")
    joints = _skeleton(path, lines[1:motion])
    period = number(path, lines[motion + 2].partition(":")[2], f"line {motion + 3}")
    frames = number(path, lines[motion + 1].partition(":")[2], f"line {motion + 2}")
    rows = [(k, line.split()) for k, line in enumerate(lines[motion + 3 :], motion + 4) if line.strip()]
    width = sum(len(joint.channels) for joint in joints)
    for line, cells in rows:
        if len(cells) != width:
            raise damaged(path, f"{len(cells)} values", f"line {line}", f"{width} values")
    if len(rows) != frames or not period > 0.0:
        raise damaged(path, f"{len(rows)} frames", f"line {motion + 2}", f"{frames:g} frames")
    table = np.array([[number(path, cell, f"line {line}") for cell in cells] for line, cells in rows])
    rate = round(1.0 / period, 1)
    names = tuple(joint.name for joint in joints if joint.name)
    return Capture(names, _positions(joints, table), rate)


def _skeleton(path: Path, lines: list[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    open_: list[int] = []
    for k, line in enumerate(lines, 2):
        words = line.split()
        if words[:1] in (["ROOT"], ["JOINT"]) and len(words) > 1:
            joints.append(_Joint(words[1], open_[-1] if open_ else -1))
        elif words[:1] == ["{"]:
            open_.append(len(joints) - 1)
        elif words[:1] == ["}"] and open_:
            open_.pop()
        elif words[:1] == ["End"]:
            joints.append(_Joint("", open_[-1] if open_ else -1))
        elif words[:1] == ["OFFSET"] and joints and len(words) == 4:
            joints[-1].offset = np.array([number(path, word, f"line {k}") for word in words[1:]])
        elif words[:1] == ["CHANNELS"] and joints:
            joints[-1].channels = words[2:]
        elif words:
            raise damaged(path, line.strip()[:40], f"line {k}", "a joint of a skeleton")
    return joints


def _positions(joints: list[_Joint], table: Array) -> Array:
    """Return the positions (frames, named joints, 3) by the angles (deg) and offsets in `table`."""
    count, column = len(table), 0
    turns: list[Array] = []
    places: list[Array] = []
    for joint in joints:
        move, turn = np.tile(joint.offset, (count, 1)), np.tile(np.eye(3), (count, 1, 1))
        for channel in joint.channels:
            values, axis = table[:, column], "XYZ".index(channel[0].upper())
            column += 1
            if channel.lower().endswith("position"):
                move[:, axis] = values + (0.0 if joint.parent < 0 else joint.offset[axis])
            else:
                turn = turn @ _turn(axis, np.radians(values))
        if joint.parent >= 0:
            above = turns[joint.parent]
            move = places[joint.parent] + np.einsum("nij,nj->ni", above, move)
            turn = above @ turn
        turns.append(turn)
        places.append(move)
    return np.stack([place for joint, place in zip(joints, places, strict=True) if joint.name], axis=1)


def _turn(axis: int, angle: Array) -> Array:
    """Return the rotations (n, 3, 3) about one of the axes by `angle` (rad)."""
    found = np.tile(np.eye(3), (len(angle), 1, 1))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    found[:, i, i] = found[:, j, j] = np.cos(angle)
    found[:, i, j], found[:, j, i] = -np.sin(angle), np.sin(angle)
    return found
