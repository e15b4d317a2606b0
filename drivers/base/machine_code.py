"""The folder of the compiled machine code of this source tree: its name, its use and its pruning.

Numba looks only at the file of the function it loads from its cache. A function whose *callee*, or an enum
or record layout compiled into it, has changed in another file would be served stale, which is not acceptable
beside a machine. The name of the cache folder therefore carries a digest of every source file that modules
with compiled functions import, directly or through others: any change there compiles everything again.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import numba
import numpy as np

_PACKAGES = ("bench", "drivers", "sim")
_FROM_IMPORT = re.compile(r"from ((?:bench|drivers|sim)[\w.]*) import (\([^)]*\)|.*)")
_IMPORT = re.compile(r"import ((?:bench|drivers|sim)[\w.]*)")
_KEPT = 12
"""Cache folders that pruning leaves: of about 30 MB each, for branches and working copies used in turn."""


def compiled_sources(top: Path) -> dict[str, bytes]:
    """Return the sources that machine code depends on, keyed by their path relative to `top`, sorted.

    These are the modules with compiled functions and all modules they import, at module level or in
    functions. Imports are found in the text; one that stands only in a comment is followed, too.
    """
    paths, sources = _all_sources(top)
    begin = {module for module, source in sources.items() if _uses_compiled(source)}
    return {paths[module]: sources[module] for module in _reached(begin, sources)}


def imported_sources(top: Path, modules: Iterable[str]) -> dict[str, bytes]:
    """Return the sources of `modules` below `top` and of all they import, as `compiled_sources` does."""
    paths, sources = _all_sources(top)
    return {paths[module]: sources[module] for module in _reached(set(modules) & sources.keys(), sources)}


def _all_sources(top: Path) -> tuple[dict[str, str], dict[str, bytes]]:
    """Return the path relative to `top` and the source of every module."""
    paths, sources = {}, {}
    for package in _PACKAGES:
        for folder, _, names in os.walk(top / package):
            for name in names:
                if name.endswith(".py"):
                    with open(f"{folder}/{name}", "rb", buffering=0) as file:
                        source = file.read()
                    path = f"{folder}/{name}"[len(str(top)) + 1 :]
                    module = path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
                    paths[module], sources[module] = path, source
    return paths, sources


def _reached(waiting: set[str], sources: dict[str, bytes]) -> list[str]:
    """Return the modules in `waiting` and all they import, sorted."""
    reached = set[str]()
    while waiting:
        reached |= waiting
        waiting = {name for module in waiting for name in _imported_names(module, sources[module].decode())}
        waiting = (waiting & sources.keys()) - reached
    return sorted(reached)


def _uses_compiled(source: bytes) -> bool:
    return b"@compiled" in source or b"compiled(" in source


def _imported_names(module: str, source: str) -> Iterable[str]:
    """Yield what `source` may import: modules, their packages and names that may be modules."""
    bases = set(_IMPORT.findall(source))
    for base, names in _FROM_IMPORT.findall(source):
        bases.add(base)
        for name in re.findall(r"\w+", names):
            yield f"{base}.{name}"
    for base in (module, *bases):
        parts = base.split(".")
        for count in range(1, len(parts) + 1):
            yield ".".join(parts[:count])


def source_digest(top: Path | None = None) -> str:
    """Return the digest of all sources that machine code depends on (16 hex digits).

    `top` is the folder of the packages, this installation by default.
    """
    digest = sha256(f"numba {numba.__version__} numpy {np.__version__}".encode())
    for path, source in compiled_sources(top or Path(__file__).resolve().parents[2]).items():
        digest.update(f"\n{path} {len(source)}\n".encode())
        digest.update(source)
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Return the folder of this source tree's machine code (not created here)."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "golfbench"
    return Path(os.environ.get("NUMBA_CACHE_DIR") or fallback) / f"compiled-{source_digest()}"


def mark_in_use(folder: Path) -> None:
    """Create the cache `folder`, set its time of last use, and lock it until this process ends.

    Without permission nothing happens: Numba then keeps no machine code. Without POSIX it is not locked.
    """
    with suppress(OSError, ImportError):
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        import fcntl

        # Never closed: the lock ends with the process, and with every child that inherited it.
        fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_SH | fcntl.LOCK_NB)


def prune_caches(parent: Path, kept: int = _KEPT) -> None:
    """Remove all cache folders in `parent` but the `kept` last used ones and those that are in use."""
    with suppress(OSError):
        folders = [
            entry for entry in os.scandir(parent) if re.fullmatch(r"compiled-[0-9a-f]{16}", entry.name)
        ]
        last_used = {entry.path: entry.stat(follow_symlinks=False).st_mtime for entry in folders}
        for path in sorted(last_used, key=lambda path: last_used[path], reverse=True)[kept:]:
            _remove_unused(path)


def _remove_unused(path: str) -> None:
    with suppress(OSError, ImportError):  # without POSIX: its use cannot be seen
        import fcntl

        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(path, ignore_errors=True)
        finally:
            os.close(descriptor)
