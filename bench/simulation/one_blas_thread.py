"""One thread for linear algebra.

The matrices of swings and campaigns are small: several processes with a BLAS thread per core each take two to
five times the processor time. And a product summed by two threads is rounded otherwise than by one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import numpy.linalg  # noqa: F401 - a limit reaches libraries that are loaded
import scipy.linalg  # noqa: F401
from threadpoolctl import threadpool_limits

_VARIABLE = "OPENBLAS_NUM_THREADS"


@contextmanager
def one_blas_thread_in_children() -> Iterator[None]:
    """Give one BLAS thread to processes started in the block, and to libraries loaded in it."""
    before = os.environ.get(_VARIABLE)
    os.environ[_VARIABLE] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_VARIABLE]
        else:
            os.environ[_VARIABLE] = before


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Run the block with one thread of each BLAS: NumPy's, SciPy's, and those of libraries loaded in it."""
    with one_blas_thread_in_children(), threadpool_limits(1, "blas"):
        yield
