"""The package `casadi`, an optional extra that only the designer needs: 270 MB."""

from __future__ import annotations

from typing import Any

from bench.errors import BenchError


def load_casadi() -> Any:
    """Return the package.

    Raises:
        BenchError: it is not installed.
    """
    try:
        import casadi
    except ImportError as error:
        raise BenchError(
            "profile design",
            f"package casadi is not installed ({error})",
            "the package casadi",
            'Run pip install "golfbench[design]".',
        ) from error
    return casadi
