"""A separate systemd as PID 1 of a container on this machine's kernel, without a booted systemd here.

Native speed, real cgroups, seccomp, watchdog and real-time scheduling; a separate network with nothing
but loopback; no CAN. Needs root.
"""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.systemd.root import Root

_HIERARCHIES = tuple(
    folder for folder in (Path("/sys/fs/cgroup/systemd"), Path("/sys/fs/cgroup/unified")) if folder.is_dir()
) or (Path("/sys/fs/cgroup"),)
"""Where this machine has control groups: versions 1 and 2 together, or 2 alone."""


def wait_until(holds: Callable[[], bool], longest: float, what: str) -> float:
    """Wait until `holds()`; return the seconds it took, AssertionError naming `what` after `longest` s."""
    start = time.monotonic()
    while not holds():
        if time.monotonic() - start > longest:
            raise AssertionError(f"not within {longest:g} s: {what}")
        time.sleep(0.05)
    return time.monotonic() - start


class Container:
    """A booted container; `run` runs a command in it."""

    def __init__(self, root: Root, console: Path) -> None:
        """Boot `root`; what systemd prints goes into the file `console`."""
        self.root = root.folder
        self._name = f"golfbench-test-{os.getpid()}"
        self._groups = [hierarchy / self._name for hierarchy in _HIERARCHIES]
        for group in self._groups:
            group.mkdir()
        nspawn = [
            "systemd-nspawn",
            "--quiet",
            "--register=no",
            "--keep-unit",
            "--private-network",
            "--boot",
            f"--directory={root.folder}",
            f"--machine={self._name}",
            "--console=pipe",
            "--link-journal=no",
            # A container's default leaves out what a service on the machine itself may be granted.
            "--capability=CAP_IPC_LOCK,CAP_SYS_RESOURCE",
            "--system-call-filter=@memlock @resources",
            *(f"--bind-ro={outside}:{inside}" for inside, outside in root.seen.items()),
        ]
        join = "".join(f"echo $$ > {shlex.quote(str(group))}/cgroup.procs; " for group in self._groups)
        self._leader = 0
        with console.open("wb") as output:
            self._nspawn = subprocess.Popen(
                ["sh", "-c", f"{join} exec {shlex.join(nspawn)}"],
                env={**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        try:
            wait_until(self._booted, 60.0, f"systemd up in the container, see {console}")
            self.run("ldconfig")
        except BaseException:
            self.stop()
            raise

    def _booted(self) -> bool:
        if self._nspawn.poll() is not None:
            raise AssertionError(f"systemd-nspawn ended with {self._nspawn.returncode}")
        children = [
            child for child in psutil.Process(self._nspawn.pid).children() if child.name() == "systemd"
        ]
        if not children:
            return False
        self._leader = children[0].pid
        return self.run("systemctl", "is-system-running", check=False) in {"running", "degraded"}

    def run(self, *command: str | Path, check: bool = True, timeout: float = 60.0) -> str:
        """Run `command` as root in the container and return its output, stripped."""
        inside = ["nsenter", "--all", f"--target={self._leader}", "timeout", "--kill-after=5", f"{timeout:g}"]
        done = subprocess.run(
            [*inside, *command],
            check=False,
            text=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        if check and done.returncode:
            raise AssertionError(f"{shlex.join(map(str, command))}: {done.returncode}\n{done.stdout}")
        return done.stdout.strip()

    def stop(self) -> None:
        """Halt the container and remove its files and control groups from this machine."""
        self._nspawn.terminate()
        try:
            self._nspawn.wait(30.0)
        except subprocess.TimeoutExpired:
            for group in self._groups:
                for processes in group.rglob("cgroup.procs"):
                    for line in processes.read_text().split():
                        os.kill(int(line), signal.SIGKILL)
            self._nspawn.wait(5.0)
        for group in self._groups:
            for folder, _, _ in os.walk(group, topdown=False):
                os.rmdir(folder)
        shutil.rmtree(f"/run/systemd/nspawn/propagate/{self._name}", ignore_errors=True)
