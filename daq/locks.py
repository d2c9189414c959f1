"""Advisory file locks that die with their process, so that a kill never leaves one behind."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


def try_lock(file: BinaryIO) -> bool:
    """Take the lock on an open file without waiting; False when another process holds it.

    It is released when the file is closed, or when the process dies.
    """
    if sys.platform == "win32":
        import msvcrt

        try:
            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True
    import fcntl

    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def is_locked(path: Path) -> bool:
    """Whether another process (or this one) holds the lock on a file; absent: no."""
    with unless_locked(path) as free:
        return not free


@contextmanager
def unless_locked(path: Path) -> Iterator[bool]:
    """Whether nobody holds the lock on a file; it is then held for the block. Absent: nobody."""
    if not path.exists():
        yield True
        return
    with path.open("ab", buffering=0) as file:
        yield try_lock(file)


def sync_folder(path: Path) -> None:
    """Force a folder's entries to the disk (POSIX; elsewhere the file system does it itself)."""
    if sys.platform == "win32":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
