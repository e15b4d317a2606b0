"""The package `nidaqmx`, which is an optional extra and needs NI's own driver beside it."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from drivers.base import DriverError


def load_nidaqmx() -> ModuleType:
    """Return the package.

    Raises:
        DriverError: it is not installed.
    """
    try:
        import nidaqmx
        import nidaqmx.constants
        import nidaqmx.stream_readers
        import nidaqmx.stream_writers
        import nidaqmx.system
        import nidaqmx.system.watchdog
        import nidaqmx.types
    except ImportError as error:
        raise DriverError(
            f"daq driver: found no package nidaqmx ({error}), expected it; install the extra: "
            'pip install "golfbench[daq]"'
        ) from error
    return nidaqmx  # type: ignore[no-any-return]


def told(error: BaseException) -> str:
    """Return what NI's driver says in one line, with its number."""
    text: str = " ".join(str(error).split("\n\n")[0].split())
    code: Any = getattr(error, "error_code", None)
    return text if code is None else f"{text} ({code})"
