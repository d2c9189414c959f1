"""`entrain keys`: make, list and revoke API keys."""

import re
from datetime import timedelta
from typing import Annotated

import typer

from daq.service.commands.common import config_file, out, table
from daq.service.keys import InvalidKey, KeyStore, utc_now

app = typer.Typer(help="API keys of the service.", no_args_is_help=True)
LONGEST_DAYS = 36_500  # as the API takes it
UNITS = {"h": 1 / 24, "d": 1.0, "w": 7.0, "y": 365.0}


def _store() -> KeyStore:
    from daq.service.settings import load

    return KeyStore(load(config_file()).keys_file)


def duration(text: str) -> timedelta:
    """``12h``, ``30d``, ``8w``, ``1y``."""
    match = re.fullmatch(r"(\d+)([hdwy])", text)
    if match is None:
        raise InvalidKey(f"--expires={text!r} is not a time like 12h, 30d, 8w or 1y")
    days = int(match[1]) * UNITS[match[2]]
    if days > LONGEST_DAYS:
        raise InvalidKey(f"--expires={text!r} is more than {LONGEST_DAYS // 365}y; or give never")
    return timedelta(days=days)


@app.command("create")
def create(
    name: Annotated[str, typer.Argument(help="Whose key it is; goes to the audit trail.")],
    scope: Annotated[
        list[str] | None, typer.Option(help="read, control, configure, admin; repeat for several.")
    ] = None,
    expires: Annotated[str, typer.Option(help="12h, 30d, 8w, 1y or never.")] = "1y",
) -> None:
    """Make a key and print it, this once."""
    valid_for = None if expires == "never" else duration(expires)
    key, text = _store().create(name, scope or ["read"], valid_for)
    out.print(text, soft_wrap=True)
    typer.echo(
        f"key {key.id} of {key.name!r}: {', '.join(key.scopes)}, "
        f"expires {key.expires or 'never'}; it is not shown again",
        err=True,
    )


@app.command("list")
def list_keys() -> None:
    """List keys; their texts are not kept."""
    now = utc_now()
    table(
        "",
        ("id", "name", "scopes", "created", "expires", "state"),
        (
            (k.id, k.name, " ".join(k.scopes), k.created, k.expires or "never", k.state(now))
            for k in _store().all()
        ),
    )


@app.command("revoke")
def revoke(key: Annotated[str, typer.Argument(help="The key's id.")]) -> None:
    """End a key at once, in running services too."""
    revoked = _store().revoke(key)
    out.print(f"key {revoked.id} of {revoked.name!r} is revoked", markup=False)
