"""The virtual machine: QEMU without KVM, in virtual time, with three CAN cards on one wire.

One guest nanosecond is one instruction of the guest (a computer of 1 GIPS), and idle time is skipped:
measurements in it repeat to the microsecond, under any load of this machine. Never KVM: where there is a
device of that name that cannot run a stock kernel, QEMU starts and hangs.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import IO, Any, NamedTuple

CARDS = {"card0": "0x10", "card1": "0x11", "card2": "0x12"}
"""Name -> place on the bus; the guest calls their interfaces can0, can1, can2."""
MEMORY = 2560
"""MiB: the root's image, twice while it is unpacked, and the files written over it."""

_APPEND = (
    "console=ttyS0 quiet panic=-1 systemd.show_status=no mitigations=off tsc=reliable no_timer_check "
    "nowatchdog nokaslr apparmor=0 selinux=0 audit=0 cryptomgr.notests rcupdate.rcu_expedited=1 "
    "transparent_hugepage=madvise"
)
_LOOK = 0.02
"""Period of polls for the guest's requests, s."""
_TIMEOUT = 10.0
"""s that the monitor is tried for."""
_MONITOR, _ASKED = "monitor", "asked"
"""Names of the files of QEMU's control socket and of the guest's second serial port."""


class Outcome(NamedTuple):
    """How a run ended."""

    code: int | None
    """Exit code of the command; None: the guest ended without one, or the time was over."""
    seconds: float
    processor: float
    """s of this machine's processors."""


def run_machine(kernel: Path, initramfs: Path, share: Path, timeout: float, ended: Event) -> Outcome:
    """Run `share`/command in the guest; its files in /host lie in `share`, as does its console.

    It is over after `timeout` s, and when `ended` is set.

    A line "pull card0" or "put card0" in the guest's second serial port pulls a card out and puts it back.
    """
    monitor, asked = share / _MONITOR, share / _ASKED
    begin = time.monotonic()
    machine = subprocess.Popen(_command(kernel, initramfs, share), stdin=subprocess.DEVNULL)
    try:
        with suppress(OSError):  # it ended
            _serve(machine, monitor, asked, begin + timeout, ended)
    finally:
        if _runs(machine):
            machine.terminate()
        _, _, used = os.wait4(machine.pid, 0)
        machine.returncode = 0  # it has been waited for
    told = share / "code-of-exit"
    code = int(told.read_text()) if told.exists() else None
    return Outcome(code, time.monotonic() - begin, used.ru_utime + used.ru_stime)


def _command(kernel: Path, initramfs: Path, share: Path) -> list[str | Path]:
    """Return the command line of QEMU."""
    return [
        "qemu-system-x86_64",
        "-nodefaults",
        "-no-user-config",
        "-display",
        "none",
        "-no-reboot",
        "-M",
        "pc",
        "-accel",
        "tcg",
        "-cpu",
        "Nehalem",
        "-smp",
        "1",
        "-m",
        str(MEMORY),
        "-icount",
        "shift=0,sleep=off",
        "-kernel",
        kernel,
        "-initrd",
        initramfs,
        "-append",
        _APPEND,
        "-fsdev",
        f"local,id=host,path={share},security_model=none",
        "-device",
        "virtio-9p-pci,fsdev=host,mount_tag=host",
        "-device",
        "isa-debug-exit,iobase=0x501,iosize=1",
        "-serial",
        f"file:{share / 'console'}",
        "-serial",
        f"file:{share / _ASKED}",
        "-qmp",
        f"unix:{share / _MONITOR},server=on,wait=off",
        "-object",
        "can-bus,id=wire",
        *(
            word
            for card, location in CARDS.items()
            for word in ("-device", f"kvaser_pci,canbus=wire,id={card},addr={location}")
        ),
    ]


def _runs(machine: subprocess.Popen[bytes]) -> bool:
    """Whether it has not ended; it is waited for at the end, for the time that it used."""
    return os.waitid(os.P_PID, machine.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def _serve(machine: subprocess.Popen[bytes], path: Path, asked: Path, deadline: float, ended: Event) -> None:
    """Execute the guest's requests until it ends or the time is over."""
    with socket.socket(socket.AF_UNIX) as connection:
        _connect(connection, machine, path)
        monitor = _Monitor(connection.makefile("rw"))
        done = 0
        while _runs(machine) and time.monotonic() < deadline and not ended.is_set():
            time.sleep(_LOOK)
            orders = asked.read_text().split("\n")[:-1]
            for order in orders[done:]:
                what, card = order.split()
                monitor.pull(card) if what == "pull" else monitor.put(card)
            done = len(orders)


def _connect(connection: socket.socket, machine: subprocess.Popen[bytes], path: Path) -> None:
    deadline = time.monotonic() + _TIMEOUT
    while _runs(machine):
        try:
            connection.connect(str(path))
            return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_LOOK)


class _Monitor:
    """QEMU's own side of the machine (QMP)."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        stream.readline()
        self._ask("qmp_capabilities")

    def pull(self, card: str) -> None:
        """Request the release of a card by the guest, as a hand at its lever does."""
        self._ask("device_del", id=card)

    def put(self, card: str) -> None:
        """Put it back; its place is free only after the guest has released it."""
        deadline = time.monotonic() + _TIMEOUT
        card_there = {"driver": "kvaser_pci", "canbus": "wire", "id": card, "addr": CARDS[card]}
        while "error" in self._ask("device_add", **card_there) and time.monotonic() < deadline:
            time.sleep(_LOOK)

    def _ask(self, command: str, **arguments: str) -> dict[str, Any]:
        self._stream.write(json.dumps({"execute": command, "arguments": arguments}) + "\n")
        self._stream.flush()
        while True:
            answer: dict[str, Any] = json.loads(self._stream.readline())
            if "return" in answer or "error" in answer:
                return answer
