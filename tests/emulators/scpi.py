"""SCPI instruments on a real TCP socket: a signal generator in four dialects, and a scope.

Each answers only to its own spelling, keeps an error queue, clamps to its own limits, and logs
every amplitude with its time. `hang` makes it swallow what it is asked, and a connection on which
it has is never answered again; `drop` closes its connections, as instruments do.
"""

import asyncio
import re
import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

NO_ERROR = '0,"No error"'
IDENTITIES = {
    "keysight": "Agilent Technologies,33522B,MY00000001,3.05-1.19-2.00-52-00",
    "rigol": "Rigol Technologies,DG1032Z,DG1ZA000000001,03.01.12",
    "siglent": "Siglent Technologies,SDG2042X,SDG2XCAX000001,2.01.01.35R3B2",
    "tektronix": "TEKTRONIX,AFG3022C,C000001,SCPI:99.0 FV:1.0.9",
    "generic": "ACME,TONE,1,1.0",
}
# For each maker: frequency, amplitude and output header, and what else it takes without effect.
SPELLING = {
    "keysight": (
        "SOUR1:FREQ",
        "SOUR1:VOLT",
        "OUTP1",
        r"SOUR1:(FUNC|VOLT:UNIT|VOLT:OFFS)|OUTP1:LOAD",
    ),
    "rigol": (
        ":SOUR1:FREQ",
        ":SOUR1:VOLT",
        ":OUTP1",
        r":SOUR1:(FUNC|VOLT:UNIT|VOLT:OFFS)|:OUTP1:LOAD",
    ),
    "tektronix": (
        "SOUR1:FREQ:FIX",
        "SOUR1:VOLT:AMPL",
        "OUTP1:STAT",
        r"SOUR1:(FUNC:SHAP|VOLT:UNIT|VOLT:OFFS)|OUTP1:IMP",
    ),
    "generic": ("FREQ", "VOLT", "OUTP", "FUNC"),
}


class Instrument:
    """Common commands and the error queue."""

    identity = ""

    def __init__(self) -> None:
        self.errors: list[str] = []

    def execute(self, command: str) -> str | bytes | None:
        if command == "*IDN?":
            return self.identity
        if command == "*OPC?":
            return "1"
        if command.lstrip(":") == "SYST:ERR?":
            return self.errors.pop(0) if self.errors else NO_ERROR
        try:
            return self.handle(command)
        except ValueError:
            self.errors.append('-104,"Data type error"')
            return None

    def handle(self, command: str) -> str | bytes | None:
        self.errors.append(f'-113,"Undefined header;{command}"')
        return None


class Generator(Instrument):
    """1 µHz…30 MHz, 2 mVpp…20 Vpp."""

    def __init__(self, maker: str) -> None:
        super().__init__()
        self.maker = maker
        self.identity = IDENTITIES[maker]
        self.frequency_hz, self.peak_to_peak_v, self.on = 1000.0, 5.0, True
        self.log: list[tuple[float, float]] = []
        self.deaf = 0  # how many of the next switchings it loses without an error
        self.misset = 1.0  # a faulty attenuator sets this multiple of what it is told

    def note(self) -> None:
        self.log.append((time.monotonic(), self.peak_to_peak_v / 2 if self.on else 0.0))

    def handle(self, command: str) -> str | bytes | None:
        if self.maker == "siglent":
            return self.siglent(command)
        frequency, amplitude, output, ignored = SPELLING[self.maker]
        if command.startswith(frequency + " "):
            return self.set_frequency(float(command.split()[1]))
        if command.startswith(frequency + "?"):
            return self.ranged(command, self.frequency_hz, 1e-6, 30e6)
        if command.startswith(amplitude + " "):
            return self.set_amplitude(float(command.split()[1]))
        if command.startswith(amplitude + "?"):
            return self.ranged(command, self.peak_to_peak_v, 0.002, 20.0)
        if command in (f"{output} ON", f"{output} OFF"):
            return self.set_output(command.endswith("ON"))
        if command == f"{output}?":
            return ("OFF", "ON")[self.on] if self.maker == "rigol" else f"{self.on:d}"
        if re.match(rf"({ignored}) ", command):
            return None
        return super().handle(command)

    def siglent(self, command: str) -> str | bytes | None:
        if command in ("C1:OUTP ON", "C1:OUTP OFF"):
            return self.set_output(command.endswith("ON"))
        if command == "C1:OUTP?":
            return f"C1:OUTP {('OFF', 'ON')[self.on]},LOAD,HZ,PLRT,NOR"
        if command.startswith("C1:BSWV FRQ,"):
            return self.set_frequency(float(command.partition(",")[2]))
        if command.startswith("C1:BSWV AMP,"):
            return self.set_amplitude(float(command.partition(",")[2]))
        if command == "C1:BSWV?":
            return (
                f"C1:BSWV WVTP,SINE,FRQ,{self.frequency_hz:.12g}HZ,"
                f"PERI,{1 / self.frequency_hz:.6g}S,AMP,{self.peak_to_peak_v:.6g}V,"
                f"AMPVRMS,{self.peak_to_peak_v / 8**0.5:.6g}Vrms,OFST,0V,PHSE,0"
            )
        if command in ("C1:OUTP LOAD,HZ", "C1:BSWV WVTP,SINE", "C1:BSWV OFST,0"):
            return None
        return super().handle(command)

    def ranged(self, command: str, value: float, least: float, most: float) -> str:
        suffix = command.partition("?")[2].strip()
        return f"{ {'': value, 'MIN': least, 'MAX': most}[suffix]:+.12E}"

    def set_frequency(self, value: float) -> None:
        if 1e-6 <= value <= 30e6:
            self.frequency_hz = value
        else:
            self.errors.append('-222,"Data out of range"')

    def set_amplitude(self, value: float) -> None:
        if 0.002 <= value <= 20.0:
            self.peak_to_peak_v = value * self.misset
            self.note()
        else:
            self.errors.append('-222,"Data out of range"')

    def set_output(self, on: bool) -> None:
        if self.deaf:
            self.deaf -= 1
            return
        self.on = on
        self.note()


class Scope(Instrument):
    """Two channels; channel 1 carries a 100 Hz sine of 1 V, channel 2 its inverse at 0.5 V."""

    identity = "KEYSIGHT TECHNOLOGIES,DSOX3024T,MY00000001,07.30"
    scale = 4.0 / 32768  # ±4 V

    def __init__(self) -> None:
        super().__init__()
        self.range_s, self.points, self.source = 1.0, 1000, 1
        self.short = False  # sends one point too few

    def handle(self, command: str) -> str | bytes | None:
        header, _, value = command.partition(" ")
        if header == ":TIM:RANG":
            self.range_s = float(value)
        elif header == ":WAV:POIN":
            self.points = int(value)
        elif header == ":WAV:SOUR":
            self.source = int(value.removeprefix("CHAN"))
        elif command == ":ACQ:SRAT?":
            return f"{self.points / self.range_s:.9E}" if self.points != 1000 else "1.0E+3"
        elif command == ":WAV:PRE?":
            step = self.range_s / self.points
            return f"1,0,{self.points},1,{step:.9E},0,0,{self.scale:.12E},0.0,0"
        elif command == ":WAV:DATA?":
            n = np.arange(self.points - self.short)
            gain = 1.0 if self.source == 1 else -0.5
            volts = gain * np.sin(2 * np.pi * 100.0 * n * self.range_s / self.points)
            data = np.round(volts / self.scale).astype("<i2").tobytes()
            return f"#8{len(data):08d}".encode() + data
        elif not re.match(r":(STOP|ACQ:TYPE|CHAN\d:|WAV:(FORM|BYT|UNS|POIN:MODE)|DIG )", command):
            return super().handle(command)
        return None


class ScpiServer:
    """Serves one instrument on 127.0.0.1 from a thread of its own."""

    def __init__(self, instrument: Instrument) -> None:
        self.instrument = instrument
        self.hang = False
        self.connections = 0
        self.port = 0
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._ready = threading.Event()
        self._stop: asyncio.Event | None = None

    @property
    def address(self) -> str:
        return f"TCPIP::127.0.0.1::{self.port}::SOCKET"

    def drop(self) -> None:
        """Close every connection, as a power cut does."""

        def close() -> None:
            for writer in list(self._writers):
                writer.transport.abort()

        self._loop.call_soon_threadsafe(close)

    def _serve(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._main())
        self._loop.close()

    async def _main(self) -> None:
        self._stop = asyncio.Event()
        server = await asyncio.start_server(self._talk, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        await self._stop.wait()
        server.close()
        for writer in list(self._writers):
            writer.transport.abort()
        await asyncio.sleep(0.01)

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.add(writer)
        swallowed = False
        try:
            while line := await reader.readline():
                swallowed |= self.hang
                if swallowed:
                    continue
                answer = self.instrument.execute(line.decode("ascii").strip())
                if answer is not None:
                    writer.write((answer.encode() if isinstance(answer, str) else answer) + b"\n")
                    await writer.drain()
        except ConnectionError:
            pass
        finally:
            self._writers.discard(writer)
            writer.close()

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait(5.0)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        assert self._stop is not None
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(5.0)
