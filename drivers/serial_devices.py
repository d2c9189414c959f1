"""Generators, amplifiers and mass-flow controllers that talk in lines.

Generator and amplifier protocol: one command a line, answered by ``OK value`` (what was set) or
``ERR text``. It is what a microcontroller sketch of a few lines offers; makers' own protocols are
other `commands`.

    FREQ 170.0 → OK 170.000      AMPL 0.5 → OK 0.500 (volts peak)      OFF → OK
    GAIN -6.0  → OK -6.00 (dB)   MUTE 1   → OK 1                       TEMP → OK 41.5 (°C)

Mass-flow controllers: the ASCII protocol of Alicat's devices (Serial Primer): ``A`` polls unit A,
``AS 0.5`` sets its set point, both answered by one line of values.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drivers.errors import DeviceFault, SettingError
from drivers.serialport import SerialPort
from drivers.types import require

PSI_PA = 6894.757293168  # exact pound-force per square inch (NIST SP 811)
LITRE_PER_MINUTE = 1e-3 / 60.0  # m³/s
CELSIUS_ZERO_K = 273.15


def ask_value(port: SerialPort, command: str) -> float | None:
    """The number after ``OK``, `None` if there is none; `DeviceFault` for anything else."""
    answer = port.ask(command)
    word, _, rest = answer.partition(" ")
    if word != "OK":
        raise DeviceFault(f"{port.address}: {command!r} was answered by {answer!r}")
    try:
        return float(rest) if rest.strip() else None
    except ValueError as error:
        raise DeviceFault(f"{port.address}: {command!r} was answered by {answer!r}") from error


def set_value(port: SerialPort, command: str, value: float) -> float:
    """Set and read back."""
    reached = ask_value(port, f"{command} {value:.6f}")
    if reached is None:
        raise DeviceFault(f"{port.address}: {command!r} was not read back")
    return reached


GENERATOR = {"frequency": "FREQ", "amplitude": "AMPL", "off": "OFF"}
AMPLIFIER = {"gain": "GAIN", "mute": "MUTE", "temperature": "TEMP"}


class SerialGenerator:
    """A `ToneDevice` for `SteppedOutput`."""

    def __init__(self, port: SerialPort, commands: Mapping[str, str] | None = None) -> None:
        self._port = port
        self._commands = commands or GENERATOR

    def set_frequency(self, frequency_hz: float) -> float:
        return set_value(self._port, self._commands["frequency"], frequency_hz)

    def set_amplitude(self, amplitude_v: float) -> float:
        if amplitude_v <= 0.0:
            ask_value(self._port, self._commands["off"])
            return 0.0
        return set_value(self._port, self._commands["amplitude"], amplitude_v)

    def close(self) -> None:
        self._port.close()


class SerialAmplifier:
    """Gain, mute and temperature of a power amplifier; muted when opened and when closed."""

    def __init__(
        self,
        port: SerialPort,
        max_gain_db: float,
        commands: Mapping[str, str] | None = None,
    ) -> None:
        self._port = port
        self._max_gain_db = max_gain_db
        self._commands = commands or AMPLIFIER
        self.mute(True)

    def set_gain(self, gain_db: float) -> float:
        """Returns the gain read back; `SettingError` above `max_gain_db`."""
        require(gain_db <= self._max_gain_db, "gain_db", gain_db, f"at most {self._max_gain_db} dB")
        reached = set_value(self._port, self._commands["gain"], gain_db)
        if reached > self._max_gain_db + 0.05:
            self.mute(True)
            raise DeviceFault(f"{self._port.address}: gain_db={gain_db} was set as {reached}")
        return reached

    def mute(self, muted: bool) -> None:
        """Raises `DeviceFault` when the amplifier does not confirm."""
        if set_value(self._port, self._commands["mute"], float(muted)) != float(muted):
            raise DeviceFault(f"{self._port.address}: mute={muted} was not confirmed")

    def temperature_k(self) -> float:
        celsius = ask_value(self._port, self._commands["temperature"])
        if celsius is None:
            raise DeviceFault(f"{self._port.address}: no temperature in the answer")
        return celsius + CELSIUS_ZERO_K

    def close(self) -> None:
        self.mute(True)
        self._port.close()


@dataclass(frozen=True)
class FlowReading:
    """One poll; flows at the controller's standard conditions, its set point likewise."""

    pressure_pa: float
    temperature_k: float
    flow_m3_per_s: float
    set_point_m3_per_s: float
    gas: str
    status: tuple[str, ...] = field(default=())

    def attributes(self, prefix: str) -> dict[str, float | str]:
        """What a run keeps of its operating point, named ``prefix_quantity_unit``."""
        return {
            f"{prefix}_pressure_pa": self.pressure_pa,
            f"{prefix}_temperature_k": self.temperature_k,
            f"{prefix}_flow_m3_per_s": self.flow_m3_per_s,
            f"{prefix}_set_point_m3_per_s": self.set_point_m3_per_s,
            f"{prefix}_gas": self.gas,
        }


class MassFlowController:
    """One unit of an Alicat bus; units as delivered: psia, °C, standard litres a minute."""

    def __init__(self, port: SerialPort, unit: str = "A", max_slpm: float = 100.0) -> None:
        require(len(unit) == 1 and unit.isalpha(), "unit", unit, "one letter")
        self._port = port
        self._unit = unit.upper()
        self.max_slpm = max_slpm

    def reading(self) -> FlowReading:
        return self._parse(self._port.ask(self._unit, end=b"\r"))

    def set_flow(self, flow_m3_per_s: float) -> FlowReading:
        """Set point in m³/s at standard conditions; `DeviceFault` when not taken over."""
        slpm = flow_m3_per_s / LITRE_PER_MINUTE
        if not 0.0 <= slpm <= self.max_slpm:
            raise SettingError(
                f"flow_m3_per_s={flow_m3_per_s} is not within 0...{self.max_slpm} slpm"
            )
        reading = self._parse(self._port.ask(f"{self._unit}S {slpm:.3f}", end=b"\r"))
        if abs(reading.set_point_m3_per_s - flow_m3_per_s) > 0.01 * LITRE_PER_MINUTE:
            raise DeviceFault(
                f"{self._port.address}: flow_m3_per_s={flow_m3_per_s} "
                f"was set as {reading.set_point_m3_per_s}"
            )
        return reading

    def close(self) -> None:
        """Release the port; the flow stays as it is."""
        self._port.close()

    def _parse(self, line: str) -> FlowReading:
        """``A +014.70 +025.00 +00.50 +00.50 00.50 Air``: volume flow stands before mass flow."""
        fields = line.split()
        try:
            if fields[0] != self._unit:
                raise ValueError(f"unit {fields[0]} answered")
            pressure, celsius, _, mass, set_point = (float(text) for text in fields[1:6])
            gas = fields[6]
        except (ValueError, IndexError) as error:
            raise DeviceFault(f"{self._port.address}: cannot read {line!r}: {error}") from error
        return FlowReading(
            pressure_pa=pressure * PSI_PA,
            temperature_k=celsius + CELSIUS_ZERO_K,
            flow_m3_per_s=mass * LITRE_PER_MINUTE,
            set_point_m3_per_s=set_point * LITRE_PER_MINUTE,
            gas=gas,
            status=tuple(fields[7:]),
        )
