"""The whole bench without a sound card: plant behind serial packets, generator over TCP, amplifier
on a serial line, measured by our own drivers as one composed rig. And what overload does."""

import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from drivers.composed import ComposedRig
from drivers.errors import DeviceLost, SettingError
from drivers.microcontroller import MicrocontrollerInput
from drivers.serial_devices import SerialAmplifier
from drivers.serialport import SerialPort
from drivers.stepped_output import SteppedOutput
from drivers.types import OutputLimits, Tone
from drivers.visa_generator import open_generator
from simulated_rig import build_config
from simulated_rig.controllers import Law, PhaseShifter
from simulated_rig.hil import (
    Bench,
    Device,
    HilReport,
    HilSettings,
    Watch,
    WatchSettings,
    lines,
    run,
)
from simulated_rig.hil.audio import AudioSettings, CounterWatch
from simulated_rig.hil.loop import PlantLoop

# A machine that is busy with other things must not end these runs: what they test is not pace.
PATIENT = WatchSettings(misses_in_a_row=10_000, late_s=60.0)
QUIET = replace(build_config("quiet-tube"), limits=OutputLimits(5.0))


def read_until_lost(board: MicrocontrollerInput) -> set[str]:
    """Every flag of the blocks that came before the device fell silent."""
    flags: set[str] = set()
    try:
        for _ in range(1000):
            flags |= board.read(64, 10.0).flags
    except DeviceLost:
        return flags
    raise AssertionError("8 s of data from an overloaded device")


def reached(output: SteppedOutput, amplitude_v: float) -> None:
    """Wait for the end of the ramp, as the device confirmed it."""
    deadline = time.monotonic() + 10.0
    while output.output_v != amplitude_v:
        assert time.monotonic() < deadline, output.fault
        time.sleep(0.005)


class TestDevice:
    def test_it_is_the_plant_and_the_chain(self) -> None:
        """Against the plant alone: pressures times sensitivity, 12 frames (the converter's group
        delay) later, to the filter's ripple (1e-7), the ADC's step and the microphones' noise
        (0.2 Pa rms, 6 deviations)."""
        watch = Watch(PATIENT, 48000.0)
        config = build_config("thesis-two-mode")
        device = Device(config, 48000.0, watch, seed=2)
        alone = PlantLoop(config, 48000.0, seed=2)
        alone.process(np.zeros(4 * 48000))
        drive = 0.05 * np.sin(2 * np.pi * 150.0 * np.arange(2400) / 48000.0)
        volts, pressure = device.process(drive), alone.process(drive)
        tolerance = 6 * 0.2 * 0.002 + 10.0 / 2**15
        np.testing.assert_allclose(
            volts[100:, 0], 0.002 * pressure[88:-12, 0], rtol=0, atol=tolerance
        )
        np.testing.assert_allclose(volts[12:, 2], drive[:-12], rtol=0, atol=10.0 / 2**15)
        assert np.max(np.abs(pressure)) > 200 * 0.2

    def test_blocks_of_any_size_give_the_same_volts(self) -> None:
        drive = 0.1 * np.sin(0.02 * np.arange(1000))
        one, other = (Device(QUIET, 48000.0, Watch(PATIENT, 48000.0), seed=3) for _ in range(2))
        parts = [other.process(part) for part in np.split(drive, [1, 257, 258, 700])]
        np.testing.assert_array_equal(np.concatenate(parts), one.process(drive))

    @pytest.mark.parametrize(
        ("law", "says"),
        [
            (lambda p: float("nan"), "the controller's answer nan is not a finite voltage"),
            (lambda p: None, "the controller's answer None is not a finite voltage"),
            (lambda p: p[7], "the controller failed: IndexError"),
            (sys.exit, "the controller failed: SystemExit"),
        ],
    )
    def test_a_controller_that_fails_ends_in_a_stated_fault_and_silence(
        self, law: Law, says: str
    ) -> None:
        watch = Watch(PATIENT, 48000.0)
        device = Device(QUIET, 48000.0, watch, controller=law)
        assert np.all(device.process(np.zeros(64)) == 0.0)
        assert (watch.fault or "").startswith(f"plant failed: {says}")
        assert np.all(device.process(np.ones(64)) == 0.0)


class TestWatch:
    def test_misses_in_a_row_are_an_overload(self) -> None:
        watch = Watch(WatchSettings(misses_in_a_row=3), 1000.0)
        for took in (0.02, 0.02, 0.001, 0.02, 0.02):
            watch.block(10, took)
        assert watch.fault is None
        watch.block(10, 0.025)
        assert watch.fault is not None
        assert watch.fault.startswith("overload: 3 blocks in a row took longer than they last")
        assert watch.timing.misses == 5
        assert watch.timing.worst_load == pytest.approx(2.5)
        assert watch.timing.load == pytest.approx(0.106 / 0.06)

    def test_a_loss_is_a_fault_once_settled(self) -> None:
        watch = Watch(WatchSettings(settle_s=60.0), 48000.0)
        watch.xrun("line in")
        assert watch.fault is None
        watch = Watch(WatchSettings(settle_s=0.0), 48000.0)
        watch.lost(64, "line in")
        watch.xrun("line in")
        assert watch.fault == "64 frames lost at the line in: the data are no longer continuous"
        assert watch.timing.lost_frames == 64

    def test_settings_name_themselves(self) -> None:
        with pytest.raises(SettingError, match="misses_in_a_row=0"):
            WatchSettings(misses_in_a_row=0)
        with pytest.raises(SettingError, match="board_rate_hz=100"):
            HilSettings(board_rate_hz=100.0)
        with pytest.raises(SettingError, match="counter"):
            AudioSettings("a", "b", counter=(0, 1))


class TestCounterWatch:
    @staticmethod
    def stamped(first: int, frames: int) -> "np.ndarray[tuple[int], np.dtype[np.float32]]":
        return ((first + np.arange(frames) + 1) / 2.0**24).astype(np.float32)

    def test_continuous_frames_lose_nothing(self) -> None:
        watch = CounterWatch(48000.0)
        found = [watch.add(np.zeros(100, np.float32))]
        found += [watch.add(self.stamped(5000 + 256 * k, 256)) for k in range(5)]
        assert found == [0] * 6

    def test_a_gap_within_and_between_blocks_is_counted(self) -> None:
        watch = CounterWatch(48000.0)
        watch.add(self.stamped(5000, 256))
        assert watch.add(self.stamped(5256 + 30, 256)) == 30
        torn = np.concatenate([self.stamped(5542, 100), self.stamped(5642 + 7, 156)])
        assert watch.add(torn) == 7

    def test_another_stream_is_not_a_loss(self) -> None:
        watch = CounterWatch(48000.0)
        watch.add(self.stamped(5000, 256))
        assert watch.add(np.zeros(4800, np.float32)) == 0
        assert watch.add(self.stamped(2_000_000, 256)) == 0
        assert watch.add(self.stamped(2_000_256, 256)) == 0


class TestBench:
    def test_our_drivers_measure_the_tube_through_every_wire(self) -> None:
        """150 Hz at 0.25 V through generator, amplifier (−6 dB) and board: the drive line shows
        half of it, and the pressure is what the plant alone answers."""
        settings = HilSettings(QUIET, watch=PATIENT)
        limits = OutputLimits(1.0, max_slew_v_per_s=1e4, dead_man_s=30.0)
        with Bench(settings) as bench:
            report = bench.report()
            assert report.board is not None
            assert report.amplifier is not None
            assert report.generator is not None
            amplifier = SerialAmplifier(SerialPort(report.amplifier), 0.0)
            amplifier.set_gain(-6.0)
            amplifier.mute(False)
            board = MicrocontrollerInput(SerialPort(report.board), lines(QUIET), timeout_s=5.0)
            output = open_generator(report.generator, limits, timeout_s=5.0)
            with ComposedRig("bench", board, output) as rig:
                rig.start()
                rig.drive(Tone(150.0, 0.25))
                reached(output, 0.25)
                rig.read(4000, 20.0)  # the transient: decay of 1/30 s and slower in 0.5 s
                block = rig.read(1600, 20.0)
            amplifier.close()
            assert bench.check() is None
        assert block.flags == frozenset()
        wave = np.exp(-2j * np.pi * 150.0 * np.arange(1600) / 8000.0)
        p1, _, drive = np.abs(block.samples.T @ wave) * 2 / 1600
        # 160 codes repeat, so their rounding does not average out: at most one step.
        assert drive == pytest.approx(0.25 * 10 ** (-6.0 / 20), abs=10.0 / 2**15)
        alone = PlantLoop(QUIET, 8000.0)
        alone.process(np.zeros(8000))
        t = np.arange(8000) / 8000.0
        heard = alone.process(0.25 * 10 ** (-6.0 / 20) * np.sin(2 * np.pi * 150.0 * t))[-1600:, 0]
        expected = 0.002 * np.abs(heard @ wave) * 2 / 1600
        # Turbulence of 0.02 V rms below 300 Hz: its share in a bin of 5 Hz is some 0.003 V.
        assert p1 == pytest.approx(expected, rel=0.1)

    def test_a_controller_quietens_the_running_tube(self) -> None:
        config = build_config("thesis-two-mode")
        shifter = PhaseShifter(phase_rad=np.deg2rad(285.0), gain_v_per_pa=1e-3)
        settings = HilSettings(
            config,
            controller=shifter.linear(8000.0),
            generator_port=None,
            amplifier=None,
            watch=PATIENT,
        )
        with Bench(settings) as bench:
            address = bench.report().board
            assert address is not None
            board = MicrocontrollerInput(SerialPort(address), lines(config), timeout_s=5.0)
            board.start()
            board.read(8000, 30.0)
            volts = board.read(800, 30.0).samples[:, 0]
            board.close()
        free = PlantLoop(config, 8000.0).process(np.zeros(32000))[-8000:, 0]
        # Poles at −25/s: 1 s later e⁻²⁵ of the cycle is left, and noise of 0.2 Pa.
        assert np.std(volts / 0.002) < 0.01 * np.std(free)

    def test_overload_ends_in_a_stated_fault_never_in_wrong_data(self) -> None:
        """A user's controller that is too slow: what was delivered is contiguous and unflagged,
        then nothing more comes, the generator refuses output, and the report says why."""

        def slow(pressure_pa: object) -> float:
            time.sleep(0.001)  # 8 times a frame
            return 0.0

        settings = HilSettings(QUIET, controller=slow, watch=WatchSettings(misses_in_a_row=4))
        with Bench(settings) as bench:
            address = bench.report().board
            assert address is not None
            board = MicrocontrollerInput(SerialPort(address), lines(QUIET), timeout_s=5.0)
            board.start()
            flags = read_until_lost(board)
            assert flags == set()
            assert bench.check() is not None
            assert bench.generator is not None
            bench.generator.message(b"OUTP ON")
            error = bench.generator.message(b"SYST:ERR?")
            board.close()
        assert error is not None
        assert "output disabled: overload" in error
        assert bench.report().fault is not None
        assert bench.report().lines()[-1].startswith("FAULT: overload")


class TestRun:
    def test_it_reports_and_ends_in_time(self) -> None:
        seen: list[HilReport] = []
        settings = HilSettings(QUIET, watch=PATIENT)
        report = run(settings, duration_s=0.3, on_report=seen.append)
        assert report.fault is None
        assert report.timing.frames > 0
        assert report.timing.load > 0.0
        assert seen[0].board == report.board
        assert "no fault" in report.lines()

    def test_it_can_be_stopped(self) -> None:
        stop = threading.Event()
        report = run(HilSettings(QUIET, watch=PATIENT), on_report=lambda _: stop.set(), stop=stop)
        assert report.fault is None
