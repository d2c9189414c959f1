"""Configuration: one tree of settings from defaults, one TOML file and the environment.

The environment (``ENTRAIN_SERVER__PORT=9000``) wins over the file, the file over the defaults.
A key that no setting has is refused wherever it stands, the environment included: a misspelt
limit must never be silently ignored. `explain` says where each value came from.

The file is the first of: the ``--config`` option, ``ENTRAIN_CONFIG``, ``./entrain.toml``,
``$XDG_CONFIG_HOME/entrain/entrain.toml``.
"""

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from daq.documents import read_document
from daq.errors import InputError, told

PREFIX = "ENTRAIN_"
# Variables of the same prefix that are no settings: the file's place, and the tests' own switch.
NOT_SETTINGS = frozenset({"ENTRAIN_CONFIG", "ENTRAIN_REQUIRE_COMPONENTS"})
LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})


class ConfigError(ValueError):
    """The configuration is wrong: the message says which key, its source and the requirement."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ServerSettings(_Part):
    """Where the service listens and what it lets in."""

    host: str = Field(default="127.0.0.1", description="Address to bind; any other needs API keys")
    port: int = Field(default=8000, ge=0, le=65535, description="TCP port; 0 takes a free one")
    tls_certificate: Path | None = Field(
        default=None, description="PEM certificate chain for HTTPS"
    )
    tls_key: Path | None = Field(default=None, description="PEM private key for HTTPS")
    require_key: bool = Field(default=False, description="Ask for API keys on loopback as well")
    allowed_origins: tuple[str, ...] = Field(
        default=(), description="Web origins other than the service's own that may change things"
    )
    allowed_hosts: tuple[str, ...] = Field(
        default=(),
        description="Host names by which clients may address the service besides the bound one",
    )
    max_body_bytes: int = Field(default=1_000_000, ge=1_000, description="Largest JSON body")
    max_upload_bytes: int = Field(default=2_000_000_000, ge=1_000, description="Largest upload")
    requests_per_s: float = Field(
        default=200.0, gt=0, description="Sustained requests of one client"
    )
    request_burst: int = Field(
        default=400, ge=1, description="Requests of one client in one instant"
    )
    shutdown_s: float = Field(default=10.0, gt=0, description="Time to finish writing at shutdown")

    @model_validator(mode="after")
    def _both_or_none(self) -> "ServerSettings":
        if (self.tls_certificate is None) != (self.tls_key is None):
            raise ValueError("tls_certificate and tls_key must be given together")
        return self

    @property
    def loopback(self) -> bool:
        return self.host in LOOPBACK


class LiveSettings(_Part):
    """Live streams."""

    history: int = Field(default=2_000, ge=10, description="Events kept for clients that resume")
    queue: int = Field(default=256, ge=4, description="Events waiting for one client before drops")
    max_clients: int = Field(default=400, ge=1, description="Live streams served at once")
    keep_alive_s: float = Field(
        default=10.0, gt=0, description="Silence after which a heartbeat is sent"
    )


class JobSettings(_Part):
    """Long work."""

    workers: int = Field(
        default=1, ge=1, le=64, description="Analyses at once, each a process of its own"
    )
    keep: int = Field(default=500, ge=10, description="Finished jobs remembered")
    timeout_s: float = Field(
        default=3_600.0, gt=0, description="An analysis that takes longer is ended"
    )


class LogSettings(_Part):
    """Logs."""

    level: Literal["debug", "info", "warning", "error"] = Field(
        default="info", description="Least level"
    )
    format: Literal["text", "json"] = Field(
        default="text", description="For people, or for collectors"
    )


class RigSettings(_Part):
    """One rig: the driver that runs it and that driver's own options."""

    driver: str = Field(
        default="simulated", description="'simulated' or a name that `devices` lists"
    )
    options: dict[str, Any] = Field(default_factory=dict, description="Passed to the driver")

    @field_validator("driver")
    @classmethod
    def _named(cls, value: str) -> str:
        if not value:
            raise ValueError("the driver's name must not be empty")
        return value


def _data_home() -> Path:
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "entrain"


class Settings(BaseSettings):
    """All settings. Build it with `load`, which names the source of every mistake."""

    model_config = SettingsConfigDict(
        env_prefix=PREFIX, env_nested_delimiter="__", extra="forbid", frozen=True
    )

    data_dir: Path = Field(
        default_factory=_data_home, description="Run store, keys, audit trail, jobs"
    )
    server: ServerSettings = ServerSettings()
    live: LiveSettings = LiveSettings()
    jobs: JobSettings = JobSettings()
    log: LogSettings = LogSettings()
    rigs: dict[str, RigSettings] = Field(
        default_factory=lambda: {"simulated": RigSettings()},
        description="Rigs by name; one simulated rig where none is named",
    )

    @property
    def store_dir(self) -> Path:
        return self.data_dir / "store"

    @property
    def keys_file(self) -> Path:
        return self.data_dir / "keys.json"

    @property
    def audit_file(self) -> Path:
        return self.data_dir / "audit.jsonl"

    @property
    def needs_key(self) -> bool:
        """Whether a request without a key is refused."""
        return self.server.require_key or not self.server.loopback


@dataclass(frozen=True)
class Origin:
    """One setting's value and where it came from."""

    key: str
    value: Any
    source: str
    description: str


def find_file(explicit: Path | None = None) -> Path | None:
    """The configuration file in force, or None; a file that was asked for must exist."""
    asked = explicit or (Path(p) if (p := os.environ.get("ENTRAIN_CONFIG")) else None)
    if asked is not None:
        if not asked.is_file():
            what = "is no file" if asked.exists() else "does not exist"
            raise ConfigError(f"configuration file {str(asked)!r} {what}")
        return asked
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    places = (Path("entrain.toml"), home / "entrain" / "entrain.toml")
    return next((place for place in places if place.is_file()), None)


def read_file(path: Path | None) -> dict[str, Any]:
    """The file's table; empty without one."""
    if path is None:
        return {}
    try:
        return read_document(path)
    except (InputError, OSError) as error:
        raise ConfigError(str(error)) from error


def _environment() -> dict[str, str]:
    """This product's variables, lower-cased dotted key to variable name."""
    found = {
        name[len(PREFIX) :].lower().replace("__", "."): name
        for name in os.environ
        if name.upper().startswith(PREFIX) and name not in NOT_SETTINGS
    }
    known = set(Settings.model_fields)
    for key, name in found.items():
        head, _, rest = key.partition(".")
        field = Settings.model_fields.get(head)
        part = field.annotation if field else None
        if head not in known or (
            rest
            and isinstance(part, type)
            and issubclass(part, BaseModel)
            and rest not in part.model_fields
        ):
            raise ConfigError(
                f"environment variable {name}: no setting is called {key!r}; "
                "`entrain config show` lists them all"
            )
    return found


class _FromFile(Settings):
    """`Settings` whose keyword arguments (the file) give way to the environment."""

    @classmethod
    def settings_customise_sources(  # type: ignore[no-untyped-def]
        cls, settings_cls, init_settings, env_settings, dotenv_settings, file_secret_settings
    ):
        return env_settings, init_settings


def load(explicit: Path | None = None, **overrides: Any) -> Settings:
    """The settings in force; `overrides` (options, as ``server__port=9000``) win over all.

    Raises `ConfigError` for a missing or unreadable file, an unknown key and a wrong value.
    """
    path = find_file(explicit)
    table = read_file(path)
    _environment()
    try:
        settings: Settings = _FromFile(**table)
        for dotted, value in overrides.items():
            head, _, leaf = dotted.partition("__")
            part = getattr(settings, head)
            changed = type(part).model_validate({**part.model_dump(), leaf: value})
            settings = settings.model_copy(update={head: changed})
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"]) or "settings"
        given = told(first["input"])
        raise ConfigError(f"{_source(key, table, path)}: {key}{given}: {first['msg']}") from error
    return settings


def _source(key: str, table: Mapping[str, Any], path: Path | None) -> str:
    variable = _environment_of(key)
    if variable:
        return f"environment {variable}"
    branch: Any = table
    for part in key.split("."):
        if not isinstance(branch, Mapping) or part not in branch:
            return "default"
        branch = branch[part]
    return f"file {path}"


def _environment_of(key: str) -> str | None:
    found = _environment()
    parts = key.split(".")
    names = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    return next((found[name] for name in names if name in found), None)


def leaves(model: BaseModel, prefix: str = "") -> Iterator[tuple[str, Any, str]]:
    """Every setting below `model`: dotted key, value, what it means."""
    for name, field in type(model).model_fields.items():
        value = getattr(model, name)
        key = f"{prefix}{name}"
        if isinstance(value, BaseModel):
            yield from leaves(value, f"{key}.")
        elif name == "rigs":
            for rig, settings in value.items():
                yield from leaves(settings, f"{key}.{rig}.")
        else:
            yield key, value, field.description or ""


def explain(explicit: Path | None = None) -> list[Origin]:
    """Every setting with its value, its source and what it means."""
    path = find_file(explicit)
    table = read_file(path)
    return [
        Origin(key, value, _source(key, table, path), description)
        for key, value, description in leaves(load(explicit))
    ]
