"""Files that exist whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from bench.base.errors import BenchError, ExitCode


class NotStored(BenchError):
    """A file could not be written; what stood there before is untouched."""

    exit_code = ExitCode.FILE


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield the path of a file to write, which takes the place of `path` only when the block has ended well.

    The file is written aside in the same folder (`.NAME.….partial`), synced to the disk, renamed, and
    the folder is synced: after a power cut `path` holds the old content or the new, never a part.
    A link is followed. Raises NotStored when the disk is full, the folder missing or read-only, or `path` a
    folder, device or pipe; whatever the exception, the partial file is removed.
    """
    target = Path(os.path.realpath(path))
    partial = target.parent / f".{target.name}.{secrets.token_hex(4)}.partial"
    try:
        if target.exists() and not target.is_file():
            action = "Name another file; nothing was stored."
            raise NotStored(str(path), "a folder, device or pipe", "a file or a free name", action)
        try:
            with partial.open("xb") as stream:  # the folder is writable, and the file ours
                yield partial
                os.fsync(stream.fileno())
            partial.replace(target)
            _sync_folder(target.parent)
        finally:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
    except OSError as error:
        raise NotStored(
            str(path),
            error.strerror or str(error),
            "a folder that can be written, with space left on its disk",
            "make the folder, free some space or name another folder; nothing was stored",
        ) from error


@contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a stream to write, whose bytes appear at `path` all at once or never; see `atomic_path`."""
    with atomic_path(path) as partial, partial.open("r+b") as stream:
        yield stream


def write_whole(path: Path, content: str | bytes) -> None:
    """Write `content`, a text in UTF-8, to `path` all at once or never; raises as `atomic_path`."""
    with atomic_file(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)


def nearest_entry(path: Path) -> Path:
    """Return `path` or the nearest entry above it, also a link that leads nowhere."""
    return next(above for above in (path.absolute(), *path.absolute().parents) if os.path.lexists(above))


def _sync_folder(folder: Path) -> None:
    """Make the rename itself durable; Windows opens no folder."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
