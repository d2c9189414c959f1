"""How the makers of signal generators spell the same few settings.

A dialect is data: command templates with `{n}` for the output's number, `{x}` for the value.
Amplitudes go out as peak-to-peak volts into a high-impedance load (the front panel's "High Z"),
that is twice our amplitude; into the power amplifier's input this is what arrives.

Sources: the programming guides of Keysight 33500/33600 and 33210A/33220A, Rigol DG800/DG1000Z,
Siglent SDG1000X/2000X, Tektronix AFG1000/3000/31000. Checked against our emulator only; the
real instruments have not been at hand.
"""

import re
from dataclasses import dataclass


@dataclass(frozen=True)
class Dialect:
    """Templates; a query's number is the first that `pattern` finds in its answer."""

    name: str
    identity: str  # regular expression against *IDN?
    prepare: tuple[str, ...]
    set_frequency: str
    get_frequency: str
    set_amplitude: str
    get_amplitude: str
    output_on: str
    output_off: str
    get_output: str
    error_query: str = "SYST:ERR?"
    frequency_pattern: str = r"([-+0-9.eE]+)"
    amplitude_pattern: str = r"([-+0-9.eE]+)"
    output_pattern: str = r"\b(ON|OFF|[01])\b"
    frequency_range: tuple[str, str] | None = None
    amplitude_range: tuple[str, str] | None = None

    def number(self, pattern: str, answer: str) -> float:
        """Raises `ValueError` when the answer holds no such number."""
        found = re.search(pattern, answer)
        if found is None:
            raise ValueError(f"no number like {pattern!r} in {answer!r}")
        return float(found.group(1))

    def is_on(self, answer: str) -> bool:
        """What `get_output` was answered. Raises `ValueError` when it says neither on nor off."""
        found = re.search(self.output_pattern, answer, re.IGNORECASE)
        if found is None:
            raise ValueError(f"neither on nor off in {answer!r}")
        return found.group(1).upper() in ("ON", "1")


KEYSIGHT = Dialect(
    name="keysight",
    identity=r"(Agilent|Keysight|Hewlett).*,\s*(EDU)?33\d{3}",
    prepare=(
        "SOUR{n}:FUNC SIN",
        "OUTP{n}:LOAD INF",
        "SOUR{n}:VOLT:UNIT VPP",
        "SOUR{n}:VOLT:OFFS 0",
    ),
    set_frequency="SOUR{n}:FREQ {x}",
    get_frequency="SOUR{n}:FREQ?",
    set_amplitude="SOUR{n}:VOLT {x}",
    get_amplitude="SOUR{n}:VOLT?",
    output_on="OUTP{n} ON",
    output_off="OUTP{n} OFF",
    get_output="OUTP{n}?",
    frequency_range=("SOUR{n}:FREQ? MIN", "SOUR{n}:FREQ? MAX"),
    amplitude_range=("SOUR{n}:VOLT? MIN", "SOUR{n}:VOLT? MAX"),
)
RIGOL = Dialect(
    name="rigol",
    identity=r"Rigol.*,\s*DG\d",
    prepare=(
        ":SOUR{n}:FUNC SIN",
        ":OUTP{n}:LOAD INF",
        ":SOUR{n}:VOLT:UNIT VPP",
        ":SOUR{n}:VOLT:OFFS 0",
    ),
    set_frequency=":SOUR{n}:FREQ {x}",
    get_frequency=":SOUR{n}:FREQ?",
    set_amplitude=":SOUR{n}:VOLT {x}",
    get_amplitude=":SOUR{n}:VOLT?",
    output_on=":OUTP{n} ON",
    output_off=":OUTP{n} OFF",
    get_output=":OUTP{n}?",
    error_query=":SYST:ERR?",
    frequency_range=(":SOUR{n}:FREQ? MIN", ":SOUR{n}:FREQ? MAX"),
    amplitude_range=(":SOUR{n}:VOLT? MIN", ":SOUR{n}:VOLT? MAX"),
)
SIGLENT = Dialect(
    name="siglent",
    identity=r"Siglent.*,\s*SDG\d",
    prepare=("C{n}:OUTP LOAD,HZ", "C{n}:BSWV WVTP,SINE", "C{n}:BSWV OFST,0"),
    set_frequency="C{n}:BSWV FRQ,{x}",
    get_frequency="C{n}:BSWV?",
    set_amplitude="C{n}:BSWV AMP,{x}",
    get_amplitude="C{n}:BSWV?",
    output_on="C{n}:OUTP ON",
    output_off="C{n}:OUTP OFF",
    get_output="C{n}:OUTP?",
    frequency_pattern=r"FRQ,([-+0-9.eE]+)",
    amplitude_pattern=r"\bAMP,([-+0-9.eE]+)",
    output_pattern=r"\bOUTP (ON|OFF)\b",
    # The instrument has no query for its limits; the rig's own hold.
)
TEKTRONIX = Dialect(
    name="tektronix",
    identity=r"Tektronix.*,\s*AFG\d",
    prepare=(
        "SOUR{n}:FUNC:SHAP SIN",
        "OUTP{n}:IMP INF",
        "SOUR{n}:VOLT:UNIT VPP",
        "SOUR{n}:VOLT:OFFS 0",
    ),
    set_frequency="SOUR{n}:FREQ:FIX {x}",
    get_frequency="SOUR{n}:FREQ:FIX?",
    set_amplitude="SOUR{n}:VOLT:AMPL {x}",
    get_amplitude="SOUR{n}:VOLT:AMPL?",
    output_on="OUTP{n}:STAT ON",
    output_off="OUTP{n}:STAT OFF",
    get_output="OUTP{n}:STAT?",
    frequency_range=("SOUR{n}:FREQ:FIX? MIN", "SOUR{n}:FREQ:FIX? MAX"),
    amplitude_range=("SOUR{n}:VOLT:AMPL? MIN", "SOUR{n}:VOLT:AMPL? MAX"),
)
GENERIC = Dialect(
    name="generic",
    identity=r"",
    prepare=("FUNC SIN",),
    set_frequency="FREQ {x}",
    get_frequency="FREQ?",
    set_amplitude="VOLT {x}",
    get_amplitude="VOLT?",
    output_on="OUTP ON",
    output_off="OUTP OFF",
    get_output="OUTP?",
)
DIALECTS = (KEYSIGHT, RIGOL, SIGLENT, TEKTRONIX, GENERIC)


def dialect_for(identity: str) -> Dialect:
    """The first dialect that the answer to ``*IDN?`` fits; the generic one fits all."""
    return next(d for d in DIALECTS if re.search(d.identity, identity, re.IGNORECASE))
