"""Modules that need no bench can be imported without POSIX: records, exports, reports, client, simulation.

Nothing here runs on Windows or macOS. A process imports the rooms without modules that those systems lack,
as far as our own code asks for them; and no line that runs at import names a function that they lack.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

TOP = Path(__file__).resolve().parent.parent
ROOMS = (
    "bench.records.telemetry.record_file",
    "bench.records.telemetry.batches",
    "bench.records.telemetry.swing_metadata",
    "bench.viewer.export_files",
    "bench.campaign.statistics.analysis",
    "bench.campaign.report.campaign_report",
    "bench.campaign.run.runner_control",
    "bench.campaign.run._simulated_shots",
    "bench.commands.swing.records",
    "bench.network.client",
    "bench.network.messages",
    "bench.records.shot",
    "bench.simulation.replay",
    "bench.simulation.simulated_bench",
    "bench.store",
    "bench.swing",
    "bench.viewer.rerun_recording",
    "sim.plant",
    "sim.driver",
    "sim.flight",
)
"""Modules, and packages with all their modules."""
ABSENT = (
    "fcntl",
    "grp",
    "nis",
    "ossaudiodev",
    "posix",
    "pty",
    "pwd",
    "readline",
    "resource",
    "spwd",
    "syslog",
    "termios",
    "tty",
)
"""Modules that Windows does not have; macOS has most of them."""
MEMBERS = {
    "os": (
        "sched_",
        "SCHED_",
        "posix_",
        "getuid",
        "geteuid",
        "getgid",
        "fork",
        "memfd_create",
        "O_NOFOLLOW",
        "O_DIRECTORY",
        "O_CLOEXEC",
        "O_NONBLOCK",
        "setsid",
        "killpg",
        "register_at_fork",
    ),
    "signal": (
        "SIGKILL",
        "SIGHUP",
        "SIGALRM",
        "SIGUSR",
        "SIGCHLD",
        "SIGSTOP",
        "SIGCONT",
        "setitimer",
        "pthread_",
    ),
    "socket": ("AF_UNIX", "AF_CAN", "SOCK_SEQPACKET", "SOCK_NONBLOCK"),
    "select": ("poll", "epoll", "EPOLL", "POLL"),
    "mmap": ("PROT_", "MAP_"),
    "ctypes": ("CDLL",),
}
"""Beginnings of names that Windows or macOS does not have; of `ctypes`, the whole process as a library."""

IMPORTER = """
import builtins, importlib, json, pkgutil, sys
absent, rooms = json.loads(sys.argv[1]), json.loads(sys.argv[2])
plain = builtins.__import__

def without(name, globals=None, locals=None, fromlist=(), level=0):
    asks = (globals or {}).get("__name__", "").partition(".")[0]
    if not level and name.partition(".")[0] in absent and asks in ("bench", "sim", "drivers"):
        raise ModuleNotFoundError(f"{globals['__name__']} imports {name}")
    return plain(name, globals, locals, fromlist, level)

builtins.__import__ = without
problems = []
for room in rooms:
    try:
        module = importlib.import_module(room)
        for found in pkgutil.iter_modules(getattr(module, "__path__", ()), f"{room}."):
            importlib.import_module(found.name)
    except ImportError as error:
        problems.append(str(error))
files = [m.__file__ for n, m in sys.modules.items() if n.partition(".")[0] in ("bench", "sim", "drivers")]
print(json.dumps([problems, [file for file in files if file]]))
"""


def _at_import(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """Yield what runs when a module is imported: not the bodies of functions, nor `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = list(body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            arguments = node.args
            waiting += [*arguments.defaults, *(d for d in arguments.kw_defaults if d is not None)]
            waiting += getattr(node, "decorator_list", [])
            continue
        yield node
        waiting += ast.iter_child_nodes(node)


def _posix_only(path: Path) -> list[str]:
    return [
        f"{path.relative_to(TOP)}:{node.lineno}: {node.value.id}.{node.attr}"
        for node in _at_import(ast.parse(path.read_text()).body)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.attr.startswith(MEMBERS.get(node.value.id, ("\0",)))
    ]


@pytest.mark.slow
def test_portable_modules_import_without_posix() -> None:
    arguments = [json.dumps(ABSENT), json.dumps(ROOMS)]
    done = subprocess.run(
        [sys.executable, "-c", IMPORTER, *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=110,
        cwd=TOP,
    )
    problems, files = json.loads(done.stdout)
    assert problems == []
    assert len(files) > 150
    assert [found for file in sorted(files) for found in _posix_only(Path(file))] == []


def test_posix_only_reports_line_using_posix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "module.py"
    path.write_text("import os\nFLAGS = os.O_CLOEXEC\ndef later(): return os.getuid()\n")
    monkeypatch.setitem(globals(), "TOP", tmp_path)
    assert _posix_only(path) == ["module.py:2: os.O_CLOEXEC"]
