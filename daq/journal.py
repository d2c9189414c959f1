"""The campaign's diary: one JSON line an event, forced to the disk before the campaign goes on.

A line is ``{"seq": n, "at": "2026-…Z", "kind": "…", …}``. A torn last line (power loss) is left
out on reading and cut off before the next is written, so that a resumed campaign goes on in the
same file and the diary tells the whole story.
"""

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from daq.errors import CorruptFile, StoreError, unwritable
from daq.locks import try_lock
from daq.store import utc_now

Line = dict[str, Any]


class Journal:
    """Append-only; use as a context manager.

    Holds a lock on its file: one process at a time runs a campaign, and a campaign whose journal
    is not locked is not running, whatever its card says.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        lines, whole = _parse(path) if path.exists() else ([], 0)
        self._seq = int(lines[-1]["seq"]) + 1 if lines else 0
        try:
            self._file = path.open("ab")
            if not try_lock(self._file):
                self._file.close()
                raise StoreError(f"{path.parent.name}: another process runs this campaign")
            if self._file.tell() > whole:
                self._file.truncate(whole)
        except OSError as error:
            raise StoreError(f"{path}: cannot be opened ({error})") from error

    def write(self, kind: str, data: Mapping[str, Any]) -> None:
        """Add a line; it is on the disk when this returns. Raises `StoreError` (disk full)."""
        line = {"seq": self._seq, "at": utc_now(), "kind": kind, **data}
        try:
            self._file.write(json.dumps(line, ensure_ascii=False).encode() + b"\n")
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error
        self._seq += 1

    def close(self) -> None:
        """Harmless twice; a line that could not be written was an error when it was written."""
        with contextlib.suppress(OSError):
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_journal(path: Path) -> list[Line]:
    """Every whole line, in order; empty where there is no journal. Raises `CorruptFile`."""
    return _parse(path)[0] if path.exists() else []


def _parse(path: Path) -> tuple[list[Line], int]:
    """The whole lines, and how many bytes they take."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    lines: list[Line] = []
    for number, text in enumerate(content[:whole].splitlines(), start=1):
        try:
            line = json.loads(text)
            if not isinstance(line, dict) or line["seq"] != len(lines):
                raise ValueError(f"seq is not {len(lines)}")
        except (ValueError, KeyError) as error:
            raise CorruptFile(f"{path}: line {number} is damaged ({error})") from error
        lines.append(line)
    return lines, whole
