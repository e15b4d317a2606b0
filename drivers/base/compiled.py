"""The one decorator for compiled numerics, and the records that compiled functions take.

`NUMBA_DISABLE_JIT=1` runs everything as plain Python (coverage and mutation tests).
`NUMBA_CACHE_DIR` moves the cache (the service sets it).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from hashlib import sha256
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event, types
from numba.core.caching import IndexDataCacheFile

from drivers.base.compile_report import progress
from drivers.base.machine_code import (
    cache_folder,
    mark_in_use,
    module_digests,
    prune_versions,
    source_digest,
)

_Function = TypeVar("_Function", bound=Callable[..., Any])


@cache
def _digests() -> dict[str, str]:
    return module_digests()


@cache
def _use_cache(module: str) -> str:
    """Return the folder of the machine code of `module`, made and marked as used."""
    versions = cache_folder() / module
    # Machine code of a module outside the packages depends on the sources that the module names.
    folder = versions / _digests().get(module, source_digest())
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


if not numba.config.DISABLE_JIT:
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


def is_kept(function: Any) -> bool:
    """Return whether machine code of the `compiled` function is on disk."""
    kept = _kept_code(function)
    return kept is not None and kept.has_entries()


def compile_for(function: Any, *arguments: object) -> None:
    """Compile the `compiled` function for arguments of the types of `arguments`, without calling it."""
    function.compile(tuple(map(numba.typeof, arguments)))


def _general(kind: Any) -> Any:
    """Return the numba type that an argument of the type `kind` is passed as: an integer as int64."""
    is_integer = isinstance(kind, types.Integer | types.IntEnumMember) and kind != types.uint64
    return types.int64 if is_integer else kind


def _share_versions(made: Any) -> None:
    """Compile one version of a function for all integers: each constant argument would get a version."""
    find = made.get_call_template

    def find_general(args: Any, keywords: Any) -> Any:
        return find(tuple(map(_general, args)), {name: _general(kind) for name, kind in keywords.items()})

    made.get_call_template = find_general


def compiled(function: _Function) -> _Function:
    """Compile `function` at its first call, cached on disk, IEEE arithmetic, no GIL.

    No fast-math: lock-step simulation and the real-time loop must agree bit for bit, and NaN must
    stay NaN so that the envelope sees it.
    """
    progress.known += 1
    made = numba.njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    if not numba.config.DISABLE_JIT:
        _share_versions(made)
        keep_code(made, function.__module__)
    return cast(_Function, made)


def fields(kind: str, names: str, shape: tuple[int, ...] = ()) -> list[tuple[str, str, tuple[int, ...]]]:
    """Return fields of one kind and shape for a record's dtype; `names` are separated by blanks."""
    return [(name, kind, shape) for name in names.split()]


def copy_fields(record: np.ndarray[Any, Any], source: object, names: str) -> None:
    """Copy attributes of `source` into the fields of `record` with their `names`, separated by blanks."""
    for name in names.split():
        record[name] = getattr(source, name)


def new_record(dtype: np.dtype[Any], count: int = 1) -> np.ndarray[Any, Any]:
    """Return a zeroed array of `count` records of a structured `dtype`: one is the form functions take.

    One-element arrays cross into compiled code in 0.4 us; numpy's record scalars need 13 us. In plain
    Python the fields must be attributes as well, hence the view.
    """
    record = np.zeros(count, dtype)
    return record.view(np.recarray) if numba.config.DISABLE_JIT else record


def numbers(array: np.ndarray[Any, Any]) -> memoryview[Any]:
    """Return `array` (n,) of plain numbers, also a record's field, for access to Python's numbers.

    That takes 40 ns. A scalar of numpy takes 10 us to compare with an enumeration, 1 us to subtract.
    """
    return array.data
