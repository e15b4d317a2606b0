"""A root folder for a container, made in seconds of this machine's own /usr: nothing is downloaded.

/usr is seen through a bind mount; /etc and /var are new and hold only what golfbench's own installation
puts there (bench/manual/integrator/service.md), plus masks for units that are of no use in a container.
golfbench is the wheel of this source tree in /opt/golfbench, with the dependencies of the environment that
runs the tests.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import NamedTuple

PROJECT = Path(__file__).parents[2]
UNITS = PROJECT / "systemd"

_FOLDERS = (
    "usr",
    "etc/systemd/system",
    "etc/golfbench",
    "var",
    "run",
    "tmp",
    "proc",
    "sys",
    "dev",
    "root",
    "home",
)
_PYTHON = Path("/opt/python")
_DEPENDENCIES = Path("/opt/golfbench/dependencies")
_SITE = "opt/golfbench/lib/python{}.{}/site-packages".format(*sys.version_info)
_TARGET = "golfbench-test.target"
_NO_USE = (
    "dev-hugepages.mount",
    "dev-mqueue.mount",
    "kmod-static-nodes.service",
    "systemd-binfmt.service",
    "proc-sys-fs-binfmt_misc.automount",
    "sys-fs-fuse-connections.mount",
    "sys-kernel-config.mount",
    "sys-kernel-debug.mount",
    "sys-kernel-tracing.mount",
    "systemd-firstboot.service",
    "systemd-journal-flush.service",
    "systemd-random-seed.service",
    "systemd-update-utmp.service",
    "systemd-pcrphase.service",
    "systemd-pcrphase-sysinit.service",
    "systemd-journald-audit.socket",
    "systemd-repart.service",
    "systemd-modules-load.service",
    "systemd-initctl.socket",
)


class Root(NamedTuple):
    """A root folder and what of this machine is to be seen in it."""

    folder: Path
    seen: dict[Path, Path]
    """Path in the container -> folder of this machine, read-only."""


def build_root(folder: Path) -> Root:
    """Fill the new `folder` with everything a container needs to run golfbench as a service."""
    for name in _FOLDERS:
        (folder / name).mkdir(parents=True)
    for link in Path("/").iterdir():
        if link.is_symlink() and str(link.readlink()).lstrip("/").startswith("usr/"):
            (folder / link.name).symlink_to(link.readlink())
    seen = {Path("/usr"): Path("/usr"), _DEPENDENCIES: Path(sysconfig.get_path("purelib"))}
    python = Path(sys.base_prefix)
    if not python.is_relative_to("/usr"):
        seen[_PYTHON] = python
        python = _PYTHON
    _configure(folder)
    _install(folder, python)
    return Root(folder, seen)


def _configure(folder: Path) -> None:
    etc = folder / "etc"
    (etc / "hostname").write_text("bench\n")
    (etc / "machine-id").write_text("0123456789abcdef0123456789abcdef\n")
    (etc / "nsswitch.conf").write_text("passwd: files systemd\ngroup: files systemd\nhosts: files\n")
    (etc / "hosts").write_text("127.0.0.1 localhost\n")
    (etc / "ld.so.conf").write_text(f"{_PYTHON}/lib\n")
    shutil.copy("/usr/lib/os-release", etc)  # what makes it a root folder; /usr is bound over it later
    system = etc / "systemd/system"
    for unit in _NO_USE:
        (system / unit).symlink_to("/dev/null")
    (system / _TARGET).write_text("[Unit]\nRequires=basic.target\nAfter=basic.target\nAllowIsolate=yes\n")
    (system / "default.target").symlink_to(_TARGET)


def _install(folder: Path, python: Path) -> None:
    """Install golfbench and its units as the manual states, with files in place of commands."""
    home, wheels = folder / "opt/golfbench", folder / "tmp/wheel"
    for path in (home / "bin", home / "dependencies", folder / _SITE):
        path.mkdir(parents=True)
    subprocess.run(
        [
            sys.executable,
            "-m",
            "pip",
            "--disable-pip-version-check",
            "wheel",
            "--quiet",
            "--no-deps",
            "--no-build-isolation",
            "--wheel-dir",
            wheels,
            PROJECT,
        ],
        check=True,
        stdin=subprocess.DEVNULL,
    )
    [wheel] = wheels.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / _SITE)
    (folder / _SITE / "dependencies.pth").write_text(f"{_DEPENDENCIES}\n")
    interpreter = python / "bin/python{}.{}".format(*sys.version_info)
    (home / "bin/python").symlink_to(interpreter)
    (home / "pyvenv.cfg").write_text(f"home = {interpreter.parent}\ninclude-system-site-packages = false\n")
    command = home / "bin/golfbench"
    command.write_text("#!/opt/golfbench/bin/python\nfrom bench.commands.cli import main\n\nmain()\n")
    command.chmod(0o755)
    for unit in UNITS.glob("*.service"):
        shutil.copy(unit, folder / "etc/systemd/system")
    for kind in ("sysusers", "tmpfiles"):
        (folder / f"etc/{kind}.d").mkdir()
        shutil.copy(UNITS / f"golfbench.{kind}", folder / f"etc/{kind}.d/golfbench.conf")
    shutil.copy(UNITS / "bench1.toml", folder / "etc/golfbench")
    folder.chmod(0o755)
