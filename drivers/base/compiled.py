"""The one decorator for compiled numerics, and where their machine code is kept.

Numba looks only at the file of the function it loads from its cache. A function whose *callee* in
another file has changed would be served stale, which is not acceptable beside a machine. The cache
folder therefore carries a digest of every compiled source file: any change compiles all of it anew.

`NUMBA_DISABLE_JIT=1` runs everything as plain Python (coverage and mutation tests).
`NUMBA_CACHE_DIR` moves the cache (the service sets it).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

_Function = TypeVar("_Function", bound=Callable[..., Any])

_COMPILED = ("sim/*.py", "drivers/base/*.py", "bench/lifecycle.py", "bench/*/*.py")
"""Source files of compiled functions and of the constants and record layouts compiled into them."""


def source_digest() -> str:
    """Return the digest of all source files that may hold compiled functions (16 hex digits)."""
    top = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256(numba.__version__.encode())
    for pattern in _COMPILED:
        for path in sorted(top.glob(pattern)):
            source = path.read_bytes()
            if b"compiled" in source:
                digest.update(path.name.encode())
                digest.update(source)
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Return the folder of this source tree's machine code (not created here)."""
    fallback = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "golfbench"
    return Path(os.environ.get("NUMBA_CACHE_DIR") or fallback) / f"compiled-{source_digest()}"


# Numba reads this setting when a function is decorated, so it must stand before the first one.
numba.config.CACHE_DIR = str(cache_folder())


def compiled(function: _Function) -> _Function:
    """Compile `function` at its first call, cached on disk, IEEE arithmetic, no GIL.

    No fast-math: lock-step simulation and the real-time loop must agree bit for bit, and NaN must
    stay NaN so that the envelope sees it.
    """
    decorate = numba.njit(cache=True, nogil=True, error_model="numpy")
    return cast(_Function, decorate(function))


def new_record(dtype: np.dtype[Any], count: int = 1) -> np.ndarray[Any, Any]:
    """Return a zeroed array of `count` records of a structured `dtype`: one is the form functions take.

    One-element arrays cross into compiled code in 0.4 us; numpy's record scalars need 13 us. In plain
    Python the fields must be attributes as well, hence the view.
    """
    record = np.zeros(count, dtype)
    return record.view(np.recarray) if numba.config.DISABLE_JIT else record
