"""SCPI generators and scopes over real sockets against our emulator, and over pyvisa-sim."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, InterlockOpen, SettingError
from drivers.protocols import EmergencyStop, PressureInput, SpeakerOutput
from drivers.scpi_dialects import dialect_for
from drivers.stepped_output import SteppedOutput
from drivers.types import Channel, OutputLimits, Tone
from drivers.visa_generator import open_generator
from drivers.visa_link import VisaLink
from drivers.visa_scope import Preamble, ScopeInput
from tests.emulators.scpi import IDENTITIES, Generator, Scope, ScpiServer

LIMITS = OutputLimits(max_amplitude_v=2.0, max_slew_v_per_s=10.0, dead_man_s=0.4)
HERE = Path(__file__).parent


def until(true: Callable[[], bool], within_s: float = 2.0) -> bool:
    """Whether `true` became so in time."""
    deadline = time.monotonic() + within_s
    while not true():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)
    return True


@pytest.fixture(params=list(IDENTITIES))
def server(request: pytest.FixtureRequest) -> Iterator[ScpiServer]:
    with ScpiServer(Generator(request.param)) as server:
        yield server


@pytest.fixture
def keysight() -> Iterator[ScpiServer]:
    with ScpiServer(Generator("keysight")) as server:
        yield server


def opened(server: ScpiServer, timeout_s: float = 1.0) -> tuple[SteppedOutput, Generator]:
    assert isinstance(server.instrument, Generator)
    return open_generator(server.address, LIMITS, timeout_s=timeout_s), server.instrument


def sounding(server: ScpiServer, timeout_s: float = 1.0) -> tuple[SteppedOutput, Generator]:
    """The same, driven until it is on."""
    output, generator = opened(server, timeout_s)
    output.drive(Tone(170.0, 1.0))
    assert until(lambda: generator.on)
    return output, generator


def test_every_dialect_sets_reads_back_ramps_and_silences(server: ScpiServer) -> None:
    output, generator = opened(server)
    assert dialect_for(generator.identity).name == generator.maker
    assert isinstance(output, SpeakerOutput)
    assert isinstance(output, EmergencyStop)
    assert not generator.on
    opened_s = time.monotonic()
    assert output.drive(Tone(171.5, 1.5)) == Tone(171.5, 1.5)
    assert until(lambda: generator.on and generator.peak_to_peak_v == pytest.approx(3.0))
    assert generator.frequency_hz == 171.5
    steps = [(when, volts) for when, volts in generator.log if when >= opened_s]
    # After each tick the amplitude is at most slew · (time since the drive), plus one tick's
    # worth for the step that is taken at its beginning, and a millisecond of the guard's grain.
    assert len(steps) >= 5
    for when, volts in steps:
        assert volts <= LIMITS.max_slew_v_per_s * (when - opened_s + 0.041) + 1e-9
    assert generator.errors == []
    output.silence()
    assert until(lambda: not generator.on, 0.2)
    output.close()
    output.close()
    assert generator.errors == []


def test_limits_are_asked_from_the_instrument(keysight: ScpiServer) -> None:
    wide = OutputLimits(max_amplitude_v=100.0, max_frequency_hz=1e9)
    output = open_generator(keysight.address, wide)
    assert (output.limits.max_amplitude_v, output.limits.max_frequency_hz) == (10.0, 30e6)
    with pytest.raises(SettingError, match=r"amplitude_v=10\.5"):
        output.drive(Tone(170.0, 10.5))
    output.close()


def test_dead_man_and_emergency_stop(keysight: ScpiServer) -> None:
    output, generator = sounding(keysight)
    fed_s = time.monotonic()
    output.feed()
    assert until(lambda: not generator.on)
    assert LIMITS.dead_man_s <= time.monotonic() - fed_s <= LIMITS.dead_man_s + 0.1
    assert "dead man" in str(output.muted)
    output.feed()
    assert not until(lambda: generator.on, 0.1)
    output.drive(Tone(170.0, 1.0))
    assert until(lambda: generator.on)
    output.emergency_stop("red button")
    assert until(lambda: not generator.on, 0.1)
    with pytest.raises(InterlockOpen, match="red button"):
        output.drive(Tone(170.0, 1.0))
    output.close()


def test_a_refused_setting_quotes_the_error_queue(keysight: ScpiServer) -> None:
    link = VisaLink(keysight.address)
    with pytest.raises(DeviceFault, match=r"FREQ 1E12.*-222"):
        link.set("SOUR1:FREQ 1E12", "SYST:ERR?")
    assert link.errors("SYST:ERR?") == []
    link.close()


def test_a_setting_that_comes_out_different_is_a_fault_and_silence(keysight: ScpiServer) -> None:
    output, generator = opened(keysight)
    generator.misset = 1.5
    output.drive(Tone(170.0, 1.0))
    assert until(lambda: output.fault is not None)
    assert until(lambda: not generator.on)
    with pytest.raises(DeviceFault, match="was set as"):
        output.drive(Tone(170.0, 1.0))
    output.close()


def test_a_lost_off_is_seen_and_told_again(server: ScpiServer) -> None:
    """No error tells of a command that the instrument lost: only its state does."""
    output, generator = sounding(server)
    generator.deaf = 3
    output.silence()
    assert until(lambda: output.fault is not None)
    assert "told to switch its output off" in str(output.fault)
    assert until(lambda: not generator.on, 0.5)
    output.close()
    assert (output.output_v, generator.deaf) == (0.0, 0)


def test_closing_tells_until_the_output_is_seen_to_be_off(keysight: ScpiServer) -> None:
    output, generator = sounding(keysight)
    generator.deaf = 6
    output.close()
    assert not generator.on


def test_a_generator_that_stays_on_is_not_opened(keysight: ScpiServer) -> None:
    assert isinstance(keysight.instrument, Generator)
    keysight.instrument.deaf = 10
    with pytest.raises(DeviceFault, match=r"answers '1' to 'OUTP1\?'"):
        open_generator(keysight.address, LIMITS)


def test_a_timeout_does_not_poison_the_next_query(keysight: ScpiServer) -> None:
    """The late answer must not be taken for the next question's: the link opens anew."""
    link = VisaLink(keysight.address, timeout_s=0.2)
    assert "33522B" in link.query("*IDN?")
    keysight.hang = True
    with pytest.raises(DeviceTimeout, match="FREQ"):
        link.query("SOUR1:FREQ?")
    keysight.hang = False
    assert float(link.query("SOUR1:FREQ?")) == 1000.0
    assert keysight.connections == 2
    link.close()


def test_a_dropped_connection_is_lost_then_opened_again(keysight: ScpiServer) -> None:
    link = VisaLink(keysight.address, timeout_s=0.5)
    link.query("*IDN?")
    keysight.drop()
    with pytest.raises((DeviceLost, DeviceTimeout)):
        link.query("*IDN?")
    assert "33522B" in link.query("*IDN?")
    link.close()


def test_nobody_there_is_a_lost_device() -> None:
    with ScpiServer(Generator("generic")) as server:
        address = server.address
    with pytest.raises(DeviceLost):
        open_generator(address, LIMITS, timeout_s=0.3)


def test_a_frozen_generator_is_silenced_when_it_wakes(keysight: ScpiServer) -> None:
    output, generator = sounding(keysight, timeout_s=0.2)
    keysight.hang = True
    output.silence()
    assert until(lambda: output.fault is not None)
    assert "not answered" in str(output.fault)
    keysight.hang = False
    assert until(lambda: not generator.on)
    assert until(lambda: output.output_v == 0.0)
    output.close()


@pytest.mark.component("pyvisa-sim")
def test_the_generic_profile_over_pyvisa_sim() -> None:
    backend = f"{HERE / 'emulators' / 'generator.yaml'}@sim"
    output = open_generator("TCPIP0::127.0.0.1::5025::SOCKET", LIMITS, backend=backend)
    assert output.drive(Tone(170.0, 0.5)).frequency_hz == 170.0
    assert until(lambda: output.output_v == 0.5)
    output.close()
    assert (output.output_v, output.fault) == (0.0, None)


CHANNELS = (
    Channel("mic 1", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=4.0),
    Channel("mic 2", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=4.0),
)


@pytest.fixture
def scope() -> Iterator[tuple[ScopeInput, Scope]]:
    emulator = Scope()
    with ScpiServer(emulator) as server:
        scope = ScopeInput(VisaLink(server.address), CHANNELS, 10_000.0, 2000)
        yield scope, emulator
        scope.close()


def test_a_scope_records_in_blocks_with_gaps_between(scope: tuple[ScopeInput, Scope]) -> None:
    rig, _ = scope
    assert isinstance(rig, PressureInput)
    rig.start()
    blocks = [rig.read(1500), rig.read(1500), rig.read(100)]
    assert [block.frames for block in blocks] == [1500, 500, 100]
    assert blocks[1].first_frame == blocks[0].end_frame
    assert blocks[2].first_frame >= blocks[1].end_frame
    samples = np.concatenate([blocks[0].samples, blocks[1].samples])
    expected = np.sin(2 * np.pi * 100.0 * np.arange(2000) / 10_000.0)
    # Half a step of ±4 V in 16 bits.
    assert np.max(np.abs(samples[:, 0] - expected)) <= 4.0 / 32768 / 2 + 1e-12
    assert np.max(np.abs(samples[:, 1] + 0.5 * expected)) <= 4.0 / 32768 / 2 + 1e-12
    jump = blocks[2].first_frame - blocks[1].end_frame
    assert ("gap" in blocks[2].flags) == (jump > 0)
    assert sum(gap.frames for gap in rig.status().gaps) == jump


def test_a_scope_that_sends_too_few_points_is_a_fault(scope: tuple[ScopeInput, Scope]) -> None:
    rig, emulator = scope
    rig.start()
    emulator.short = True
    with pytest.raises(DeviceFault, match="sent 1999 points"):
        rig.read(10)


def test_a_scope_refuses_a_rate_that_it_does_not_run_at() -> None:
    with ScpiServer(Scope()) as server:
        link = VisaLink(server.address)
        with pytest.raises(SettingError, match="sample_rate_hz=50000"):
            ScopeInput(link, CHANNELS, 50_000.0, 1000)
        link.close()


@pytest.mark.parametrize("answer", ["1,2,3", "1,0,x,1,1e-4,0,0,1,0,0"])
def test_a_broken_preamble_is_a_fault(answer: str) -> None:
    with pytest.raises(DeviceFault, match="preamble"):
        Preamble.parse(answer)
