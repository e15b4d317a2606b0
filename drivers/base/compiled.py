"""The decorators for compiled numerics, and the records that compiled functions take.

`NUMBA_DISABLE_JIT=1` runs everything as plain Python (coverage and mutation tests).
`NUMBA_CACHE_DIR` moves the cache (the service sets it).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from drivers.base.compile_report import progress

PLAIN = "NUMBA_DISABLE_JIT"
"""Variable of the environment that makes a process run plain Python."""
try:
    IS_PLAIN = bool(int(os.environ.get(PLAIN) or 0))
except ValueError:
    IS_PLAIN = False  # as numba reads it
"""Whether this process runs plain Python; `compiled` then does not import numba, which takes 70 MB."""

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile `function` at its first call, cached on disk, IEEE arithmetic, no GIL.

    No fast-math: lock-step simulation and the real-time loop must agree bit for bit, and NaN must
    stay NaN so that the envelope sees it. It counts no references to its arrays, a third of a tick's time:
    it must neither make nor return arrays, nor assign to slices. Numba does not notice a returned one.
    """
    return _compiled(function, _nrt=False)


def compiled_with_arrays(function: _Function) -> _Function:
    """Compile `function` as `compiled` does; it may make and return arrays."""
    return _compiled(function, _nrt=True)


def compiled_in_place(function: _Function) -> _Function:
    """Compile `function` as `compiled` does, into each function that calls it."""
    return _compiled(function, _nrt=False, forceinline=True)


def _compiled(function: _Function, **options: bool) -> _Function:
    if IS_PLAIN:
        return function
    import numba

    from drivers.base._whole_code import make_part
    from drivers.base.kept_code import keep_code

    if numba.config.DISABLE_JIT:
        raise RuntimeError(f"compilation is off by numba's file of settings: set {PLAIN}=1 in its place")
    progress.known += 1
    made = numba.njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **options)(function)
    make_part(made)
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
    return record.view(np.recarray) if IS_PLAIN else record


def numbers(array: np.ndarray[Any, Any]) -> memoryview[Any]:
    """Return `array` (n,) of plain numbers, also a record's field, for access to Python's numbers.

    That takes 40 ns. A scalar of numpy takes 10 us to compare with an enumeration, 1 us to subtract.
    """
    return array.data
