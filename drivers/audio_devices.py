"""Sound devices by name and host API, never by a bare index: indices move when a cable does.

PortAudio is a system library, so it is loaded at first use, and its absence is an error that
holds the command which installs it.
"""

from dataclasses import dataclass
from types import ModuleType

from drivers.errors import DeviceNotFound, MissingDependency


@dataclass(frozen=True, slots=True)
class AudioDevice:
    """One entry of PortAudio's list; `index` is valid only until the next rescan."""

    index: int
    name: str
    host_api: str
    inputs: int
    outputs: int
    default_rate_hz: float


def portaudio() -> ModuleType:
    """The sounddevice module, or `MissingDependency` where PortAudio cannot be loaded."""
    try:
        import sounddevice
    except ImportError as error:
        raise MissingDependency("sounddevice missing: pip install sounddevice") from error
    except OSError as error:
        raise MissingDependency(f"{error}: apt install libportaudio2") from error
    module: ModuleType = sounddevice
    return module


def rescan() -> None:
    """Let PortAudio look again for devices; no stream may be open in this process."""
    module = portaudio()
    module._terminate()
    module._initialize()


def audio_devices() -> list[AudioDevice]:
    """Every device that PortAudio lists, in its order."""
    module = portaudio()
    apis = [api["name"] for api in module.query_hostapis()]
    return [
        AudioDevice(
            index=int(entry["index"]),
            name=str(entry["name"]),
            host_api=str(apis[entry["hostapi"]]),
            inputs=int(entry["max_input_channels"]),
            outputs=int(entry["max_output_channels"]),
            default_rate_hz=float(entry["default_samplerate"]),
        )
        for entry in module.query_devices()
    ]


def find_audio_device(
    name: str, host_api: str, *, inputs: int = 0, outputs: int = 0
) -> AudioDevice:
    """The one device of that name and host API with enough channels.

    A name that matches exactly wins; otherwise it may be a part of the name, if of one only.

    Raises
    ------
    DeviceNotFound
        None matches, or several do; the message lists what is there.
    """
    listed = [device for device in audio_devices() if device.host_api == host_api]
    able = [d for d in listed if d.inputs >= inputs and d.outputs >= outputs]
    exact = [device for device in able if device.name == name]
    found = exact or [device for device in able if name.lower() in device.name.lower()]
    if len(found) == 1:
        return found[0]
    need = f"{inputs} input and {outputs} output channels"
    if found:
        names = ", ".join(repr(device.name) for device in found)
        raise DeviceNotFound(f"device={name!r} fits several with {need}: {names}; name one exactly")
    names = ", ".join(f"{d.name!r} ({d.inputs} in, {d.outputs} out)" for d in listed) or "none"
    raise DeviceNotFound(
        f"device={name!r} with {need} not found under host API {host_api!r}; there is: {names}"
    )
