"""The catalogue: an SQLite index over the run files, which can be rebuilt from them at any time.

The files are the truth; the catalogue only makes them quick to find. It runs in WAL mode, so that
readers never wait for the writer, with a connection for each thread at work. A page of runs is
found by key (`after` is the last id of the page before), never by offset, so a page costs the same
at run 10 and at run 100 000.
"""

import shutil
import sqlite3
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, fields
from operator import attrgetter
from pathlib import Path
from typing import Any

from daq.errors import StoreError
from daq.records import RunSummary

SCHEMA_VERSION = 1
NEEDED_BYTES = 2**17  # for SQLite's log and its shared memory
_COLUMNS = tuple(field.name for field in fields(RunSummary))
_values = attrgetter(*_COLUMNS)  # astuple copies deeply, ten times slower
_SCHEMA = f"""
CREATE TABLE IF NOT EXISTS campaigns (
    id TEXT PRIMARY KEY, title TEXT NOT NULL, rig TEXT NOT NULL, created_at TEXT NOT NULL,
    status TEXT NOT NULL, verdict TEXT
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS runs (
    campaign TEXT NOT NULL, name TEXT NOT NULL, kind TEXT NOT NULL, role TEXT NOT NULL,
    frequency_hz REAL, amplitude_v REAL, started_s REAL NOT NULL, started_at TEXT NOT NULL,
    rig TEXT NOT NULL, sample_rate_hz REAL NOT NULL, samples INTEGER NOT NULL,
    exit_status TEXT NOT NULL, exit_reason TEXT NOT NULL, sha256 TEXT NOT NULL,
    bytes INTEGER NOT NULL,
    PRIMARY KEY (campaign, name)
) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS runs_by_rig ON runs (rig, campaign, name);
CREATE INDEX IF NOT EXISTS runs_by_frequency ON runs (frequency_hz, campaign, name);
CREATE INDEX IF NOT EXISTS runs_by_date ON runs (started_at, campaign, name);
CREATE INDEX IF NOT EXISTS campaigns_by_verdict ON campaigns (verdict, id);
PRAGMA user_version = {SCHEMA_VERSION};
"""


@dataclass(frozen=True)
class CampaignRow:
    """One line of the list of campaigns."""

    id: str
    title: str
    rig: str
    created_at: str
    status: str
    verdict: str | None


@dataclass(frozen=True)
class RunQuery:
    """Which runs to list; every field that is not None must match.

    `since` and `until` compare with the run's calendar time (ISO 8601, UTC; `until` is exclusive).
    """

    campaign: str | None = None
    rig: str | None = None
    kind: str | None = None
    role: str | None = None
    exit_status: str | None = None
    min_frequency_hz: float | None = None
    max_frequency_hz: float | None = None
    since: str | None = None
    until: str | None = None
    verdict: str | None = None


_CONDITIONS = {
    "campaign": "campaign = ?",
    "rig": "rig = ?",
    "kind": "kind = ?",
    "role": "role = ?",
    "exit_status": "exit_status = ?",
    "min_frequency_hz": "frequency_hz >= ?",
    "max_frequency_hz": "frequency_hz <= ?",
    "since": "started_at >= ?",
    "until": "started_at < ?",
    "verdict": "campaign IN (SELECT id FROM campaigns WHERE verdict = ?)",
}


class Catalogue:
    """The index file; safe to use from several threads and processes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._idle: deque[sqlite3.Connection] = deque()
        with self._connection():  # what cannot be opened says so at once
            pass

    def add_runs(self, runs: Iterable[RunSummary]) -> None:
        """Insert or replace, in one transaction."""
        marks = ", ".join("?" * len(_COLUMNS))
        self._write(
            f"INSERT OR REPLACE INTO runs ({', '.join(_COLUMNS)}) VALUES ({marks})",
            [_values(run) for run in runs],
        )

    def add_campaigns(self, campaigns: Iterable[CampaignRow]) -> None:
        """Insert or replace, in one transaction."""
        self._write(
            "INSERT OR REPLACE INTO campaigns (id, title, rig, created_at, status, verdict) "
            "VALUES (?, ?, ?, ?, ?, ?)",
            [astuple(campaign) for campaign in campaigns],
        )

    def forget(self, campaign: str) -> None:
        """Drop a campaign and its runs from the index."""
        self._write("DELETE FROM runs WHERE campaign = ?", [(campaign,)])
        self._write("DELETE FROM campaigns WHERE id = ?", [(campaign,)])

    def runs(
        self, query: RunQuery | None = None, *, after: str | None = None, limit: int = 100
    ) -> list[RunSummary]:
        """A page of runs ordered by id (``campaign/name``), starting behind `after`."""
        where, values = _where(query or RunQuery())
        if after is not None:
            campaign, _, name = after.partition("/")
            where.append("(campaign, name) > (?, ?)")
            values += [campaign, name]
        clause = f" WHERE {' AND '.join(where)}" if where else ""
        rows = self._read(
            f"SELECT {', '.join(_COLUMNS)} FROM runs{clause} ORDER BY campaign, name LIMIT ?",
            [*values, limit],
        )
        return [RunSummary(*row) for row in rows]

    def count(self, query: RunQuery | None = None) -> int:
        """How many runs match."""
        where, values = _where(query or RunQuery())
        clause = f" WHERE {' AND '.join(where)}" if where else ""
        return int(self._read(f"SELECT count(*) FROM runs{clause}", values)[0][0])

    def campaigns(
        self, *, after: str | None = None, limit: int = 100, verdict: str | None = None
    ) -> list[CampaignRow]:
        """A page of campaigns ordered by id, starting behind `after`."""
        rows = self._read(
            "SELECT id, title, rig, created_at, status, verdict FROM campaigns "
            "WHERE id > ? AND (?2 IS NULL OR verdict = ?2) ORDER BY id LIMIT ?3",
            [after or "", verdict, limit],
        )
        return [CampaignRow(*row) for row in rows]

    def clear(self) -> None:
        """Empty the index (before a rebuild)."""
        self._write("DELETE FROM runs", [()])
        self._write("DELETE FROM campaigns", [()])

    def close(self) -> None:
        """Close the connections that no thread has in hand."""
        while self._idle:
            self._idle.pop().close()

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        """A connection for the length of a block, opened where none is idle.

        As many stay open as were ever needed at once: threads come and go.
        """
        try:
            connection = self._idle.pop()
        except IndexError:
            connection = self._opened()
        try:
            yield connection
        except BaseException:
            connection.close()
            raise
        self._idle.append(connection)

    def _opened(self) -> sqlite3.Connection:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            connection = sqlite3.connect(self.path, timeout=30.0, check_same_thread=False)
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = NORMAL")
            if connection.execute("PRAGMA user_version").fetchone()[0] != SCHEMA_VERSION:
                connection.executescript(_SCHEMA)
        except (sqlite3.Error, OSError) as error:
            remedy = (
                "it holds nothing that the run files do not: remove it and run "
                "`entrain store rebuild`"
            )
            with suppress(OSError):
                if shutil.disk_usage(self.path.parent).free < NEEDED_BYTES:
                    remedy = "the disk is full: make room"
            raise StoreError(
                f"{self.path}: the catalogue cannot be opened ({error}); {remedy}"
            ) from error
        return connection

    def _write(self, statement: str, rows: Sequence[Sequence[object]]) -> None:
        try:
            with self._connection() as connection, connection:
                connection.executemany(statement, rows)
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: the catalogue cannot be written ({error})") from error

    def _read(self, statement: str, values: Sequence[object]) -> list[tuple[Any, ...]]:
        try:
            with self._connection() as connection:
                return connection.execute(statement, values).fetchall()
        except sqlite3.Error as error:
            raise StoreError(f"{self.path}: the catalogue cannot be read ({error})") from error


def _where(query: RunQuery) -> tuple[list[str], list[object]]:
    given = [
        (condition, getattr(query, name))
        for name, condition in _CONDITIONS.items()
        if getattr(query, name) is not None
    ]
    return [condition for condition, _ in given], [value for _, value in given]
