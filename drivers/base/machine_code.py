"""Where the machine code of compiled functions is kept, and for how long.

Numba checks only the file of the function that it loads from its cache. If a *callee*, or an enum or record
layout compiled into the function, changes in another file, Numba loads outdated code, which is not acceptable
for a machine. Each module therefore has a separate cache folder, whose name carries a digest of every source
file that the module imports, directly or through others. A change recompiles only the modules that it may
affect.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np

_PACKAGES = ("bench", "drivers", "sim")
_FROM_IMPORT = re.compile(r"from ((?:bench|drivers|sim)[\w.]*) import (\([^)]*\)|.*)")
_IMPORT = re.compile(r"import ((?:bench|drivers|sim)[\w.]*)")
_TOP = Path(__file__).resolve().parents[2]
_KEPT = 12
"""Versions of a module's machine code that pruning leaves: for branches and working copies used in turn."""


def compiled_sources(top: Path) -> dict[str, bytes]:
    """Return the sources that machine code depends on, keyed by their path relative to `top`, sorted.

    These are the modules with compiled functions and all modules they import, at module level or in
    functions. Imports are found in the text; an import in a comment is also followed.
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
    return _reached_by(waiting, lambda module: _imports(module, sources))


def _reached_by(waiting: set[str], imports: Callable[[str], Iterable[str]]) -> list[str]:
    reached = set[str]()
    while waiting:
        reached |= waiting
        waiting = {name for module in waiting for name in imports(module)} - reached
    return sorted(reached)


def _imports(module: str, sources: dict[str, bytes]) -> set[str]:
    """Return the modules among `sources` that `module` imports."""
    return sources.keys() & set(_imported_names(module, sources[module].decode()))


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
    return _digest(compiled_sources(top or _TOP))


def module_digests(top: Path | None = None) -> dict[str, str]:
    """Return the digest (16 hex digits) of the sources of each module with compiled functions, by module.

    `top` is the folder of the packages, this installation by default.
    """
    paths, sources = _all_sources(top or _TOP)
    imports = cache(lambda module: _imports(module, sources))
    return {
        module: _digest({paths[name]: sources[name] for name in _reached_by({module}, imports)})
        for module, source in sources.items()
        if _uses_compiled(source)
    }


def _digest(sources: dict[str, bytes]) -> str:
    import numba  # here, as a process that runs plain Python has none

    digest = sha256(f"numba {numba.__version__} numpy {np.__version__}".encode())
    for path, source in sources.items():
        digest.update(f"\n{path} {len(source)}\n".encode())
        digest.update(source)
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Return the folder of all machine code (not created here)."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "golfbench"
    return Path(os.environ.get("NUMBA_CACHE_DIR") or fallback) / "compiled"


def mark_in_use(folder: Path) -> None:
    """Create the cache `folder` of a module's version and set its time of last use.

    Without permission nothing happens: Numba then keeps no machine code.
    """
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)


def prune_versions(module: Path, kept: int = _KEPT) -> None:
    """Remove all but the `kept` last used versions in the cache folder of a `module`.

    A process that still runs one has it in memory, and Numba makes the folder again to add to it.
    """
    with suppress(OSError):
        versions = [entry for entry in os.scandir(module) if re.fullmatch(r"[0-9a-f]{16}", entry.name)]
        last_used = {entry.path: entry.stat(follow_symlinks=False).st_mtime for entry in versions}
        for path in sorted(last_used, key=lambda path: last_used[path], reverse=True)[kept:]:
            shutil.rmtree(path, ignore_errors=True)
