"""From plain data, as it stands in a configuration, to an open and silent rig.

    driver        options (beside `limits`)
    ──────────────────────────────────────────────────────────────────────────────────────────
    soundcard     the fields of `SoundCardSettings`
    ni            the fields of `NiSettings`
    composed      `input` and `output`, each a table with its own `driver`:
      input       microcontroller: address, baud, channels
                  scope: address, channels, sample_rate_hz, record_frames
      output      scpi: address, output, timeout_s      serial: address, baud

Any of them may have `flows`, mass-flow controllers by name (the fields of `FlowSettings`), which
set the operating point (`drivers.operated`), and `interlocks`, inputs by name (the fields of
`InterlockSettings`), which stop the rig while they are not closed (`drivers.interlock`). `isolate`
puts the rig into a process of its own (`drivers.isolated`). Modules of a family are imported when
it is asked for, so that none needs another's library.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

from drivers.composed import ClosableInput, ComposedRig
from drivers.errors import DriverError, SettingError
from drivers.protocols import DuplexRig
from drivers.stepped_output import SteppedOutput
from drivers.types import Channel, OutputLimits, require_si

Options = Mapping[str, Any]
T = TypeVar("T")


def open_device(driver: str, name: str, options: Options, *, isolate: bool = False) -> DuplexRig:
    """The rig, stopped and silent.

    Raises
    ------
    SettingError
        Unknown driver or option, missing limits, a value that the device refuses.
    DriverError
        The device or its library is missing.
    """
    maker = DRIVERS.get(driver)
    if maker is None:
        raise SettingError(f"rig {name!r}: driver={driver!r} is not one of {sorted(DRIVERS)}")
    if "limits" not in options:
        raise SettingError(f"rig {name!r}: limits are missing: max_amplitude_v at least")
    for part, around in AROUND.items():
        if part in options:
            try:
                wrap = around(options[part])  # options are looked at before anything is opened
            except (AttributeError, TypeError) as error:
                raise SettingError(f"rig {name!r}: {part}: {error}") from error
            inner = {key: value for key, value in options.items() if key != part}
            rig = open_device(driver, name, inner, isolate=isolate)
            try:
                return wrap(rig)
            except DriverError:
                rig.close()
                raise
    if isolate:
        from drivers.isolated import IsolatedRig

        return IsolatedRig(functools.partial(open_device, driver, name, dict(options)))
    rest = {key: value for key, value in options.items() if key != "limits"}
    try:
        return maker(name, rest, OutputLimits(**options["limits"]))
    except TypeError as error:
        raise SettingError(f"rig {name!r}: {error}") from error


def channels_of(rows: Any) -> tuple[Channel, ...]:
    """Channels from tables of their fields."""
    return tuple(require_si(Channel(**row)) for row in rows)


def settings_of(kind: Callable[..., Any], name: str, options: Options) -> Any:
    """A settings dataclass from plain data; lists become the tuples that it wants."""
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    if unknown := sorted(set(options) - known):
        raise SettingError(f"rig {name!r}: unknown options {', '.join(unknown)}")
    plain = {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
    plain["channels"] = channels_of(options.get("channels", ()))
    return kind(**{"name": name, **plain})


def _sound_card(name: str, options: Options, limits: OutputLimits) -> DuplexRig:
    from drivers.audio_settings import SoundCardSettings
    from drivers.soundcard import SoundCardRig

    return SoundCardRig(settings_of(SoundCardSettings, name, options), limits)


def _ni(name: str, options: Options, limits: OutputLimits) -> DuplexRig:
    from drivers.ni import NiRig, NiSettings

    return NiRig(settings_of(NiSettings, name, options), limits)


def _composed(name: str, options: Options, limits: OutputLimits) -> DuplexRig:
    if unknown := sorted(set(options) - {"input", "output"}):
        raise SettingError(f"rig {name!r}: unknown options {', '.join(unknown)}")
    make_output = _part(name, "output", options, OUTPUTS)
    make_input = _part(name, "input", options, INPUTS)
    output = make_output(limits=limits)
    try:
        acquisition = make_input()
    except (DriverError, TypeError):
        output.close()
        raise
    return ComposedRig(name, acquisition, output)


def _part(
    name: str, part: str, options: Options, makers: Mapping[str, Callable[..., T]]
) -> Callable[..., T]:
    """The maker that the table `part` names, with the rest of the table as its arguments."""
    table = dict(options.get(part, {}))
    driver = table.pop("driver", None)
    if driver not in makers:
        raise SettingError(f"rig {name!r}: {part}.driver={driver!r} is not one of {sorted(makers)}")
    return functools.partial(makers[driver], **table)


def _microcontroller(address: str, channels: Any, baud: int = 115200) -> ClosableInput:
    from drivers.microcontroller import MicrocontrollerInput
    from drivers.serialport import SerialPort

    return MicrocontrollerInput(SerialPort(address, baud), channels_of(channels))


def _scope(address: str, channels: Any, sample_rate_hz: float, record_frames: int) -> ClosableInput:
    from drivers.visa_link import VisaLink
    from drivers.visa_scope import ScopeInput

    return ScopeInput(VisaLink(address), channels_of(channels), sample_rate_hz, record_frames)


def _scpi(
    address: str, limits: OutputLimits, output: int = 1, timeout_s: float = 2.0
) -> SteppedOutput:
    from drivers.visa_generator import open_generator

    return open_generator(address, limits, output=output, timeout_s=timeout_s)


def _serial(address: str, limits: OutputLimits, baud: int = 115200) -> SteppedOutput:
    from drivers.serial_devices import SerialGenerator
    from drivers.serialport import SerialPort

    return SteppedOutput(SerialGenerator(SerialPort(address, baud)), limits)


Around = Callable[[DuplexRig], DuplexRig]


def _operated(flows: Mapping[str, Options]) -> Around:
    from drivers.operated import FlowSettings, OperatedRig

    settings = {key: FlowSettings(**table) for key, table in flows.items()}
    return lambda rig: OperatedRig(rig, {key: one.open() for key, one in settings.items()})


def _interlocked(interlocks: Mapping[str, Options]) -> Around:
    from drivers.interlock import InterlockedRig, InterlockSettings

    settings = {key: InterlockSettings(**table) for key, table in interlocks.items()}
    return lambda rig: InterlockedRig(rig, {key: one.open() for key, one in settings.items()})


AROUND: dict[str, Callable[[Mapping[str, Options]], Around]] = {
    "interlocks": _interlocked,
    "flows": _operated,
}
DRIVERS: dict[str, Callable[[str, Options, OutputLimits], DuplexRig]] = {
    "soundcard": _sound_card,
    "ni": _ni,
    "composed": _composed,
}
INPUTS: dict[str, Callable[..., ClosableInput]] = {
    "microcontroller": _microcontroller,
    "scope": _scope,
}
OUTPUTS: dict[str, Callable[..., SteppedOutput]] = {"scpi": _scpi, "serial": _serial}
