"""Load the package `nidaqmx`, an optional extra that also needs NI's driver."""

from __future__ import annotations

from types import ModuleType
from typing import Any

from drivers.base import DriverError


def load_nidaqmx() -> ModuleType:
    """Return the package `nidaqmx`.

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
            f"daq driver: package nidaqmx is not installed ({error}); install the extra: "
            'pip install "golfbench[daq]"'
        ) from error
    return nidaqmx  # type: ignore[no-any-return]


def error_text(error: BaseException) -> str:
    """Return the message of NI's driver in one line, with its error code."""
    text: str = " ".join(str(error).split("\n\n")[0].split())
    code: Any = getattr(error, "error_code", None)
    return text if code is None else f"{text} ({code})"
