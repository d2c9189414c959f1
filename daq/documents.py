"""Files that people write (TOML, JSON): read as what they are, or refused in words."""

import json
import tomllib
from pathlib import Path
from typing import Any

from daq.errors import InputError

MAX_BYTES = 4 << 20


def require_file(path: Path, remedy: str = "") -> None:
    """Raise `InputError` for what is no file to read; `remedy` follows what it is instead."""
    if not path.is_file():
        what = "is a folder: give a file" if path.is_dir() else "no such file"
        if path.exists() and not path.is_dir():
            what = "is a pipe or a device: give a file"
        raise InputError(f"{path}: {what}{remedy}")


def read_document(path: Path, remedy: str = "") -> dict[str, Any]:
    """The table in a TOML file, or JSON where the suffix says so; raises `InputError`."""
    require_file(path, remedy)
    if path.stat().st_size > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB is no description")
    kind = "JSON" if path.suffix == ".json" else "TOML"
    try:
        text = path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
        content = json.loads(text) if kind == "JSON" else tomllib.loads(text)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 ({error.reason}): save it as UTF-8") from error
    except RecursionError as error:
        raise InputError(f"{path}: not {kind}: nested too deeply") from error
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not {kind}: {error}") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no table")
    return content
