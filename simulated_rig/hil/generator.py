"""A signal generator: one sine output, its SCPI commands, and the volts that it puts out.

1 mHz…100 kHz, 2 mVpp…20 Vpp into a high impedance (half into 50 Ω), 16 bit. What the display says
and what is on the terminals differ as on the real thing: amplitudes are peak to peak, and with the
load set to 50 Ω an open terminal carries twice what was asked for, as the output has 50 Ω itself.
Frequency changes keep the phase; amplitude changes are steps.

The commands run in the server's thread, `render` in the plant's: what they share is one immutable
`Output`, replaced as a whole.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from drivers.oscillator import Oscillator, advance, retune
from drivers.types import FloatArray
from simulated_rig.hil.scpi import Instrument, Number, ScpiError, boolean

LEAST_HZ, MOST_HZ = 1e-3, 100e3
LEAST_VPP, MOST_VPP = 2e-3, 20.0
FREQUENCY = Number(LEAST_HZ, MOST_HZ, {"HZ": 1.0, "KHZ": 1e3, "UHZ": 1e-6, "MHZ": 1e6})
RMS = 2 * math.sqrt(2.0)  # peak to peak over rms, of a sine
STEP_V_PER_S = 1e9


@dataclass(frozen=True)
class Output:
    """What is set; `amplitude_vpp` and `offset_v` into `load_ohm` (None: high impedance)."""

    frequency_hz: float = 1000.0
    amplitude_vpp: float = 0.1
    offset_v: float = 0.0
    load_ohm: float | None = None
    on: bool = False
    unit: str = "VPP"

    @property
    def ceiling_v(self) -> float:
        """Peak that the output can give into the load."""
        return MOST_VPP / 2 * (0.5 if self.load_ohm == 50.0 else 1.0)


class Generator(Instrument):
    """`render` gives what the terminals carry, open.

    `interlock` returns why the output may not be switched on, or None.
    """

    identity = "entrain,HIL generator,0,1.0"

    def __init__(self, interlock: Callable[[], str | None] = lambda: None) -> None:
        super().__init__()
        self.output = Output()
        self._interlock = interlock
        self._oscillator = Oscillator()
        self.add("[SOURce[1]:]FREQuency[:CW]", self._frequency)
        self.add("[SOURce[1]:]FREQuency:FIXed", self._frequency)
        self.add("[SOURce[1]:]VOLTage[:AMPLitude]", self._amplitude)
        self.add("[SOURce[1]:]VOLTage:OFFSet", self._offset)
        self.add("[SOURce[1]:]VOLTage:UNIT", self._unit)
        self.add("[SOURce[1]:]FUNCtion[:SHAPe]", self._function)
        self.add("[SOURce[1]:]APPLy:SINusoid", self._apply, "!")
        self.add("OUTPut[1][:STATe]", self._switch)
        self.add("OUTPut[1]:LOAD", self._load)

    def reset(self) -> None:
        self.output = Output()

    def render(self, frames: int, rate_hz: float) -> FloatArray:
        """The next frames, in volts."""
        out = self.output
        twice = 2.0 if out.load_ohm == 50.0 else 1.0
        target = out.amplitude_vpp / 2 * twice if out.on else 0.0
        state = self._oscillator
        if state.target_v != target or state.frequency_hz != out.frequency_hz:
            state = retune(
                state,
                rate_hz,
                target_v=target,
                slew_v_per_s=STEP_V_PER_S,
                frequency_hz=out.frequency_hz,
            )
        self._oscillator, volts = advance(state, frames, rate_hz)
        return volts + out.offset_v * twice if out.on else volts

    def _volts(self, least: float = LEAST_VPP) -> Number:
        half = 0.5 if self.output.load_ohm == 50.0 else 1.0
        units = {"VPP": 1.0, "MVPP": 1e-3, "VRMS": RMS, "MVRMS": 1e-3 * RMS, "V": 1.0, "MV": 1e-3}
        return Number(least * half, MOST_VPP * half, units)

    def _scale(self, out: Output) -> float:
        return RMS if out.unit == "VRMS" else 1.0

    def _set(self, out: Output) -> None:
        """Take over, unless amplitude and offset together leave the output's range."""
        if out.amplitude_vpp / 2 + abs(out.offset_v) > out.ceiling_v * (1 + 1e-9):
            raise ScpiError(-221, f"amplitude/2 + offset exceeds {out.ceiling_v:g} V")
        self.output = out

    def _frequency(self, parameters: str, query: bool) -> str | None:
        if query:
            asked = FREQUENCY.parsed(parameters) if parameters else self.output.frequency_hz
            return f"{asked:+.9E}"
        self._set(replace(self.output, frequency_hz=FREQUENCY.parsed(_needed(parameters))))
        return None

    def _amplitude(self, parameters: str, query: bool) -> str | None:
        number, scale = self._volts(), self._scale(self.output)
        if query:
            value = number.parsed(parameters) if parameters else self.output.amplitude_vpp
            return f"{value / scale:+.9E}"
        text = _needed(parameters)
        if scale != 1.0 and text[-1:].isdigit():
            text += "VRMS"
        self._set(replace(self.output, amplitude_vpp=number.parsed(text)))
        return None

    def _offset(self, parameters: str, query: bool) -> str | None:
        if query:
            return f"{self.output.offset_v:+.9E}"
        ceiling = self.output.ceiling_v
        number = Number(-ceiling, ceiling, {"V": 1.0, "MV": 1e-3})
        self._set(replace(self.output, offset_v=number.parsed(_needed(parameters))))
        return None

    def _unit(self, parameters: str, query: bool) -> str | None:
        if query:
            return self.output.unit
        unit = _needed(parameters).upper()
        if unit not in ("VPP", "VRMS"):
            raise ScpiError(-224, unit)
        self._set(replace(self.output, unit=unit))
        return None

    def _function(self, parameters: str, query: bool) -> str | None:
        if query:
            return "SIN"
        if _needed(parameters).upper() not in ("SIN", "SINUSOID"):
            raise ScpiError(-224, f"{parameters}: this generator makes sines")
        return None

    def _apply(self, parameters: str, query: bool) -> str | None:
        parts = [part.strip() for part in parameters.split(",")] if parameters.strip() else []
        if len(parts) > 3:
            raise ScpiError(-108, parts[3])
        new = self.output
        if parts:
            new = replace(new, frequency_hz=FREQUENCY.parsed(parts[0]))
        if len(parts) > 1:
            new = replace(new, amplitude_vpp=self._volts().parsed(parts[1]))
        if len(parts) > 2:
            number = Number(-new.ceiling_v, new.ceiling_v, {"V": 1.0})
            new = replace(new, offset_v=number.parsed(parts[2]))
        self._allowed()
        self._set(replace(new, on=True))
        return None

    def _switch(self, parameters: str, query: bool) -> str | None:
        if query:
            return str(int(self.output.on))
        on = boolean(_needed(parameters))
        if on:
            self._allowed()
        self._set(replace(self.output, on=on))
        return None

    def _allowed(self) -> None:
        reason = self._interlock()
        if reason is not None:
            raise ScpiError(-200, f"output disabled: {reason}")

    def _load(self, parameters: str, query: bool) -> str | None:
        """The numbers on the display change with the load, the terminals do not."""
        if query:
            return "+5.0E+01" if self.output.load_ohm == 50.0 else "+9.9E+37"
        word = _needed(parameters).upper()
        if word in ("INF", "INFINITY", "MAX"):
            load = None
        elif Number(1.0, 1e4, {"OHM": 1.0}).parsed(word) == 50.0:
            load = 50.0
        else:
            raise ScpiError(-224, f"{word}: 50 or INF")
        old = self.output
        factor = {(None, 50.0): 0.5, (50.0, None): 2.0}.get((old.load_ohm, load), 1.0)
        self._set(
            replace(
                old,
                load_ohm=load,
                amplitude_vpp=old.amplitude_vpp * factor,
                offset_v=old.offset_v * factor,
            )
        )
        return None


def _needed(parameters: str) -> str:
    if not parameters.strip():
        raise ScpiError(-109)
    return parameters.strip()
