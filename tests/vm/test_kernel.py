"""Which modules of the guest's kernel are kept and loaded, and the kernel inside of its file."""

from __future__ import annotations

import lzma
from pathlib import Path

import pytest

from tests.vm.kernel import keep_modules, load_order, unpack_kernel

MODULES = {
    "kernel/lib/base.ko": "",
    "kernel/fs/overlay.ko": "kernel/lib/base.ko",
    "kernel/net/can/can.ko": "",
    "kernel/drivers/net/can/sja1000/sja1000.ko": "kernel/drivers/net/can/can-dev.ko",
    "kernel/drivers/net/can/can-dev.ko": "kernel/net/can/can.ko",
    "kernel/drivers/gpu/gpu.ko": "",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for path in MODULES:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text("")
    lines = (f"{path}: {needs}\n" for path, needs in MODULES.items())
    (tmp_path / "modules.dep").write_text("".join(lines))
    return tmp_path


def test_load_order_puts_dependencies_first(folder: Path) -> None:
    order = [path.stem for path in load_order(folder, ["sja1000", "overlay", "can_dev"])]
    assert order == ["can", "can-dev", "sja1000", "base", "overlay"]


def test_keep_modules_keeps_can_and_wanted(folder: Path) -> None:
    keep_modules(folder, ["overlay", "not_there"])
    assert sorted(path.stem for path in folder.rglob("*.ko")) == [
        "base",
        "can",
        "can-dev",
        "overlay",
        "sja1000",
    ]


def test_unpack_kernel_skips_other_compressed_data(tmp_path: Path) -> None:
    kernel = b"\x7fELF and more"
    (tmp_path / "vmlinuz").write_bytes(
        b"setup" + lzma.compress(b"firmware") + lzma.compress(kernel) + b"tail"
    )
    unpack_kernel(tmp_path / "vmlinuz", tmp_path / "vmlinux")
    assert (tmp_path / "vmlinux").read_bytes() == kernel


def test_unpack_kernel_without_kernel_raises(tmp_path: Path) -> None:
    (tmp_path / "vmlinuz").write_bytes(b"no kernel")
    with pytest.raises(ValueError, match="no kernel packed with xz"):
        unpack_kernel(tmp_path / "vmlinuz", tmp_path / "vmlinux")
