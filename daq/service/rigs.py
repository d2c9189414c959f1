"""Which rigs there are, and how to open one.

Rigs come from the configuration; simulated ones can be added while the service runs and are kept
in a file. A rig is described by plain data (`RigEntry`), because it is opened in the process that
runs the campaign, never in the service's own.
"""

import json
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from daq.store import write_json
from drivers.errors import SettingError
from drivers.factory import known_options, made, open_device
from drivers.protocols import DuplexRig
from drivers.types import OutputLimits

if TYPE_CHECKING:
    from daq.service.settings import RigSettings
    from simulated_rig.rig import SimulatedRig

SIMULATED = "simulated"


class RigConflict(ValueError):
    """A rig of that name exists, or may not be removed."""


@dataclass(frozen=True)
class RigEntry:
    """A rig's name, driver and options."""

    name: str
    driver: str
    options: dict[str, Any]
    source: Literal["settings", "added"] = "settings"

    @property
    def sealed(self) -> bool:
        """Whether it carries an effect that is kept from everybody."""
        return self.options.get("effects") == "sealed"


class Rigs:
    """The rigs by name; those added at run time are kept in `path`."""

    def __init__(self, configured: "dict[str, RigSettings]", path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._rigs = {
            name: RigEntry(name, rig.driver, dict(rig.options)) for name, rig in configured.items()
        }
        if path.is_file():
            for row in json.loads(path.read_text(encoding="utf-8"))["rigs"]:
                self._rigs.setdefault(row["name"], RigEntry(**row))

    def names(self) -> list[str]:
        return list(self._rigs)

    def get(self, name: str) -> RigEntry | None:
        return self._rigs.get(name)

    def add(self, entry: RigEntry) -> None:
        """Add a rig; raises `RigConflict` where the name is taken."""
        with self._lock:
            if entry.name in self._rigs:
                raise RigConflict(f"there is a rig {entry.name!r} already")
            self._rigs[entry.name] = entry
            self._write()

    def remove(self, name: str) -> None:
        """Remove a rig that was added; raises `RigConflict` for one of the configuration."""
        with self._lock:
            if self._rigs[name].source == "settings":
                raise RigConflict(f"rig {name!r} stands in the configuration")
            del self._rigs[name]
            self._write()

    def _write(self) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        rows = [asdict(rig) for rig in self._rigs.values() if rig.source == "added"]
        write_json(self._path, {"rigs": rows})


def open_rig(entry: RigEntry) -> DuplexRig:
    """The rig itself, stopped and silent; a real one in a process of its own.

    So a tone ends in silence also after ``kill -9`` of whoever opened it, and a vendor's library
    that hangs is given up after a time.

    Raises
    ------
    SettingError
        The options are not the driver's, or a value is refused.
    DriverError
        The device is missing, or its library is.
    """
    if entry.driver == SIMULATED:
        return open_simulated(entry)
    return open_device(entry.driver, entry.name, entry.options, isolate=True)


def open_simulated(entry: RigEntry) -> "SimulatedRig":
    """A simulated rig from `build_rig`'s own parameters."""
    from simulated_rig import build_rig

    where = f"rig {entry.name!r}"
    options = dict(known_options(build_rig, where, entry.options, "name"))
    if options.get("limits") is not None:
        options["limits"] = made(OutputLimits, f"{where}: limits", options["limits"])
    try:
        return build_rig(name=entry.name, **options)
    except (TypeError, ValueError) as error:
        raise SettingError(f"{where}: {error}") from error
