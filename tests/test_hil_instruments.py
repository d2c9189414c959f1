"""The simulated instruments: spelled as SCPI demands, refusing as instruments do, through our own
drivers over a real TCP port and real serial terminals."""

import math
import socket
import time

import numpy as np
import pytest

from drivers.errors import DeviceFault, DriverError, InterlockOpen
from drivers.serial_devices import SerialAmplifier
from drivers.serialport import SerialPort
from drivers.types import OutputLimits, Tone
from drivers.visa_generator import open_generator
from simulated_rig.hil.amplifier import Amplifier, AmplifierSettings
from simulated_rig.hil.generator import Generator
from simulated_rig.hil.ports import LineTerminal, ScpiServer

RATE_HZ = 48000.0


def said(generator: Generator, *lines: str) -> list[str | None]:
    return [generator.message(line.encode()) for line in lines]


class TestScpi:
    @pytest.mark.parametrize(
        "line",
        [
            "FREQ 170",
            "freq 170",
            ":FREQUENCY 170",
            "SOUR:FREQ:CW 170",
            "SOURCE1:FREQUENCY:FIX 1.7E2",
            "FREQ 0.17 KHZ",
            "FREQ 170;",
            "OUTP OFF;FREQ 170",
            "SOUR1:VOLT 1;FREQ 170",
            "SOUR1:VOLT:OFFS 0;:SOUR1:FREQ 170",
            "*CLS;FREQ 170\r",
        ],
    )
    def test_every_spelling_sets_the_frequency(self, line: str) -> None:
        generator = Generator()
        assert said(generator, line, "FREQ?", "SYST:ERR?")[1:] == [
            "+1.700000000E+02",
            '0,"No error"',
        ]

    @pytest.mark.parametrize(
        ("line", "number"),
        [
            ("FREQ 1e6", -222),
            ("FREQ -1", -222),
            ("FREQ abc", -104),
            ("FREQ nan", -104),
            ("FREQ inf", -104),
            ("FREQ 5 V", -131),
            ("FREQ", -109),
            ("FREQU 5", -113),
            ("SOUR2:FREQ 5", -113),
            ("SOUR1:FREQ:VOLT 5", -113),
            ("*RST?", -113),
            ("FREQ@5", -102),
            ("VOLT 30", -222),
            ("VOLT 1e-4", -222),
            ("VOLT 20;:VOLT:OFFS 1", -221),
            ("FUNC SQU", -224),
            ("OUTP 2", -224),
            ("OUTP:LOAD 75", -224),
            ("APPL:SIN 170,1,0,4", -108),
            ("*ESE 256", -222),
            ("FREQ " + 2000 * "1", -363),
        ],
    )
    def test_every_mistake_is_queued_and_changes_nothing(self, line: str, number: int) -> None:
        generator = Generator()
        generator.message(b"VOLT 20;FREQ 100")
        before = generator.output
        assert generator.message(line.encode()) is None
        error = generator.message(b"SYST:ERR?")
        assert error is not None
        assert error.startswith(f"{number},")
        assert generator.output == before
        assert generator.message(b"SYST:ERR?") == '0,"No error"'

    def test_bytes_that_are_no_text_are_refused(self) -> None:
        generator = Generator()
        assert generator.message(b"FREQ 1\xff7") is None
        assert said(generator, "SYST:ERR?") == ['-101,"Invalid character"']

    def test_a_full_queue_says_so_in_its_last_place(self) -> None:
        generator = Generator()
        for _ in range(40):
            generator.message(b"NONSENSE")
        errors = [said(generator, "SYST:ERR?")[0] for _ in range(17)]
        assert errors[15] == '-350,"Queue overflow"'
        assert errors[16] == '0,"No error"'

    def test_a_broken_header_ends_its_message(self) -> None:
        generator = Generator()
        generator.message(b"NONSENSE;FREQ 170")
        assert generator.output.frequency_hz == 1000.0

    def test_status_registers(self) -> None:
        """IEEE 488.2: execution error bit 4, summary bits 2 and 5 of the status byte, 6 with SRE;
        ESR is emptied by reading."""
        generator = Generator()
        said(generator, "*CLS", "*ESE 16", "*SRE 32", "FREQ 1e9")
        assert said(generator, "*STB?", "*ESR?", "*ESR?", "*STB?") == ["100", "16", "0", "4"]

    def test_the_load_changes_the_display_not_the_terminals(self) -> None:
        """2 Vpp set at 50 Ω are 2 V peak at an open terminal, and read 4 Vpp at high impedance."""
        generator = Generator()
        said(generator, "OUTP:LOAD 50", "VOLT 2", "FREQ 1000", "OUTP ON")
        peak = np.max(np.abs(generator.render(480, RATE_HZ)))
        assert peak == pytest.approx(2.0, rel=1e-3)
        assert said(generator, "OUTP:LOAD INF", "VOLT?") == [None, "+4.000000000E+00"]
        assert np.max(np.abs(generator.render(480, RATE_HZ))) == pytest.approx(2.0, rel=1e-3)

    def test_units_of_amplitude(self) -> None:
        generator = Generator()
        said(generator, "VOLT 1 VRMS")
        assert generator.output.amplitude_vpp == pytest.approx(2 * math.sqrt(2))
        assert said(generator, "VOLT:UNIT VRMS", "VOLT?") == [None, "+1.000000000E+00"]

    def test_a_new_frequency_keeps_the_phase(self) -> None:
        generator = Generator()
        said(generator, "APPL:SIN 170, 2, 0")
        first = generator.render(1001, RATE_HZ)
        said(generator, "FREQ 340")
        second = generator.render(100, RATE_HZ)
        largest = 2 * math.pi * 340 / RATE_HZ  # slope of a 1 V sine, a frame
        assert np.max(np.abs(np.diff(np.concatenate([first[-1:], second])))) <= largest

    def test_a_fault_of_the_plant_forbids_output(self) -> None:
        generator = Generator(lambda: "overload: 8 blocks in a row")
        said(generator, "OUTP ON")
        error = said(generator, "SYST:ERR?")[0]
        assert error is not None
        assert error.startswith('-200,"Execution error; output disabled: overload')
        assert not generator.output.on


class TestOverTcp:
    def test_our_visa_driver_drives_it(self) -> None:
        generator = Generator()
        limits = OutputLimits(1.0, max_slew_v_per_s=1e4)
        with ScpiServer(generator) as server:
            output = open_generator(server.address, limits)
            try:
                output.drive(Tone(171.0, 0.5))
                deadline = time.monotonic() + 10.0
                while generator.output.amplitude_vpp != 1.0 or not generator.output.on:
                    assert time.monotonic() < deadline, output.fault
                    time.sleep(0.005)
                assert generator.output.frequency_hz == 171.0
                output.emergency_stop("test")
                assert output.settle(10.0)
                assert not generator.output.on
                with pytest.raises(InterlockOpen):
                    output.drive(Tone(171.0, 0.5))
            finally:
                output.close()

    def test_overrun_lines_are_refused_and_the_connection_lives(self) -> None:
        with (
            ScpiServer(Generator()) as server,
            socket.create_connection((server.host, server.port), timeout=5.0) as wire,
        ):
            wire.sendall(b"FREQ " + 100_000 * b"1" + b"\nSYST:ERR?\n*IDN?\n")
            answer = b""
            while answer.count(b"\n") < 2:
                answer += wire.recv(4096)
        assert answer.startswith(b'-363,"Input buffer overrun"\nentrain,HIL generator')

    def test_a_port_in_use_is_named(self) -> None:
        with ScpiServer(Generator()) as server:
            port = server.port
            with pytest.raises(DriverError, match=f"port={port}"), ScpiServer(Generator(), port):
                pass


class TestAmplifier:
    def test_our_serial_driver_drives_it(self) -> None:
        amplifier = Amplifier()
        with LineTerminal(amplifier.answer) as line:
            driver = SerialAmplifier(SerialPort(line.name), max_gain_db=20.0)
            assert amplifier.muted
            assert driver.set_gain(6.04) == 6.0
            driver.mute(False)
            assert driver.temperature_k() == pytest.approx(273.15 + 23.0)
            out = amplifier.process(np.array([0.1, -5.0, 9.0]), RATE_HZ)
            gain = 10 ** (6.0 / 20)
            np.testing.assert_allclose(out, [0.1 * gain, -5.0 * gain, 15.0])
            assert amplifier.clipped_samples == 1
            with pytest.raises(DeviceFault, match="out of range"):
                driver.set_gain(-80.0)
            driver.close()
            assert amplifier.muted

    @pytest.mark.parametrize("line", ["GAIN x", "GAIN nan", "MUTE 2", "TEMP 5", "VOLUME 1", ""])
    def test_mistakes_are_answered(self, line: str) -> None:
        assert Amplifier().answer(line).startswith("ERR ")

    def test_sustained_power_trips_it_and_cooling_releases(self) -> None:
        """10 V into 8 Ω are 12.5 W: 23 + 6 · 12.5 = 98 °C in the end, 90 °C after
        τ ln(75/8) = 89.5 s; at the end of that second 98 − 75 e^(−90/40) = 90.1 °C."""
        amplifier = Amplifier(AmplifierSettings())
        amplifier.answer("MUTE 0")
        seconds = 0
        while not amplifier.tripped:
            amplifier.process(np.full(100, 10.0), 100.0)
            seconds += 1
        assert seconds == math.ceil(40.0 * math.log(75.0 / 8.0))
        assert amplifier.answer("MUTE 0") == "ERR over temperature 90.1"
        assert np.all(amplifier.process(np.full(100, 10.0), 100.0) == 0.0)
        for _ in range(30):
            amplifier.process(np.zeros(100), 100.0)
        assert amplifier.answer("MUTE 0") == "OK 0"
