"""The files by which a simulated plant reports, and through which its surroundings change."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np

from drivers.base.shared_record import SharedRecord
from sim.live.exchange import PLANT_REPORT, PLANT_SURROUNDINGS, REPORT_FILE, SURROUNDINGS_FILE


class PlantFiles:
    """The two shared records; stale ones are replaced, and the files are removed at the end."""

    def __init__(self, folder: Path) -> None:
        """Create the files in `folder`; SharedMemoryError on failure."""
        self._stack = ExitStack()
        self._paths: dict[Path, int] = {}
        try:
            self.surroundings = self._make(folder / SURROUNDINGS_FILE, PLANT_SURROUNDINGS)
            self.report = self._make(folder / REPORT_FILE, PLANT_REPORT)
        except BaseException:
            self.close()
            raise

    @property
    def are_there(self) -> bool:
        """Whether the files still exist and have not been replaced."""
        return all(_number(path) == number for path, number in self._paths.items())

    def close(self) -> None:
        """Unmap and remove the files, but not those of a successor."""
        self._stack.close()

    def __enter__(self) -> PlantFiles:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _make(self, path: Path, dtype: np.dtype[Any]) -> SharedRecord:
        with suppress(OSError):  # an unwritable folder fails in the next line
            path.unlink(missing_ok=True)
        record = SharedRecord.create(path, dtype)
        self._paths[path] = _number(path)
        self._stack.callback(self._remove, path)
        self._stack.callback(record.close)
        return record

    def _remove(self, path: Path) -> None:
        if _number(path) == self._paths[path]:
            path.unlink(missing_ok=True)


def _number(path: Path) -> int:
    """Return the inode at `path`, 0 if missing."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0
