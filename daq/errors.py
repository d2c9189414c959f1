"""What can go wrong in acquisition, campaigns and the run store.

    DaqError
    ├── InputError         a folder, recording or plan handed in is not usable (ValueError)
    ├── StoreError         the run store cannot be written or read
    │   ├── UnknownItem    no campaign or run of that name (also a KeyError)
    │   └── CorruptFile    a run file is damaged or is not a run file
    │       └── OtherVersion   it is whole, but of a format that this version does not read
    └── CampaignError      a campaign cannot start or go on

Failures of devices are `drivers.errors.DriverError`. A message names the place, the parameter, its
value and the requirement, then the remedy.
"""

import errno
from pathlib import Path
from typing import Any


class DaqError(Exception):
    """Root of the tree."""


class InputError(DaqError, ValueError):
    """Something that was handed in is not usable: the message says what and where."""


class StoreError(DaqError):
    """The run store cannot be written or read."""


class UnknownItem(StoreError, KeyError):
    """No campaign or run of that name."""

    def __str__(self) -> str:
        return str(self.args[0]) if self.args else ""


class CorruptFile(StoreError):
    """A run file is damaged, or is not a run file."""


class OtherVersion(CorruptFile):
    """A run file that another version of entrain wrote, in a format that this one does not read."""


class CampaignError(DaqError):
    """A campaign cannot start or cannot go on."""


def told(value: Any) -> str:
    """``=value`` of a number or a short text, for an error's sentence; of anything else nothing."""
    short = isinstance(value, str) and len(value) <= 60
    return f"={value!r}" if short or isinstance(value, (bool, int, float)) else ""


def unwritable(path: Path, error: OSError) -> StoreError:
    """What to raise where a file cannot be written: which, why, and the remedy that there is."""
    remedy = ": the disk is full, make room" if error.errno == errno.ENOSPC else ""
    return StoreError(f"{path}: cannot be written ({error.strerror or error}){remedy}")
