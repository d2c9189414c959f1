"""What is plugged in: every family of devices, each on its own, so that one absent hides none.

Each family is searched in a process of its own, under a time limit: a sound server that no longer
answers must not hold up whoever asks. Listing opens no stream and changes no setting. The VISA
search asks the local network who is there (VXI-11 broadcast), which takes a second or two.
"""

import functools
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from drivers.audio_devices import audio_devices
from drivers.elsewhere import elsewhere
from drivers.ni_library import daqmx
from drivers.serialport import pyserial
from drivers.visa_link import resource_manager

SEARCH_S = 15.0  # a fresh interpreter, the vendor's library, a search that asks the network


@dataclass(frozen=True)
class DeviceInfo:
    """One device, or one family that cannot be looked at (`missing` says what to install).

    `address` is what the family's driver takes to open it.
    """

    family: str
    name: str
    address: str = ""
    capabilities: dict[str, str] = field(default_factory=dict)
    missing: str | None = None


def discover() -> list[DeviceInfo]:
    """Every device of every family; never raises.

    A family without devices is simply not listed; a family whose library or driver is absent, or
    whose search fails, is listed once with `missing`.
    """
    found: list[DeviceInfo] = []
    for family, search in FAMILIES.items():
        try:
            found += elsewhere(functools.partial(_listed, search), SEARCH_S, family)
        except Exception as error:
            text = str(error).strip() or type(error).__name__
            found.append(DeviceInfo(family, family, missing=text))
    return found


def _listed(search: "Search") -> list[DeviceInfo]:
    return list(search())


def _sound_cards() -> Iterable[DeviceInfo]:
    for device in audio_devices():
        yield DeviceInfo(
            "sound card",
            device.name,
            address=f"{device.host_api}: {device.name}",
            capabilities={
                "inputs": str(device.inputs),
                "outputs": str(device.outputs),
                "default_rate_hz": f"{device.default_rate_hz:g}",
                "host_api": device.host_api,
                "duplex": "yes" if device.inputs and device.outputs else "no",
            },
        )


def _visa() -> Iterable[DeviceInfo]:
    manager = resource_manager()
    try:
        # PyVISA-py warns of every optional package that it could search further with, and
        # leaves its search's sockets to the garbage collector.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            addresses = manager.list_resources("?*")
    finally:
        manager.close()
    for address in addresses:
        interface = address.split("::")[0]
        if "ASRL" not in interface:  # serial ports are listed as such
            yield DeviceInfo("visa", address, address, {"interface": interface})


def _serial_ports() -> Iterable[DeviceInfo]:
    pyserial()
    from serial.tools import list_ports

    for port in list_ports.comports():
        known = {
            "description": port.description,
            "manufacturer": port.manufacturer,
            "serial_number": port.serial_number,
            "usb_id": f"{port.vid:04x}:{port.pid:04x}" if port.vid is not None else None,
        }
        capabilities = {key: str(value) for key, value in known.items() if value}
        yield DeviceInfo("serial", port.device, port.device, capabilities)


def _national_instruments() -> Iterable[DeviceInfo]:
    for device in daqmx().devices():
        simultaneous = bool(device.ai_simultaneous_sampling_supported)
        yield DeviceInfo(
            "ni",
            f"{device.product_type} {device.name}",
            device.name,
            {
                "inputs": str(len(device.ai_physical_chans)),
                "outputs": str(len(device.ao_physical_chans)),
                "serial_number": f"{device.serial_num:X}",
                "simultaneous": "yes" if simultaneous else "no: channels are multiplexed",
            },
        )


Search = Callable[[], Iterable[DeviceInfo]]
FAMILIES: dict[str, Search] = {
    "sound card": _sound_cards,
    "visa": _visa,
    "serial": _serial_ports,
    "ni": _national_instruments,
}
