"""API keys: hashed at rest, scoped, expiring, revocable, also from another process."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from daq.service.keys import InvalidKey, KeyStore, Principal


class Now:
    def __init__(self) -> None:
        self.time = datetime(2026, 1, 1, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.time


def test_only_a_hash_is_kept_and_only_the_owner_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    _, text = KeyStore(path).create("desk", ["read"])
    secret = text.split("_", 2)[2]
    assert secret not in path.read_text()
    assert path.stat().st_mode & 0o077 == 0


def test_a_key_authenticates_until_it_expires(tmp_path: Path) -> None:
    now = Now()
    store = KeyStore(tmp_path / "keys.json", now)
    key, text = store.create("desk", ["control"], timedelta(days=1))
    assert store.authenticate(text) == Principal("desk", frozenset({"control"}), key.id)
    now.time += timedelta(days=1)
    assert store.authenticate(text) is None
    assert store.all()[0].state(now()) == "expired"


def test_revoking_reaches_a_running_service(tmp_path: Path) -> None:
    path = tmp_path / "keys.json"
    service, command_line = KeyStore(path), KeyStore(path)
    key, text = command_line.create("desk", ["read"])
    assert service.authenticate(text) is not None
    command_line.revoke(key.id)
    assert service.authenticate(text) is None


@pytest.mark.parametrize("spoil", ["x" + "{}", "{}x", "{}"[:0], "ent_", "ent__", "ent_00000000_x"])
def test_anything_else_is_nobody(tmp_path: Path, spoil: str) -> None:
    store = KeyStore(tmp_path / "keys.json")
    _, text = store.create("desk", ["read"])
    assert store.authenticate(spoil.format(text)) is None


@pytest.mark.parametrize(
    ("scopes", "may"),
    [
        (["read"], {"read"}),
        (["control"], {"read", "control"}),
        (["configure"], {"read", "configure"}),
        (["admin"], {"read", "control", "configure", "admin"}),
    ],
)
def test_what_a_scope_includes(tmp_path: Path, scopes: list[str], may: set[str]) -> None:
    store = KeyStore(tmp_path / "keys.json")
    principal = store.authenticate(store.create("desk", scopes)[1])
    assert principal is not None
    assert {s for s in ("read", "control", "configure", "admin") if principal.may(s)} == may  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "scopes", "days"),
    [("", ["read"], 1), ("a", [], 1), ("a", ["root"], 1), ("a", ["read"], 0)],
)
def test_bad_keys_are_refused(tmp_path: Path, name: str, scopes: list[str], days: int) -> None:
    with pytest.raises(InvalidKey):
        KeyStore(tmp_path / "keys.json").create(name, scopes, timedelta(days=days))
    assert not (tmp_path / "keys.json").exists()
