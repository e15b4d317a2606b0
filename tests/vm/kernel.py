"""Debian's kernel for the virtual machine: unpacked, with those of its modules that are wanted."""

from __future__ import annotations

import lzma
from collections.abc import Iterable
from pathlib import Path

_XZ = b"\xfd7zXZ\0"
_ELF = b"\x7fELF"


def unpack_kernel(vmlinuz: Path, vmlinux: Path) -> None:
    """Write the kernel inside of `vmlinuz`: started as it is, it need not unpack itself, emulated.

    Raises:
        ValueError: there is none that xz has packed.
    """
    packed = vmlinuz.read_bytes()
    location = packed.find(_XZ)
    while location >= 0:
        kernel = lzma.LZMADecompressor().decompress(packed[location:])
        if kernel.startswith(_ELF):
            vmlinux.write_bytes(kernel)
            return
        location = packed.find(_XZ, location + 1)
    raise ValueError(f"{vmlinuz}: no kernel packed with xz in it")


def keep_modules(folder: Path, names: Iterable[str]) -> None:
    """Remove all modules but those of CAN, those of `names`, and what these need."""
    paths, _ = _modules(folder)
    can = [name for name, path in paths.items() if "/net/can/" in path]
    kept = set(load_order(folder, [*can, *(name for name in names if name in paths)]))
    for module in folder.rglob("*.ko"):
        if module not in kept:
            module.unlink()


def load_order(folder: Path, names: Iterable[str]) -> list[Path]:
    """Return the modules `names` and their dependencies, each after its own."""
    paths, needs = _modules(folder)
    order: dict[str, Path] = {}

    def add(name: str) -> None:
        if name not in order:
            for needed in needs[name]:
                add(needed)
            order[name] = folder / paths[name]

    for name in names:
        add(name)
    return list(order.values())


def _modules(folder: Path) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Return path and needs of each module, from depmod's list."""
    paths, needs = {}, {}
    for line in (folder / "modules.dep").read_text().splitlines():
        path, _, others = line.partition(":")
        paths[_name(path)] = path
        needs[_name(path)] = [_name(other) for other in others.split()]
    return paths, needs


def _name(path: str) -> str:
    return Path(path).stem.replace("-", "_")
