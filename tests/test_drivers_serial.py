"""Serial devices over real pseudo-terminals, noise on the line and unplugging included."""

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, DriverError, SettingError
from drivers.microcontroller import MicrocontrollerInput
from drivers.packets import SYNC, Packet, checksum, encode, parse
from drivers.serial_devices import MassFlowController, SerialAmplifier, SerialGenerator
from drivers.serialport import SerialPort
from drivers.stepped_output import SteppedOutput
from drivers.types import Channel, OutputLimits, Tone
from tests.contract import InputContract
from tests.emulators.terminal import Alicat, Board, LineTone

CHANNELS = (
    Channel("count", "voltage", "V", full_scale_v=3.2768),
    Channel("mic", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=3.2768),
)

# -- packets -----------------------------------------------------------------------------------

packets = st.builds(Packet, st.integers(0, 255), st.integers(0, 2**32 - 1), st.binary(max_size=200))


def test_the_checksum_is_ccitt_false() -> None:
    """Check value of the catalogue of CRCs (reveng): CRC-16/IBM-3740 of "123456789"."""
    assert checksum(b"123456789") == 0x29B1


@example([Packet(6, 51925, b"")], 1)  # its checksum ends with the first half of a sync
@given(st.lists(packets, max_size=6), st.integers(1, 50))
@settings(max_examples=60, deadline=None)
def test_packets_survive_any_cutting_of_the_stream(sent: list[Packet], size: int) -> None:
    stream = b"".join(map(encode, sent))
    rest, found = b"", []
    for start in range(0, len(stream), size):
        parsed = parse(rest + stream[start : start + size])
        assert (parsed.damaged, parsed.skipped) == (0, 0)
        rest = parsed.rest
        found += parsed.packets
    assert (found, rest) == (sent, b"")


@given(packets, packets, st.binary(max_size=64), st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_packet_costs_only_itself(
    first: Packet, second: Packet, noise: bytes, data: st.DataObject
) -> None:
    """A flipped bit anywhere in the first; the second is found whatever lies between.

    A lie in the length may hold back the second until that length has come: enough is sent.
    """
    damaged = bytearray(encode(first))
    bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    parsed = parse(bytes(damaged) + noise + encode(second) + bytes(70_000))
    assert second in parsed.packets
    assert len(parsed.rest) <= 1


# -- microcontroller ---------------------------------------------------------------------------


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


class TestMicrocontrollerContract(InputContract):
    @pytest.fixture(autouse=True)
    def _board(self, board: Board) -> None:
        self.board = board

    def open_rig(self, limits: OutputLimits) -> MicrocontrollerInput:
        return MicrocontrollerInput(SerialPort(self.board.name), CHANNELS)


@pytest.fixture
def daq(board: Board) -> Iterator[MicrocontrollerInput]:
    daq = MicrocontrollerInput(SerialPort(board.name), CHANNELS)
    daq.start()
    yield daq
    daq.close()


def test_volts_are_codes_times_the_step(daq: MicrocontrollerInput) -> None:
    block = daq.read(800)
    n = np.arange(800)
    assert np.allclose(block.samples[:, 0], 1e-4 * n, rtol=1e-6)
    expected = np.sin(2 * np.pi * 100.0 * n / 8000.0)
    assert np.max(np.abs(block.samples[:, 1] - expected)) <= 0.5e-4 + 1e-7


@pytest.mark.parametrize(("fault", "packets_lost"), [("drop_packets", 3), ("corrupt_packets", 2)])
def test_lost_and_damaged_packets_are_gaps_of_exact_size(
    board: Board, daq: MicrocontrollerInput, fault: str, packets_lost: int
) -> None:
    before = daq.read(64)
    setattr(board, fault, packets_lost)
    blocks = [before]
    while "gap" not in blocks[-1].flags:
        blocks.append(daq.read(160))
    last = blocks[-1]
    jump = last.first_frame - blocks[-2].end_frame
    assert jump == packets_lost * 64
    assert np.allclose(last.samples[:, 0], 1e-4 * (last.first_frame + np.arange(last.frames)))
    status = daq.status()
    assert [(gap.first_frame, gap.frames) for gap in status.gaps] == [
        (blocks[-2].end_frame, packets_lost * 64)
    ]
    assert status.lost_frames == jump
    damaged = packets_lost if fault == "corrupt_packets" else 0
    assert status.detail["damaged_packets"] == str(damaged)


def test_noise_that_looks_like_a_packet_is_passed_over(
    board: Board, daq: MicrocontrollerInput
) -> None:
    board.noise = b"\x00\xff" + SYNC + b"\x04\x10\x00"
    blocks = [daq.read(400) for _ in range(4)]
    assert [block.first_frame for block in blocks] == [0, 400, 800, 1200]
    assert daq.status().gaps == ()


def test_another_number_of_channels_is_refused(board: Board) -> None:
    with pytest.raises(SettingError, match="channels=1"):
        MicrocontrollerInput(SerialPort(board.name), CHANNELS[:1])


def test_unplugging_is_a_lost_device_at_once(board: Board, daq: MicrocontrollerInput) -> None:
    daq.read(64)
    board.unplug()
    began = time.monotonic()
    with pytest.raises(DeviceLost, match="device lost"):
        daq.read(80_000)
    assert time.monotonic() - began < 0.5
    assert not daq.status().running
    assert "device lost" in str(daq.status().fault)
    daq.stop()


def test_a_frozen_device_is_lost_within_its_patience(
    board: Board, daq: MicrocontrollerInput
) -> None:
    daq.read(64)
    board.frozen = True
    with pytest.raises(DeviceLost, match="silent for"):
        daq.read(80_000)


def test_nobody_at_the_port() -> None:
    with pytest.raises(DeviceLost, match="/dev/nothing"):
        MicrocontrollerInput(SerialPort("/dev/nothing"), CHANNELS)


# -- lines -------------------------------------------------------------------------------------

LIMITS = OutputLimits(max_amplitude_v=1.0, max_slew_v_per_s=10.0, max_frequency_hz=9000.0)


@pytest.fixture
def tone() -> Iterator[LineTone]:
    with LineTone() as tone:
        yield tone


def wait_for(tone: LineTone, name: str, value: float) -> None:
    deadline = time.monotonic() + 2.0
    while tone.values[name] != pytest.approx(value, abs=1e-6):
        assert time.monotonic() < deadline, f"{name} stayed {tone.values[name]}"
        time.sleep(0.005)


def test_a_serial_generator_behind_the_guard(tone: LineTone) -> None:
    output = SteppedOutput(SerialGenerator(SerialPort(tone.name)), LIMITS)
    wait_for(tone, "AMPL", 0.0)
    assert output.drive(Tone(171.25, 0.5)) == Tone(171.25, 0.5)
    wait_for(tone, "AMPL", 0.5)
    with pytest.raises(SettingError, match="amplitude_v=2"):
        output.drive(Tone(171.25, 2.0))
    output.silence()
    wait_for(tone, "AMPL", 0.0)
    with pytest.raises(DeviceFault, match="out of range"):
        output.drive(Tone(6000.0, 0.5))
    wait_for(tone, "AMPL", 0.0)
    output.close()


def test_a_serial_amplifier_is_muted_until_told_and_at_the_end(tone: LineTone) -> None:
    amplifier = SerialAmplifier(SerialPort(tone.name), max_gain_db=6.0)
    assert tone.values["MUTE"] == 1.0
    assert amplifier.set_gain(-3.0) == -3.0
    with pytest.raises(SettingError, match=r"gain_db=7\.0"):
        amplifier.set_gain(7.0)
    amplifier.mute(False)
    assert tone.values["MUTE"] == 0.0
    assert amplifier.temperature_k() == pytest.approx(314.65)
    amplifier.close()
    assert tone.values["MUTE"] == 1.0


def test_a_late_answer_is_not_taken_for_the_next(tone: LineTone) -> None:
    port = SerialPort(tone.name, timeout_s=0.1)
    tone.mute = True
    with pytest.raises(DeviceTimeout, match="FREQ"):
        port.ask("FREQ 1")
    tone.mute = False
    tone.send(b"OK 999\n")  # too late
    time.sleep(0.05)
    assert port.ask("FREQ 250") == "OK 250.000"
    port.close()


def test_unplugging_a_line_device_is_a_lost_device(tone: LineTone) -> None:
    port = SerialPort(tone.name, timeout_s=0.2)
    port.ask("FREQ 1")
    tone.unplug()
    with pytest.raises(DeviceLost):
        port.ask("FREQ 2")
    with pytest.raises(DriverError):
        port.ask("FREQ 2")
    port.close()


@pytest.mark.component("socat")
def test_a_port_that_comes_back_is_opened_again() -> None:
    """socat makes a pair under names that can vanish and return, as a USB adapter's do."""
    with tempfile.TemporaryDirectory() as folder:
        near, far = Path(folder) / "near", Path(folder) / "far"

        def plug() -> subprocess.Popen[bytes]:
            ends = [f"pty,raw,echo=0,link={name}" for name in (near, far)]
            process = subprocess.Popen(["socat", *ends])
            deadline = time.monotonic() + 3.0
            while not (near.exists() and far.exists()) and time.monotonic() < deadline:
                time.sleep(0.01)
            return process

        def talk(port: SerialPort) -> bytes:
            descriptor = os.open(far, os.O_RDWR | os.O_NOCTTY)
            try:
                os.write(descriptor, bytes(range(256)))
                data = b""
                while len(data) < 256:
                    data += port.read(1.0)
            finally:
                os.close(descriptor)
            return data

        port = SerialPort(str(near), timeout_s=1.0)
        socat = plug()
        port.open()
        assert talk(port) == bytes(range(256))
        socat.kill()
        socat.wait()
        with pytest.raises(DeviceLost):
            port.read(0.5)
        for name in (near, far):
            name.unlink()
        socat = plug()
        port.open()
        assert talk(port) == bytes(range(256))
        port.close()
        socat.kill()
        socat.wait()


# -- flow --------------------------------------------------------------------------------------


def test_mass_flow_in_si_and_as_a_run_keeps_it() -> None:
    """14.7 psi is 101352.9 Pa (1 psi = 6894.757 Pa); 6 l/min is 1e-4 m³/s."""
    with Alicat() as device:
        controller = MassFlowController(SerialPort(device.name), max_slpm=50.0)
        reading = controller.set_flow(1e-4)
        assert device.slpm == 6.0
        assert reading.flow_m3_per_s == pytest.approx(1e-4)
        assert reading.pressure_pa == pytest.approx(101352.93, rel=1e-7)
        assert reading.temperature_k == pytest.approx(298.15)
        kept = controller.reading().attributes("air")
        assert kept["air_flow_m3_per_s"] == pytest.approx(1e-4)
        assert kept["air_gas"] == "Air"
        with pytest.raises(SettingError, match=r"flow_m3_per_s=0\.01"):
            controller.set_flow(0.01)
        with pytest.raises(DeviceFault, match="was set as"):
            controller.set_flow(5e-4)  # the device holds at 20 l/min
        device.garbled = True
        with pytest.raises(DeviceFault, match="cannot read"):
            controller.reading()
