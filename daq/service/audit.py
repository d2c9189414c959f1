"""The audit trail: who moved the speaker, or changed anything, and when.

One JSON line an action, appended and flushed to the disk before the action's answer leaves.
"""

import json
import os
import threading
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any


def utc_text() -> str:
    """Now, as RFC 3339 in UTC with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class AuditTrail:
    """Appends to `path`; reads back its end."""

    def __init__(self, path: Path, now: Callable[[], str] = utc_text) -> None:
        self._path = path
        self._now = now
        self._lock = threading.Lock()

    def record(self, who: str, action: str, target: str, **detail: Any) -> None:
        """Write one line; an action that cannot be recorded must not happen, so errors rise."""
        line = {"time": self._now(), "who": who, "action": action, "target": target, **detail}
        with self._lock:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(self._path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
            with os.fdopen(handle, "a", encoding="utf-8") as file:
                file.write(json.dumps(line, default=str) + "\n")
                file.flush()

    def tail(self, count: int) -> list[dict[str, Any]]:
        """The last `count` lines, newest first."""
        if not self._path.exists():
            return []
        with self._path.open(encoding="utf-8") as file:
            lines = deque(file, maxlen=count)
        return [json.loads(line) for line in islice(reversed(lines), count)]
