"""A rig with mass-flow controllers: its operating point is their flows.

A controller named ``air`` gives the quantity ``air_flow_m3_per_s`` (at the controller's standard
conditions). Whatever is set is read back, and every run's notes hold each controller's reading.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.errors import SettingError
from drivers.protocols import DuplexRig
from drivers.serial_devices import LITRE_PER_MINUTE, MassFlowController
from drivers.serialport import SerialPort
from drivers.wrapped import WrappedRig

QUANTITY = "_flow_m3_per_s"


@dataclass(frozen=True)
class FlowSettings:
    """Where a controller is; `max_slpm` in standard litres a minute."""

    address: str
    unit: str = "A"
    max_slpm: float = 100.0
    baud: int = 19200

    def open(self) -> MassFlowController:
        """Raises `DeviceLost` when the port is not there."""
        return MassFlowController(SerialPort(self.address, self.baud), self.unit, self.max_slpm)


class OperatedRig(WrappedRig):
    """`inner` and the controllers of its flows, by name; closes both."""

    def __init__(self, inner: DuplexRig, flows: Mapping[str, MassFlowController]) -> None:
        super().__init__(inner)
        self._flows = dict(flows)

    def operating_ranges(self) -> Mapping[str, tuple[float, float]]:
        """The flows that the controllers can set."""
        return {
            name + QUANTITY: (0.0, flow.max_slpm * LITRE_PER_MINUTE)
            for name, flow in self._flows.items()
        }

    def operate(self, values: Mapping[str, float]) -> Mapping[str, float]:
        """Set flows; what every controller reads back. Raises `SettingError`, `DeviceFault`."""
        unknown = [name for name in values if name not in self.operating_ranges()]
        if unknown:
            raise SettingError(
                f"quantity={unknown[0]!r} is not one of {list(self.operating_ranges())}"
            )
        for quantity, value in values.items():
            self._flows[quantity.removesuffix(QUANTITY)].set_flow(value)
        return {name + QUANTITY: flow.reading().flow_m3_per_s for name, flow in self._flows.items()}

    def run_notes(self) -> dict[str, Any]:
        """Pressure, temperature, flow and set point of each controller as a run begins."""
        said: dict[str, Any] = {}
        for name, flow in self._flows.items():
            said |= flow.reading().attributes(name)
        return said

    def close(self) -> None:
        """The flows stay as they are: shutting them is the laboratory's decision."""
        self.inner.close()
        for flow in self._flows.values():
            flow.close()
