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
import inspect
from collections.abc import Callable, Mapping
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin

from drivers.composed import ClosableInput, ComposedRig
from drivers.errors import DriverError, SettingError
from drivers.protocols import DuplexRig
from drivers.stepped_output import SteppedOutput
from drivers.types import Channel, OutputLimits, is_number, require_si

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
            if not isinstance(options[part], Mapping):
                raise SettingError(f"rig {name!r}: {part}={options[part]!r} is not a table")
            wrap = around(
                f"rig {name!r}: {part}", options[part]
            )  # options are looked at before anything is opened
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
    limits = made(OutputLimits, f"rig {name!r}: limits", options["limits"])
    return maker(name, rest, limits)


def known_options(maker: Callable[..., Any], where: str, table: Any, *taken: str) -> Options:
    """A table of a configuration whose keys are parameters of `maker`, none of those `taken`;
    raises `SettingError`."""
    if not isinstance(table, Mapping):
        raise SettingError(f"{where}={table!r} is not a table of options")
    offered = [key for key in inspect.signature(maker).parameters if key not in taken]
    if unknown := sorted(str(key) for key in set(table) - set(offered)):
        raise SettingError(f"{where}: unknown options {', '.join(unknown)}; known: {offered}")
    return table


def made(maker: Callable[..., T], where: str, table: Any, **given: Any) -> T:
    """`maker` called with a table of a configuration, its lists as the tuples that are wanted,
    beside what is `given`; raises `SettingError` naming the option."""
    plain = dict(known_options(maker, where, table, *given))
    for key, wanted in inspect.signature(maker).parameters.items():
        if key in plain:
            plain[key] = value = tuple(plain[key]) if isinstance(plain[key], list) else plain[key]
            if not _fits(value, wanted.annotation):
                kind = getattr(wanted.annotation, "__name__", str(wanted.annotation))
                raise SettingError(f"{where}: {key}={value!r} is not {WORDS.get(kind, kind)}")
        elif wanted.default is wanted.empty and key not in given:
            raise SettingError(f"{where}: {key} is missing")
    return maker(**plain, **given)


WORDS = {
    "float": "a finite number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
}


def _fits(value: object, annotation: Any) -> bool:
    """Whether a plain value is of the type that a parameter wants, where that is a plain one."""
    if get_origin(annotation) is Literal:
        return value in get_args(annotation)
    kinds = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    if value is None or float in kinds:
        return NoneType in kinds if value is None else is_number(value)
    if isinstance(value, bool) and int in kinds:
        return False
    plain = tuple(kind for kind in kinds if kind in (int, str, bool))
    return not plain or isinstance(value, plain)


def settings_of(kind: Callable[..., T], name: str, options: Options) -> T:
    """A settings dataclass from plain data."""
    channels = channels_of(options.get("channels", ()), f"rig {name!r}: channels")
    return made(kind, f"rig {name!r}", {"name": name, **options, "channels": channels})


def channels_of(rows: Any, where: str = "channels") -> tuple[Channel, ...]:
    """Channels from tables of their fields."""
    if not isinstance(rows, list | tuple):
        raise SettingError(f"{where}={rows!r} is not a list of tables")
    return tuple(require_si(made(Channel, f"{where}[{i}]", row)) for i, row in enumerate(rows))


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
    except DriverError:
        output.close()
        raise
    return ComposedRig(name, acquisition, output)


def _part(
    name: str, part: str, options: Options, makers: Mapping[str, Callable[..., T]]
) -> Callable[..., T]:
    """The maker that the table `part` names, with the rest of the table as its arguments."""
    where, table = f"rig {name!r}: {part}", options.get(part, {})
    if not isinstance(table, Mapping):
        raise SettingError(f"{where}={table!r} is not a table of options")
    driver = str(table.get("driver"))
    if driver not in makers:
        raise SettingError(f"{where}.driver={driver!r} is not one of {sorted(makers)}")
    rest = {key: value for key, value in table.items() if key != "driver"}
    return functools.partial(made, makers[driver], where, rest)


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


def _operated(where: str, flows: Mapping[str, Options]) -> Around:
    from drivers.operated import FlowSettings, OperatedRig

    settings = {key: made(FlowSettings, f"{where}: {key}", table) for key, table in flows.items()}
    return lambda rig: OperatedRig(rig, {key: one.open() for key, one in settings.items()})


def _interlocked(where: str, interlocks: Mapping[str, Options]) -> Around:
    from drivers.interlock import InterlockedRig, InterlockSettings

    settings = {
        key: made(InterlockSettings, f"{where}: {key}", table) for key, table in interlocks.items()
    }
    return lambda rig: InterlockedRig(rig, {key: one.open() for key, one in settings.items()})


AROUND: dict[str, Callable[[str, Mapping[str, Options]], Around]] = {
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
