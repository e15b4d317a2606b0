"""The one decorator for compiled numerics, and the records that compiled functions take.

`NUMBA_DISABLE_JIT=1` runs everything as plain Python (coverage and mutation tests).
`NUMBA_CACHE_DIR` moves the cache (the service sets it).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event

from drivers.base.compile_report import progress
from drivers.base.machine_code import cache_folder, mark_in_use, prune_caches

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _use_cache() -> None:
    """Let Numba keep machine code in this source tree's cache folder."""
    folder = cache_folder()
    numba.config.CACHE_DIR = str(folder)
    mark_in_use(folder)
    prune_caches(folder.parent)


class _Watch(event.Listener):  # type: ignore[misc]  # numba has no types
    """Passes numba's compilations on; a function from the cache is not compiled."""

    def on_start(self, event: event.Event) -> None:
        """Note the begin of a compilation."""
        progress.note()

    def on_end(self, event: event.Event) -> None:
        """Note the end of a compilation."""
        progress.note(event.data["dispatcher"])


# Numba reads the folder when a function is decorated, so it must be set before the first one.
if not numba.config.DISABLE_JIT:
    _use_cache()
    event.register("numba:compile", _Watch())


def compiled(function: _Function) -> _Function:
    """Compile `function` at its first call, cached on disk, IEEE arithmetic, no GIL.

    No fast-math: lock-step simulation and the real-time loop must agree bit for bit, and NaN must
    stay NaN so that the envelope sees it.
    """
    progress.known += 1
    decorate = numba.njit(cache=True, nogil=True, error_model="numpy")
    return cast(_Function, decorate(function))


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
