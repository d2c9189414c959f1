"""The few things of nidaqmx that are used here, loaded late, and its errors in our tree."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.errors import (
    DeviceFault,
    DeviceLost,
    DeviceTimeout,
    DriverError,
    MissingDependency,
)

# Codes of NI-DAQmx (nidaqmx.error_codes.DAQmxErrors).
TIMEOUTS = {-200284, -200474, -200292}
LOST = {-200220, -201003, -88705, -88710, -50405, -200324}


@dataclass(frozen=True)
class Library:
    """What a rig needs of the library; `error` is its root exception."""

    task: Callable[[], Any]
    reader: Callable[[Any], Any]
    writer: Callable[[Any], Any]
    terminal: Callable[[str], Any]
    continuous: Any
    no_regeneration: Any
    error: type[Exception]
    devices: Callable[[], list[Any]]
    version: str


def daqmx() -> Library:
    """The library with a driver below it, or `MissingDependency`."""
    try:
        import nidaqmx
        import nidaqmx.system
        from nidaqmx import constants, errors, stream_readers, stream_writers
    except ImportError as error:
        raise MissingDependency("nidaqmx missing: pip install 'entrain[ni]'") from error
    local = nidaqmx.system.System.local
    try:
        version = local().driver_version
    except (errors.DaqNotFoundError, errors.DaqNotSupportedError) as error:
        raise MissingDependency(f"NI-DAQmx: {error}") from error

    def terminal(name: str) -> Any:
        return constants.TerminalConfiguration[name]

    return Library(
        task=nidaqmx.Task,
        reader=stream_readers.AnalogMultiChannelReader,
        writer=stream_writers.AnalogSingleChannelWriter,
        terminal=terminal,
        continuous=constants.AcquisitionType.CONTINUOUS,
        no_regeneration=constants.RegenerationMode.DONT_ALLOW_REGENERATION,
        error=errors.Error,
        devices=lambda: list(local().devices),
        version=".".join(str(part) for part in version),
    )


def translated(error: Exception) -> DriverError:
    """A DAQmx error in our tree, by its code."""
    code = getattr(error, "error_code", 0)
    kind: type[DriverError] = DeviceFault
    if code in TIMEOUTS:
        kind = DeviceTimeout
    elif code in LOST:
        kind = DeviceLost
    first_line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    text = f"{'device lost: ' if kind is DeviceLost else ''}{first_line} (DAQmx {code})"
    return kind(text)
