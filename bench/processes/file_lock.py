"""A lock on an open file that is released when its owner ends for any reason."""

from __future__ import annotations


def try_lock(descriptor: int) -> bool:
    """Lock the open file for this process and those that inherit it; False if locked by another."""
    import fcntl  # not everywhere: what needs no bench imports this module on any system

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
