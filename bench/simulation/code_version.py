"""The digest of the code that a sweep runs: results of other code are neither reused nor mixed."""

from __future__ import annotations

import sys
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from drivers.base.machine_code import imported_sources

_TOP = Path(__file__).resolve().parents[2]
_PACKAGES = ("numba", "numpy", "scipy")


def code_digest(*modules: str) -> str:
    """Return the digest (16 hex digits) of `modules` of this installation and all they import.

    It also covers the packages that compute: another NumPy may round otherwise.
    """
    packages = " ".join(f"{name} {version(name)}" for name in _PACKAGES)
    digest = sha256(f"python {sys.version_info[:2]} {packages}".encode())
    for path, source in imported_sources(_TOP, modules).items():
        digest.update(f"\n{path} {len(source)}\n".encode())
        digest.update(source)
    return digest.hexdigest()[:16]
