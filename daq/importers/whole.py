"""An import enters the store as a whole or not at all, and no two imports of one name at once."""

import contextlib
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from daq.errors import StoreError
from daq.locks import try_lock
from daq.store import RunStore

WAIT_S = 30.0  # how long an import waits for another of the same name
_POLL_S = 0.02


@contextmanager
def alone(store: RunStore, name: str) -> Iterator[None]:
    """Let one import of `name` into a store work at a time; the next waits, at most `WAIT_S`.

    The lock dies with its process, so that a killed import blocks nobody.

    Raises
    ------
    StoreError
        Another process is still importing it.
    """
    path = store.root / f".{name}.importing"
    until = time.monotonic() + WAIT_S
    while (file := _locked(path)) is None:
        if time.monotonic() >= until:
            raise StoreError(
                f"{name} is being imported by another process; try again when it has finished"
            )
        time.sleep(_POLL_S)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows keeps a file that others have open
            path.unlink()
        file.close()


@contextmanager
def all_or_nothing(store: RunStore, campaign: str) -> Iterator[None]:
    """Mark a campaign that was just created complete after the block, or remove it."""
    try:
        yield
        store.set_status(campaign, status="complete")
    except BaseException:
        shutil.rmtree(store.campaigns_dir / campaign, ignore_errors=True)
        store.catalogue.forget(campaign)
        raise


def _locked(path: Path) -> BinaryIO | None:
    """The file, locked; None while another holds it."""
    try:
        file = path.open("ab")
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error})") from error
    # Whoever held it has removed it meanwhile: then this is the lock of a file that is gone.
    with contextlib.suppress(FileNotFoundError):
        if try_lock(file) and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return file
    file.close()
    return None
