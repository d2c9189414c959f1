"""Rigs out of plain data and of two devices, and the harmless check that any rig can take."""

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from drivers.check import Finding, check_rig
from drivers.composed import ComposedRig
from drivers.errors import DeviceLost, DriverError, SettingError
from drivers.factory import open_device
from drivers.isolated import IsolatedRig
from drivers.protocols import DuplexRig, EmergencyStop
from drivers.types import Block, OutputLimits, StreamStatus, Tone
from tests.emulators.looprig import LoopRig
from tests.emulators.scpi import Generator, ScpiServer
from tests.emulators.terminal import Board, LineTone

LIMITS = {"max_amplitude_v": 1.0, "max_slew_v_per_s": 20.0}
ROWS = [
    {"name": "count", "quantity": "voltage", "unit": "V", "full_scale_v": 3.3},
    {"name": "mic", "quantity": "pressure", "unit": "Pa", "volts_per_unit": 0.05},
]


@pytest.fixture
def board() -> Iterator[Board]:
    with Board() as board:
        yield board


@pytest.fixture
def tone() -> Iterator[LineTone]:
    with LineTone() as tone:
        yield tone


def options(board: Board, tone: LineTone) -> dict[str, object]:
    return {
        "limits": LIMITS,
        "input": {"driver": "microcontroller", "address": board.name, "channels": ROWS},
        "output": {"driver": "serial", "address": tone.name},
    }


@pytest.mark.parametrize("isolate", [False, True])
def test_two_devices_make_a_rig(board: Board, tone: LineTone, isolate: bool) -> None:
    rig = open_device("composed", "bench", options(board, tone), isolate=isolate)
    assert isinstance(rig, IsolatedRig if isolate else ComposedRig)
    assert isinstance(rig, DuplexRig)
    assert isinstance(rig, EmergencyStop)
    with rig:
        assert (rig.name, rig.sample_rate_hz) == ("bench", 8000.0)
        rig.start()
        assert rig.drive(Tone(171.25, 0.5)) == Tone(171.25, 0.5)
        blocks = [rig.read(800) for _ in range(3)]
        assert [block.first_frame for block in blocks] == [0, 800, 1600]
        assert tone.values["AMPL"] == pytest.approx(0.5)
        rig.stop()
        assert tone.values["AMPL"] == 0.0
    assert rig.status().output_v == 0.0


def test_a_lost_input_silences_the_output(board: Board, tone: LineTone) -> None:
    with open_device("composed", "bench", options(board, tone)) as rig:
        rig.start()
        rig.drive(Tone(170.0, 0.5))
        rig.read(800)
        board.unplug()
        with pytest.raises(DeviceLost):
            rig.read(80_000)
        time.sleep(0.1)
        assert tone.values["AMPL"] == 0.0


def test_a_generator_over_visa_and_a_board_make_a_rig(board: Board) -> None:
    generator = Generator("rigol")
    with ScpiServer(generator) as server:
        table = {
            "limits": LIMITS,
            "input": {"driver": "microcontroller", "address": board.name, "channels": ROWS},
            "output": {"driver": "scpi", "address": server.address},
        }
        with open_device("composed", "bench", table) as rig:
            rig.start()
            rig.drive(Tone(170.0, 0.5))
            rig.read(2400)
            assert (generator.on, generator.peak_to_peak_v) == (True, pytest.approx(1.0))
        assert not generator.on


@pytest.mark.parametrize(
    ("driver", "change", "text"),
    [
        ("laser", {}, "driver='laser'"),
        ("composed", {"limits": {"max_amplitude_v": -1.0}}, "max_amplitude_v"),
        ("composed", {"limits": {"max_volts": 1.0}}, "max_volts"),
        ("composed", {"colour": "red"}, "unknown options colour"),
        ("composed", {"input": {"driver": "ear"}}, r"input\.driver='ear'"),
        ("soundcard", {"colour": "red"}, "unknown options"),
        ("composed", {"limits": 3}, "limits=3 is not a table"),
        ("composed", {"limits": {"max_amplitude_v": True}}, "max_amplitude_v=True is not a finite"),
        ("composed", {"output": 3}, "output=3 is not a table"),
        ("composed", {"flows": {"air": {"max_slpm": 3.0}}}, "flows: air: address is missing"),
        ("composed", {"interlocks": 3}, "interlocks=3 is not a table"),
        ("composed", {"input": {"driver": "scope", "colour": 1}}, "input: unknown options colour"),
    ],
)
def test_bad_options_name_what_is_wrong(
    board: Board, tone: LineTone, driver: str, change: dict[str, object], text: str
) -> None:
    with pytest.raises(SettingError, match=text):
        open_device(driver, "bench", options(board, tone) | change)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({}, "'bench': host_api is missing"),
        ({"host_api": "ALSA", "latency_s": "0"}, "latency_s='0' is not a finite number"),
        ({"host_api": "ALSA", "speaker": True}, "speaker=True is not a whole number"),
        ({"host_api": "ALSA", "channels": [ROWS[0] | {"quantity": "love"}]}, "quantity='love'"),
        ({"host_api": "ALSA", "channels": 3}, "channels=3 is not a list of tables"),
    ],
)
def test_options_of_a_sound_card_name_what_is_wrong(change: dict[str, object], text: str) -> None:
    given = {"limits": LIMITS, "input_device": "a", "output_device": "b", "channels": ROWS}
    with pytest.raises(SettingError, match=text):
        open_device("soundcard", "bench", given | change)


def test_limits_are_required() -> None:
    with pytest.raises(SettingError, match="limits are missing"):
        open_device("composed", "bench", {})


def test_an_input_that_fails_to_open_leaves_the_output_closed(tone: LineTone) -> None:
    table = {
        "limits": LIMITS,
        "input": {"driver": "microcontroller", "address": "/dev/nothing", "channels": ROWS},
        "output": {"driver": "serial", "address": tone.name},
    }
    with pytest.raises(DriverError, match="/dev/nothing"):
        open_device("composed", "bench", table)
    assert tone.values["AMPL"] == 0.0


class NoisyLoop(LoopRig):
    """The loop with 1 mV of noise, a stuck output where `stuck`, and `xruns` interruptions."""

    stuck = False
    xruns = 0

    def status(self) -> StreamStatus:
        return replace(super().status(), xruns=self.xruns)

    def read(self, frames: int, timeout_s: float = 5.0) -> Block:
        block = super().read(frames, timeout_s)
        noise = np.random.default_rng(block.first_frame).normal(0.0, 1e-3, block.samples.shape)
        rest = np.sin(0.13 * np.arange(block.first_frame, block.end_frame))[:, None]
        stuck = 0.1 * rest if self.stuck and self.guard.state.muted is None else 0.0
        on = stuck if self._sounded else 0.0
        self._sounded = self._sounded or bool(np.any(block.samples))
        return Block(block.first_frame, block.samples + noise + on, block.time_s, block.flags)

    _sounded = False


def findings(stuck: bool = False, xruns: int = 0) -> dict[str, Finding]:
    rig = NoisyLoop(OutputLimits(1.0, max_slew_v_per_s=20.0))
    rig.stuck, rig.xruns = stuck, xruns
    with rig:
        found = check_rig(rig, 0.5, silence_s=0.3, step_s=0.2)
    assert not rig.status().running
    return {finding.name: finding for finding in found}


def test_the_check_measures_what_is_there() -> None:
    found = findings()
    # rms of 2400 samples of 1 mV noise: standard error 1 mV/√4800 = 14 µV; four of them.
    assert found["noise floor drive"].value == pytest.approx(1e-3, abs=6e-5)
    # 10 V full scale over 0.5 V: 26.02 dB, up to 0.07 dB less for the noise's peak of 4 mV.
    assert found["clipping margin drive"].value == pytest.approx(26.0, abs=0.1)
    # 0.125 V ± 1 mV·√(2/1600) = 35 µV: 0.03 % a standard error.
    assert found["drive level drive"].value < 0.002
    # No loop delay; the loop rig stamps parts of 64 frames, 8 ms, that the command falls into.
    assert -0.008 <= found["round trip"].value < 0.05
    assert found["silence"].value <= 0.05
    assert all(finding.ok is not False for finding in found.values())


def test_the_check_finds_an_output_that_does_not_fall_silent() -> None:
    found = findings(stuck=True)
    assert found["silence"].ok is False


def test_the_check_is_not_content_with_an_interrupted_stream() -> None:
    assert findings(xruns=1)["lost frames"].ok is False


def test_the_check_refuses_a_level_beyond_the_limits() -> None:
    rig = LoopRig(OutputLimits(1.0))
    with pytest.raises(SettingError, match=r"level_v=1\.5"):
        check_rig(rig, 1.5)
