"""API keys: who may do what.

A key is ``ent_<id>_<secret>``, shown once. At rest there is only its SHA-256: the secret holds
256 random bits, so that guessing is hopeless without a slow hash, and every request can afford
the check. Scopes: ``read`` sees, ``control`` moves a rig and starts work, ``configure`` changes
what others rely on (imports, calibrations, rigs), ``admin`` does everything. Each of them
includes ``read``.

The file is re-read when it changes, so `entrain keys revoke` reaches a running service at once.
"""

import hashlib
import hmac
import json
import os
import secrets
import tempfile
import threading
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Literal, cast, get_args

from daq.errors import unwritable

Scope = Literal["read", "control", "configure", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)


class InvalidKey(ValueError):
    """A key's name, scope or time is not acceptable, or no key has that identifier."""


@dataclass(frozen=True)
class Principal:
    """Who is asking, and what for: `name` goes to the audit trail."""

    name: str
    scopes: frozenset[Scope]
    key_id: str | None = None

    def may(self, scope: Scope) -> bool:
        return (
            scope in self.scopes
            or "admin" in self.scopes
            or (scope == "read" and bool(self.scopes))
        )


LOCAL = Principal("local", frozenset({"admin"}))
NOBODY = Principal("nobody", frozenset())


@dataclass(frozen=True)
class Key:
    """One key as the file keeps it; times are RFC 3339."""

    id: str
    name: str
    scopes: tuple[Scope, ...]
    sha256: str
    created: str
    expires: str | None = None
    revoked: str | None = None

    def state(self, now: datetime) -> Literal["active", "expired", "revoked"]:
        if self.revoked:
            return "revoked"
        if self.expires and datetime.fromisoformat(self.expires) <= now:
            return "expired"
        return "active"


def utc_now() -> datetime:
    return datetime.now(UTC)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


class KeyStore:
    """The file of keys, at `path`; safe for several threads of one process."""

    def __init__(self, path: Path, now: Callable[[], datetime] = utc_now) -> None:
        self._path = path
        self._now = now
        self._lock = threading.Lock()
        self._stamp: tuple[int, int] | None = None
        self._keys: dict[str, Key] = {}

    def create(
        self, name: str, scopes: Iterable[str], valid_for: timedelta | None = None
    ) -> tuple[Key, str]:
        """A new key and its text, which is nowhere kept."""
        wanted = tuple(dict.fromkeys(scopes))
        for scope in wanted:
            if scope not in SCOPES:
                raise InvalidKey(f"scope={scope!r} is not one of {', '.join(SCOPES)}")
        if not wanted:
            raise InvalidKey(f"scopes=() is empty: give at least one of {', '.join(SCOPES)}")
        if not name.strip() or len(name) > 100 or not name.isprintable():
            raise InvalidKey(f"name={name!r} is not a printable name of 1 to 100 characters")
        if valid_for is not None and valid_for <= timedelta(0):
            raise InvalidKey(f"valid_for={valid_for} is not a time > 0")
        now = self._now()
        identifier, secret = secrets.token_hex(4), secrets.token_urlsafe(32)
        key = Key(
            id=identifier,
            name=name.strip(),
            scopes=cast("tuple[Scope, ...]", wanted),
            sha256=_hash(secret),
            created=now.isoformat(timespec="seconds"),
            expires=(now + valid_for).isoformat(timespec="seconds") if valid_for else None,
        )
        with self._lock:
            self._refresh()
            self._keys[identifier] = key
            self._write()
        return key, f"ent_{identifier}_{secret}"

    def revoke(self, identifier: str) -> Key:
        """End a key for good; it stays in the list, so that the audit trail keeps its name."""
        with self._lock:
            self._refresh()
            key = self._keys.get(identifier)
            if key is None:
                raise InvalidKey(f"there is no key {identifier!r}; `entrain keys list` shows them")
            if not key.revoked:
                key = replace(key, revoked=self._now().isoformat(timespec="seconds"))
                self._keys[identifier] = key
                self._write()
            return key

    def all(self) -> list[Key]:
        with self._lock:
            self._refresh()
            return sorted(self._keys.values(), key=lambda key: (key.created, key.id))

    def authenticate(self, text: str) -> Principal | None:
        """The key's owner; None for anything but an active key, without saying which."""
        prefix, _, rest = text.partition("_")
        identifier, _, secret = rest.partition("_")
        if prefix != "ent" or not secret:
            return None
        with self._lock:
            self._refresh()
            key = self._keys.get(identifier)
        if key is None or not hmac.compare_digest(key.sha256, _hash(secret)):
            return None
        if key.state(self._now()) != "active":
            return None
        return Principal(key.name, frozenset(key.scopes), key.id)

    def _refresh(self) -> None:
        try:
            status = self._path.stat()
        except FileNotFoundError:
            self._keys, self._stamp = {}, None
            return
        stamp = (status.st_mtime_ns, status.st_size)
        if stamp == self._stamp:
            return
        rows = json.loads(self._path.read_text(encoding="utf-8"))
        self._keys = {row["id"]: Key(**{**row, "scopes": tuple(row["scopes"])}) for row in rows}
        self._stamp = stamp

    def _write(self) -> None:
        name: str | None = None
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            # readable by the owner only
            handle, name = tempfile.mkstemp(dir=self._path.parent, prefix=".keys.")
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump([asdict(key) for key in self._keys.values()], file, indent=1)
            os.replace(name, self._path)
        except OSError as error:
            if name is not None:
                Path(name).unlink(missing_ok=True)
            raise unwritable(self._path, error) from error
        status = self._path.stat()
        self._stamp = (status.st_mtime_ns, status.st_size)
