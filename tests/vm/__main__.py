"""The CANopen driver on a real CAN stack, in a virtual machine: `python -m tests.vm`, or `make test-vm`.

A stock Debian kernel with systemd, driver and simulated nodes on emulated cards with their kernel driver, or
on vcan. The part "driver": frames and times of a minute at the highest rate that the guest can carry, then
faults of link, card, queue and bus, each with the time to the reaction at the valve node. The part "bench":
the whole bench as systemd's service, ten shots, faults in mid-swing, a killed loop, a frozen supervisor.

Exit code 1 when a promised figure is missed or a guest did not come to its end, 2 when something it needs is
absent or the image cannot be made.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

from rich.console import Console

from tests.benchmarks.__main__ import show, verdict
from tests.benchmarks.row import Row
from tests.vm.code import add_code
from tests.vm.guest_faults import FAULTS as SWING_FAULTS
from tests.vm.guest_faults import USUAL
from tests.vm.image import HOME, MACHINE_CODE, PACKAGES, build_image
from tests.vm.inside_frames import FAULTS
from tests.vm.machine import Outcome, run_machine

RATE = 500.0
"""Hz."""


PARTS = ("driver", "bench")


def main() -> int:
    """Make the image if there is none, run a guest for each part, show what they found."""
    options = _options()
    if lacking := _lacking():
        print(f"test-vm: {lacking}", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # QEMU ends, too
    console, begin = Console(), time.monotonic()

    def say(text: str) -> None:
        console.print(f"[dim]{time.monotonic() - begin:4.0f} s[/] {text}", highlight=False)

    try:
        image = build_image(say)
    except (subprocess.CalledProcessError, OSError) as error:
        print(f"test-vm: the image cannot be made here: {error}", file=sys.stderr)
        return 2
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="golfbench-vm-") as name:
        top, ended = Path(name), Event()
        add_code(image, top / "initramfs", say)

        def run_part(part: str) -> Outcome:
            return run_machine(image.kernel, top / "initramfs", top / part, options.timeout, ended)

        for part in options.parts:
            (top / part).mkdir()
            (top / part / "command").write_text(_command(part, options))
        say(f"running the guests: {', '.join(options.parts)}")
        with ThreadPoolExecutor() as pool:
            try:
                outcomes = list(pool.map(run_part, options.parts))
            finally:
                ended.set()
        for part, outcome in zip(options.parts, outcomes, strict=True):
            took = f"{outcome.seconds:.0f} s, {outcome.processor:.0f} s of processor"
            say(f"{part}: the guest ended after {took}, with {outcome.code}")
            if options.keep is not None:
                _keep(top / part, options.keep / part)
            found = _rows(top / part / "rows")
            show(found, console)
            rows += found
            if outcome.code != 0:
                _explain(top / part, console)
    return verdict(rows, console) or int(any(outcome.code != 0 for outcome in outcomes))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.vm", description=__doc__)
    parser.add_argument(
        "--parts", nargs="*", choices=PARTS, default=PARTS[:1], help="default: driver; both: at once"
    )
    parser.add_argument("--interface", choices=("can", "vcan"), default="can", help="vcan: without faults")
    parser.add_argument("--seconds", type=float, default=60.0, help="driver's load time (%(default)g)")
    parser.add_argument("--rate", type=float, default=RATE, metavar="HZ", help="driver's rate (%(default)g)")
    parser.add_argument("--shots", type=int, default=10, help="shots of the bench (%(default)d)")
    parser.add_argument(
        "--faults",
        nargs="*",
        choices=list(FAULTS),
        default=list(FAULTS),
        metavar="NAME",
        help="faults of the driver's part, default: all",
    )
    parser.add_argument(
        "--swing-faults",
        nargs="*",
        choices=[*SWING_FAULTS, "all"],
        default=list(USUAL),
        metavar="NAME",
        help="faults of the bench's part, in mid-swing",
    )
    parser.add_argument("--timeout", type=float, default=3600.0, metavar="S", help="time limit of each guest")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave console, output and journal there")
    return parser.parse_args()


def _lacking() -> str:
    """Return the missing requirements, and how to meet them; empty: none."""
    if os.geteuid() != 0:
        return "it needs root, to lay out a root file system"
    missing = sorted(package for program, package in PACKAGES.items() if shutil.which(program) is None)
    return f"apt-get install {' '.join(missing)}" if missing else ""


def _command(part: str, options: argparse.Namespace) -> str:
    """Return the script that the guest runs."""
    arguments = [f"--interface={options.interface}"]
    if part == "driver":
        module = "tests.vm.inside_frames"
        arguments += [
            f"--rate={options.rate:g}",
            f"--seconds={options.seconds:g}",
            "--faults",
            *options.faults,
        ]
    else:
        module = "tests.vm.inside_bench"
        faults = SWING_FAULTS if "all" in options.swing_faults else options.swing_faults
        arguments += [f"--shots={options.shots}", "--faults", *faults]
    return (
        f"export NUMBA_CACHE_DIR=/{MACHINE_CODE}; cd /root\n"
        f"exec /{HOME}/bin/python -m {module} {shlex.join(arguments)}\n"
    )


def _rows(file: Path) -> list[Row]:
    """Return the figures that the guest found."""
    if not file.exists():
        return []
    return [Row(**json.loads(line)) for line in file.read_text().splitlines()]


def _keep(share: Path, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("console", "output", "journal", "rows"):
        if (share / name).exists():
            shutil.copy(share / name, folder)


def _explain(share: Path, console: Console) -> None:
    """Print the guest's last output."""
    for name in ("output", "journal", "console"):
        if (share / name).exists():
            lines = (share / name).read_text(errors="replace").splitlines()[-40:]
            console.print(f"-- {name}", *lines, sep="\n", markup=False, highlight=False)


if __name__ == "__main__":
    sys.exit(main())
