"""Machine code on disk: saved as functions are compiled, loaded at their first call, by version of module."""

from __future__ import annotations

from functools import cache
from hashlib import sha256
from typing import Any

import numba
from numba.core import event
from numba.core.caching import IndexDataCacheFile

from drivers.base.compile_report import progress
from drivers.base.machine_code import cache_folder, mark_in_use, module_digests, prune_versions, source_digest


@cache
def _digests() -> dict[str, str]:
    return module_digests()


@cache
def _use_cache(module: str) -> str:
    """Return the folder of the machine code of `module`, made and marked as used."""
    versions = cache_folder() / module
    # Machine code of a module outside the packages depends on the sources that the module names.
    folder = versions / (_digests().get(module) or source_digest())
    mark_in_use(folder)
    prune_versions(versions)
    return str(folder)


class _Watch(event.Listener):  # type: ignore[misc]  # numba has no types
    """Passes numba's compilations on; a function from the cache is not compiled."""

    def on_start(self, event: event.Event) -> None:
        """Record the start of a compilation."""
        progress.note()

    def on_end(self, event: event.Event) -> None:
        """Record the end of a compilation."""
        progress.note(event.data["dispatcher"])


event.register("numba:compile", _Watch())


class _KeptCode(IndexDataCacheFile):  # type: ignore[misc]  # numba has no types
    """Machine code on disk; what cannot be read is compiled again.

    An index names the types of arguments: those of a module that has moved since are not there any more. A
    loss of power may leave a file cut short. Processes that compile a function for two signatures at one time
    would number their files alike, and the code of one would be found under the other.
    """

    def save(self, key: Any, data: Any) -> None:
        """Save machine code under a name of its signature; an overwritten entry is compiled again."""
        name = f"{self._index_name}.{sha256(repr(key).encode()).hexdigest()[:16]}.nbc"
        self._save_data(name, data)
        self._save_index(self._load_index() | {key: name})

    def has_entries(self) -> bool:
        """Return whether there is machine code for any signature."""
        return bool(self._load_index())

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except Exception:
            return {}

    def _load_data(self, name: str) -> Any:
        try:
            return super()._load_data(name)
        except Exception as error:
            raise OSError(f"{name}: {error}") from error  # which numba takes for a missing one


def keep_code(made: Any, module: str) -> None:
    """Keep the machine code of a function of `module` that numba has `made`, in the folder of its version."""
    numba.config.CACHE_DIR = _use_cache(module)  # read when caching is enabled
    made.enable_caching()
    kept = _kept_code(made)
    if kept is not None:
        kept.__class__ = _KeptCode


def _kept_code(made: Any) -> Any:
    return getattr(getattr(made, "_cache", None), "_cache_file", None)


def keeps(made: Any, arguments: tuple[Any, ...]) -> bool:
    """Return whether machine code of the function that numba has `made` is on disk for these types."""
    kept = _kept_code(made)
    if kept is None:
        return False
    codegen = made.targetctx.codegen()
    key = made._cache._index_key(arguments, codegen)  # noqa: SLF001 - numba has no door to it
    return bool(key in kept._load_index())  # noqa: SLF001


def is_kept(function: Any) -> bool:
    """Return whether machine code of the `compiled` function is on disk."""
    kept = _kept_code(function)
    return kept is not None and kept.has_entries()


def compile_for(function: Any, *arguments: object) -> None:
    """Compile the `compiled` function for arguments of the types of `arguments`, without calling it."""
    function.compile(tuple(map(numba.typeof, arguments)))
