"""golfbench as it goes over the guest's root: the wheel of this source tree, tests and machine code."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from drivers.base.machine_code import source_digest
from tests.vm.image import (
    HOME,
    MACHINE_CODE,
    PROCESSOR,
    PROJECT,
    SITE,
    Image,
    Say,
    archive,
    digest_of,
    run_pip,
)

WHAT_IS_COMPILED = Path(__file__).with_name("compile_all.py")


def add_code(image: Image, initramfs: Path, say: Say) -> None:
    """Write the initramfs of `image` with golfbench, its tests and their machine code in it.

    Times of files are made equal everywhere: machine code is only taken for the source that it was made of.
    """
    with tempfile.TemporaryDirectory(prefix="golfbench-vm-") as name:
        _stage(image, Path(name) / "code", say)
        archive(Path(name), initramfs)
    with initramfs.open("r+b") as joined, image.initramfs.open("rb") as root:
        code = joined.read()
        joined.seek(0)
        shutil.copyfileobj(root, joined, 2**20)
        joined.write(code)


def _stage(image: Image, folder: Path, say: Say) -> None:
    site, wheels = folder / SITE, folder / "wheels"
    site.mkdir(parents=True)
    run_pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", wheels, PROJECT)
    for wheel in wheels.glob("*.whl"):
        shutil.unpack_archive(wheel, site, "zip")
    shutil.rmtree(wheels)
    for part in ("vm", "benchmarks"):
        shutil.copytree(
            PROJECT / "tests" / part, site / "tests" / part, ignore=shutil.ignore_patterns("__pycache__")
        )
    if sys.version_info[:2] == (3, 11):  # the guest's Python; its services may not keep what they compiled
        kept = ["-f", "-q", "--invalidation-mode=unchecked-hash", "-s", str(site), "-p", f"/{SITE}"]
        subprocess.run([sys.executable, "-m", "compileall", *kept, site], check=True)
    shutil.copytree(PROJECT / "systemd", folder / HOME / "systemd")
    subprocess.run(["find", folder, "-exec", "touch", "-d", "@1600000000", "{}", "+"], check=True)
    shutil.copytree(_machine_code(image, site, say), folder / MACHINE_CODE)


def _machine_code(image: Image, site: Path, say: Say) -> Path:
    """Return the folder of the machine code of the sources in `site`, compiled now if it is not there."""
    kept = image.root.parent / f"machine-code-{source_digest()}-{digest_of([WHAT_IS_COMPILED])}"
    if not kept.exists():
        say("compiling for the guest's processor")
        inside, made = image.root / SITE, image.root / MACHINE_CODE
        for part in site.iterdir():
            shutil.rmtree(inside / part.name, ignore_errors=True)
            shutil.copytree(part, inside / part.name)
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir(parents=True)
        environment = {
            **PROCESSOR,
            "NUMBA_CACHE_DIR": f"/{MACHINE_CODE}",
            "PATH": "/usr/sbin:/usr/bin",
            "HOME": "/root",
        }
        python = [f"/{HOME}/bin/python", "-m", "tests.vm.compile_all"]
        subprocess.run(["chroot", image.root, *python], check=True, env=environment)
        shutil.copytree(made, kept)
    return kept
