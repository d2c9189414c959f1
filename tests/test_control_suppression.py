"""The phase-shifting controller against linear theory: poles, noise floor, boundary, adaptation."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from simulated_rig import OperatingPoint, Plant, RigConfig, build_config
from simulated_rig.controllers import (
    LinearController,
    PhaseSearch,
    PhaseShifter,
    growth_rate,
    linear_plant,
    no_controller,
    residual_pa,
)
from simulated_rig.hil.loop import PlantLoop, silent
from simulated_rig.hil.suppression import SuppressionMap, free_cycle_state, suppression_map, track
from simulated_rig.operating import at_operating_point
from simulated_rig.plant import Turbulence
from simulated_rig.statespace import FloatArray

RATE_HZ = 12000.0
BEST_RAD = np.deg2rad(285.0)


@pytest.fixture(scope="module")
def config() -> RigConfig:
    found = build_config("thesis-two-mode")
    return replace(found, plant=replace(found.plant, turbulence=Turbulence(0.02)))


@pytest.fixture(scope="module")
def found(config: RigConfig) -> SuppressionMap:
    phases = np.deg2rad(np.arange(0.0, 360.0, 45.0) + 15.0)
    return suppression_map(
        config, PhaseShifter(), phases, np.array([3e-4, 1e-3]), settle_s=1.0, window_s=1.0
    )


def measured_rate(config: RigConfig, controller: LinearController) -> float:
    """Growth rate (1/s) of a disturbance of 1e-9 of the velocity unit, without noise."""
    loop = PlantLoop(silent(config), RATE_HZ, controller, disturbance=1e-9, least_steps_hz=RATE_HZ)
    pressure = loop.process(np.zeros(round(1.2 * RATE_HZ)))[:, 0]
    # Rms over whole 50 ms windows; the first 0.6 s see other poles die away.
    rms = np.sqrt(np.mean(pressure.reshape(24, -1) ** 2, axis=1))[12:]
    return float(np.polyfit(0.05 * np.arange(12), np.log(rms), 1)[0])


class TestPoles:
    def test_the_free_tube_grows_as_the_thesis_pole(self, config: RigConfig) -> None:
        """physics.md: 170.3145 Hz, ζ = −0.005609, so σ = 2π · 170.3145 · 0.005609."""
        plant = linear_plant(config.plant, config.microphones_m, RATE_HZ)
        rate = growth_rate(plant, no_controller(), RATE_HZ)
        assert rate == pytest.approx(2 * np.pi * 170.3145 * 0.005609, rel=2e-4)

    @pytest.mark.parametrize("gain", [1e-4, 3e-4])
    @pytest.mark.parametrize("degrees", [0.0, 120.0, 240.0, 330.0])
    def test_time_stepping_grows_as_the_poles_say(
        self, config: RigConfig, gain: float, degrees: float
    ) -> None:
        """Linear theory and the time stepper share the assembled plant, but neither the
        integrator nor the closing of the loop. Over the fitted 0.6 s a neighbouring pole and the
        beat of 50 ms windows against 170 Hz (8.5 periods: ±1/(2·2π·8.5) of the rms) leave some
        percent of a decade; 0.1/s is what that is over 0.6 s."""
        controller = PhaseShifter(phase_rad=np.deg2rad(degrees), gain_v_per_pa=gain).linear(RATE_HZ)
        plant = linear_plant(config.plant, config.microphones_m, RATE_HZ)
        predicted = growth_rate(plant, controller, RATE_HZ)
        assert measured_rate(config, controller) == pytest.approx(predicted, abs=0.1)

    def test_what_has_no_slope_at_rest_is_refused(self, config: RigConfig) -> None:
        shape = replace(config.plant.characteristic, preform="dead_zone")
        plant = replace(config.plant, characteristic=shape)
        with pytest.raises(ValueError, match="preform='dead_zone'"):
            linear_plant(plant, config.microphones_m, RATE_HZ)


class TestPhaseShifter:
    @pytest.mark.parametrize("degrees", [-100.0, 0.0, 30.0, 250.0])
    def test_a_sine_at_the_centre_comes_out_as_asked(self, degrees: float) -> None:
        """Fed by hand, sample by sample: gain and phase at the centre with the frame of delay."""
        shifter = PhaseShifter(160.0, 4.0, np.deg2rad(degrees), gain_v_per_pa=2e-3)
        linear = shifter.linear(10000.0)
        n = np.arange(3000)
        pressure = 3.0 * np.sin(2 * np.pi * 160.0 * n / 10000.0)
        state, out = np.zeros(2), np.zeros(n.size + 1)
        for k in n:
            state = linear.a @ state + linear.b @ [pressure[k], 0.0]
            out[k + 1] = linear.c @ state
        late = slice(
            2000, 3000
        )  # 16 whole periods; 25 decay times Q/(π f₀) of the band-pass later: e⁻²⁵
        wave = np.exp(-2j * np.pi * 160.0 * n[late] / 10000.0)
        ratio = (out[late] @ wave) / (pressure[late] @ wave)
        assert ratio == pytest.approx(2e-3 * np.exp(1j * np.deg2rad(degrees)), abs=1e-10)

    def test_the_bandwidth_is_the_quality(self) -> None:
        """At f₀(√(1 + 1/4Q²) ± 1/2Q) a band-pass is 3 dB down; here a sum with the low-pass of the
        same resonator takes part, so only for the phase where that is nil: 0 at a high rate."""
        linear = PhaseShifter(170.0, 5.0, 0.0, 1.0).linear(48000.0)
        edge = 170.0 * (np.sqrt(1 + 1 / 100) + 1 / 10)
        # 1.5 frames of delay at 48 kHz turn 1.9° towards the low-pass: below 2 % of the gain.
        assert abs(linear.response(edge, 48000.0)[0]) == pytest.approx(np.sqrt(0.5), rel=0.02)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"center_hz": 0.0}, "center_hz=0.0"),
            ({"quality": -1.0}, "quality=-1.0"),
            ({"gain_v_per_pa": float("nan")}, "gain_v_per_pa=nan"),
            ({"limit_v": 0.0}, "limit_v=0.0"),
        ],
    )
    def test_bad_settings_name_themselves(self, change: dict[str, float], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            PhaseShifter(**change)  # type: ignore[arg-type]

    def test_a_centre_too_high_for_the_rate_is_refused(self) -> None:
        with pytest.raises(ValueError, match="rate/8"):
            PhaseShifter(center_hz=2000.0).linear(10000.0)


class TestLoop:
    @pytest.mark.parametrize("law", [False, True])
    def test_blocks_of_any_size_give_the_same_numbers(self, config: RigConfig, law: bool) -> None:
        rng = np.random.default_rng(3)
        speaker = 0.1 * rng.standard_normal(600)
        shifter = PhaseShifter(phase_rad=BEST_RAD).linear(RATE_HZ)
        controller = (lambda p: 1e-4 * float(p[0] - p[1])) if law else shifter
        whole = PlantLoop(config, RATE_HZ, controller, seed=5).process(speaker)
        loop = PlantLoop(config, RATE_HZ, controller, seed=5)
        cuts = [0, 1, 64, 65, 193, 600]
        parts = [loop.process(speaker[i:j]) for i, j in itertools.pairwise(cuts)]
        np.testing.assert_array_equal(np.concatenate(parts), whole)

    def test_a_python_function_takes_the_linear_controllers_place(self, config: RigConfig) -> None:
        """The same recursion written by hand: equal to rounding, amplified over 50 ms by at most
        e^{6·0.05} of the free growth."""
        linear = PhaseShifter(phase_rad=BEST_RAD, gain_v_per_pa=1e-3).linear(RATE_HZ)
        state = np.zeros(2)

        def law(pressure_pa: FloatArray) -> float:
            nonlocal state
            state = linear.a @ state + linear.b @ pressure_pa
            return float(linear.c @ state)

        one = PlantLoop(config, RATE_HZ, linear, disturbance=0.1)
        other = PlantLoop(config, RATE_HZ, law, disturbance=0.1)
        p, q = (loop.process(np.zeros(2400)) for loop in (one, other))
        np.testing.assert_allclose(q, p, rtol=0, atol=1e-9 * np.max(np.abs(p)))
        np.testing.assert_allclose(other.control_v, one.control_v, rtol=0, atol=1e-12)

    def test_the_controllers_volts_are_limited(self, config: RigConfig) -> None:
        loop = PlantLoop(config, RATE_HZ, lambda p: 1e3)
        loop.process(np.zeros(10))
        assert loop.control_v[0] == 0.0
        np.testing.assert_array_equal(loop.control_v[1:], 5.0)

    def test_a_controller_that_answers_nan_is_an_error(self, config: RigConfig) -> None:
        loop = PlantLoop(config, RATE_HZ, lambda p: float("nan"))
        with pytest.raises(ValueError, match="answer nan is not a finite voltage"):
            loop.process(np.zeros(10))


class TestMap:
    def test_the_boundary_is_where_the_poles_cross(self, found: SuppressionMap) -> None:
        """A stable loop is left with noise alone; an unstable one with a limit cycle, whose
        amplitude goes as √(σ/σ₀) of the free one's (supercritical: only the linear gain moves), so
        that it is less than 10 log₁₀(σ₀/σ) quieter. Points with |σ| < 4/s are not yet settled
        after 1 s (e⁻⁴ = −35 dB) and belong to neither side."""
        free_rate = 6.0
        stable, unstable = found.growth_rate < -4.0, found.growth_rate > 4.0
        assert stable.sum() >= 3
        assert unstable.sum() >= 8
        # ±2 dB: what the harmonic content and the phase's own pull on the frequency make of it.
        most = 10 * np.log10(free_rate / found.growth_rate[unstable]) + 2.0
        assert np.all(found.measured_db[unstable] < most)
        assert np.min(found.measured_db[stable]) > np.max(found.measured_db[unstable]) + 10.0

    def test_the_suppression_is_what_noise_leaves(self, found: SuppressionMap) -> None:
        """Noise through a resonance of decay rate |σ| has the correlation e^{−|σ|τ} cos ωτ, so its
        mean square over T ≫ 1/|σ| deviates by √(4∫₀^∞ ρ² dτ/T) = √(1/(|σ|T)) of itself: three
        deviations are 10 log₁₀(1 + 3/√(|σ|T)) dB."""
        stable = found.growth_rate < -10.0
        assert np.any(stable)
        spread = 10 * np.log10(1 + 3 / np.sqrt(-found.growth_rate[stable] * 1.0))
        gap = np.abs(found.measured_db[stable] - found.predicted_db[stable])
        assert np.all(gap < spread)

    def test_the_best_phase_reaches_what_the_noise_allows(self, config: RigConfig) -> None:
        """X = 20 log₁₀(free rms / residual of the Lyapunov equation), less its 3 deviations."""
        shifter = PhaseShifter(phase_rad=BEST_RAD, gain_v_per_pa=1e-3)
        controller = shifter.linear(RATE_HZ)
        state, free_pa = free_cycle_state(config, 0)
        loop = PlantLoop(config, RATE_HZ, controller, seed=9, least_steps_hz=RATE_HZ)
        loop.x[:] = state
        loop.process(np.zeros(round(RATE_HZ)))
        left = float(np.std(loop.process(np.zeros(round(4 * RATE_HZ)))[:, 0]))
        plant = linear_plant(config.plant, config.microphones_m, RATE_HZ)
        rate = growth_rate(plant, controller, RATE_HZ)
        x_db = 20 * np.log10(free_pa / residual_pa(config, controller, RATE_HZ))
        x_db -= 10 * np.log10(1 + 3 / np.sqrt(-rate * 4.0))
        assert x_db > 25.0
        assert 20 * np.log10(free_pa / left) > x_db

    def test_there_is_no_residual_of_an_unstable_loop(self, config: RigConfig) -> None:
        with pytest.raises(ValueError, match="unstable"):
            residual_pa(config, no_controller(), RATE_HZ)

    def test_a_weak_actuator_does_not_suffice(self, config: RigConfig) -> None:
        """Thesis p. 6: the actuator's energy can be too small. Clipped at a fortieth of the volts
        that the same loop first needs, the limit cycle stays."""
        shifter = PhaseShifter(phase_rad=BEST_RAD, gain_v_per_pa=1e-3)
        state, free_pa = free_cycle_state(config, 0)
        left = []
        for limit in (5.0, 0.007):
            weak = replace(shifter, limit_v=limit).linear(RATE_HZ)
            loop = PlantLoop(config, RATE_HZ, weak, least_steps_hz=RATE_HZ)
            loop.x[:] = state
            loop.process(np.zeros(round(RATE_HZ)))
            left.append(float(np.std(loop.process(np.zeros(6000))[:, 0])))
        assert left[0] < 0.1 * free_pa
        assert left[1] > 0.7 * free_pa


class TestAdaptiveSearch:
    def test_it_finds_the_bottom_of_a_bowl(self) -> None:
        search = PhaseSearch(0.0)
        for _ in range(200):
            search = search.step(30.0 * (1 - np.cos(search.applied_rad - 1.0)))
        # At a fixed point both sides are equal: the bottom itself, but for float rounding.
        assert search.phase_rad == pytest.approx(1.0, abs=1e-6)

    def test_it_holds_what_a_fixed_phase_loses(self, config: RigConfig) -> None:
        """The gas cools (−15 % in frequency) and the flow rises: the poles of the fixed controller
        cross the axis, so its limit cycle must return; the search must stay on the stable side."""
        shifter = PhaseShifter(quality=8.0, gain_v_per_pa=2e-3, phase_rad=BEST_RAD)

        def plant_at(t: float) -> Plant:
            share = min(t / 20.0, 1.0)
            modes = tuple(
                replace(m, frequency_hz=m.frequency_hz * (1 - 0.15 * share))
                for m in config.plant.modes
            )
            point = OperatingPoint(flow=1 + 0.1 * share)
            return at_operating_point(replace(config.plant, modes=modes), point)

        _, free_pa = free_cycle_state(config, 0)
        fixed = track(config, shifter, plant_at, 26.0)
        search = PhaseSearch(shifter.phase_rad)
        adaptive = track(config, shifter, plant_at, 26.0, search)
        assert fixed.growth_rate[-1] > 2.0
        assert np.max(adaptive.growth_rate[4:]) < 0.0
        late = slice(-8, None)
        assert np.sqrt(np.mean(fixed.pressure_pa[late] ** 2)) > 0.3 * free_pa
        # 20 dB is what the Lyapunov floor leaves in reserve at the drifted point's worst phase.
        assert np.sqrt(np.mean(adaptive.pressure_pa[late] ** 2)) < 0.1 * free_pa
