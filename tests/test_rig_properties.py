"""Laws that the plant must keep whatever its numbers: energy, superposition, scaling, cycles."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simulated_rig import OperatingPoint, Tube, build_rig, tube_plant
from simulated_rig.cycle import free_cycle
from simulated_rig.operating import at_operating_point, growth_rate, hopf_flow
from simulated_rig.plant import Plant
from simulated_rig.presets import THESIS_MODES, duffing, quiet_tube, thesis_two_mode, van_der_pol
from simulated_rig.simulation import Simulation, propagator
from simulated_rig.statespace import FloatArray
from simulated_rig.tube import sound_speed

RATE = 20000.0
MICROPHONES = (0.6604, 0.7112)


def simulation(plant: Plant, disturbance: float | None = None) -> Simulation:
    return Simulation(propagator(plant, MICROPHONES, 1 / RATE), disturbance)


def silence(seconds: float) -> FloatArray:
    return np.zeros(2 * round(seconds * RATE) + 1)


@settings(max_examples=20, deadline=None)
@given(
    frequencies=st.lists(st.floats(50.0, 900.0), min_size=1, max_size=4, unique=True),
    seed=st.integers(0, 1000),
)
def test_the_undamped_cold_tube_keeps_its_energy(frequencies: list[float], seed: int) -> None:
    """The linear part is propagated exactly, so each mode's ½(η'² + ω²η²) stays to rounding:
    20000 steps of 1e-16 as a random walk, 1e-12 with a wide margin."""
    modes = tuple(replace(THESIS_MODES[0], frequency_hz=f, damping=0.0) for f in frequencies)
    rig = simulation(replace(thesis_two_mode(), modes=modes, lit=False))
    n = len(modes)
    omega = 2 * np.pi * np.array(frequencies)
    rng = np.random.default_rng(seed)
    rig.x[:n], rig.x[n : 2 * n] = rng.normal(size=n) / omega, rng.normal(size=n)
    before = rig.x[n : 2 * n] ** 2 + (omega * rig.x[:n]) ** 2
    rig.run(silence(1.0), stride=round(RATE))
    after = rig.x[n : 2 * n] ** 2 + (omega * rig.x[:n]) ** 2
    assert after == pytest.approx(before, rel=1e-11)


@settings(max_examples=15, deadline=None)
@given(a=st.floats(-2.0, 2.0), b=st.floats(-2.0, 2.0), f=st.floats(40.0, 800.0))
def test_superposition_without_nonlinearity(a: float, b: float, f: float) -> None:
    """With f linear (half gain: stable) responses add, from rest, to rounding."""
    plant = quiet_tube()
    shape = replace(plant.characteristic, coefficients=(0.0, 11.25))
    plant = replace(plant, characteristic=shape)
    t = np.arange(2 * 2000 + 1) / (2 * RATE)
    one, two = np.sin(2 * np.pi * 170.0 * t), np.cos(2 * np.pi * f * t)
    parts = [simulation(plant, 0.0).run(u)[:, 0] for u in (one, two, a * one + b * two)]
    assert parts[2] == pytest.approx(a * parts[0] + b * parts[1], abs=1e-12)


@settings(max_examples=8, deadline=None)
@given(start=st.floats(0.01, 0.6))
def test_the_limit_cycle_does_not_depend_on_the_start(start: float) -> None:
    rig = simulation(thesis_two_mode(), start)
    rig.run(silence(8.0), stride=round(RATE))
    y = rig.run(silence(0.5))[:, 0]
    # Peaks of a sampled sine lie up to (π f/fs)²/2 = 4e-4 below the true ones; six samples'
    # parabola through the highest leaves 1e-6.
    expected = free_cycle(thesis_two_mode()).velocity_m_s
    window = round(84 * RATE / 169.713)  # 84 periods to half a sample: 6e-5 of the mean square
    assert np.std(y[:window]) * np.sqrt(2) == pytest.approx(expected, rel=2e-4)


@settings(max_examples=8, deadline=None)
@given(scale=st.floats(0.2, 5.0))
def test_scaling_law(scale: float) -> None:
    """f(z; c₂, c₃) with c₂ → λ c₂, c₃ → λ² c₃ and force → force/λ: everything shrinks by λ."""
    plant = thesis_two_mode()
    c = plant.characteristic.coefficients
    scaled = replace(
        plant,
        characteristic=replace(
            plant.characteristic, coefficients=(0.0, c[1], scale * c[2], scale**2 * c[3])
        ),
    )
    t = np.arange(2 * 4000 + 1) / (2 * RATE)
    drive = np.sin(2 * np.pi * 168.0 * t)
    whole = simulation(plant, 0.1).run(drive)[:, 0]
    part = simulation(scaled, 0.1 / scale).run(drive / scale)[:, 0]
    assert scale * part == pytest.approx(whole, abs=1e-9)


def test_time_scaling_law() -> None:
    """All frequencies and the rate doubled: the same numbers at the same step, drive 4-fold.

    η' ~ ω: with ω → 2ω, η'' → 4; q' + ω_f q = k_f Y keeps q if k_f → 2 k_f and Y stays.
    """
    plant = thesis_two_mode()
    fast = replace(
        plant,
        modes=tuple(replace(m, frequency_hz=2 * m.frequency_hz) for m in plant.modes),
        flame=replace(plant.flame, gain=2 * plant.flame.gain, pole_hz=2 * plant.flame.pole_hz),
        actuator=replace(plant.actuator, gain=2 * plant.actuator.gain),
    )
    t = np.arange(2 * 4000 + 1) / (2 * RATE)
    drive = np.sin(2 * np.pi * 168.0 * t)
    slow = simulation(plant, 0.1).run(drive)[:, 0]
    quick = Simulation(propagator(fast, MICROPHONES, 0.5 / RATE), 0.1).run(drive)[:, 0]
    assert quick == pytest.approx(slow, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("index", [0, 1, 2, 3])
def test_geometry_gives_the_tables(index: int) -> None:
    """Tables 4.1 and 4.7 have two digits (ψ(x_a) of mode 3 two significant ones): ±0.006."""
    table = THESIS_MODES[index]
    found = Tube().mode(index + 2, table.damping)
    assert found.frequency_hz == pytest.approx(table.frequency_hz, rel=1e-4)
    assert found.psi_flame == pytest.approx(table.psi_flame, abs=0.006)
    assert found.velocity == pytest.approx(table.velocity, abs=0.006)
    assert found.psi_speaker == pytest.approx(table.psi_speaker, abs=0.006)


def test_other_ends_have_their_modes_and_nodes() -> None:
    closed = Tube(length_m=1.0, ends="closed-closed", flame_m=0.25, speaker_m=0.0)
    assert closed.mode(1, 0.01).frequency_hz == pytest.approx(closed.mode(2, 0.01).frequency_hz / 2)
    c = sound_speed(closed.temperature_k)
    assert closed.mode(2, 0.01).frequency_hz == pytest.approx(c / 1.0)
    both = Tube(length_m=1.0, ends="open-open", flame_m=0.25, speaker_m=0.0)
    assert both.mode(1, 0.01).psi_speaker == pytest.approx(0.0, abs=1e-15)  # a speaker in the mouth
    plant = tube_plant(both, [0.01, 0.01], first=1)
    mode = plant.modes[0]
    # The lowest mode's velocity node is in the middle, its greatest velocity in the mouths.
    assert plant.velocity_at(mode, 0.5) == pytest.approx(0.0, abs=1e-12)
    assert abs(plant.velocity_at(mode, 0.0)) > abs(plant.velocity_at(mode, 0.25))


def test_refuses_what_is_not_in_the_tube() -> None:
    with pytest.raises(ValueError, match=r"flame_m=2\.0"):
        Tube(flame_m=2.0)
    with pytest.raises(ValueError, match="temperature_k"):
        sound_speed(0.0)


def test_hopf_point_and_square_root_law() -> None:
    """Poles cross the axis at the Hopf flow; near it the amplitude is ∝ √distance (1:2 at 1:4).

    Next term of the expansion: relative to the distance 0.04 itself, so 5 %.
    """
    plant = thesis_two_mode()
    ratio = 0.6
    flow = hopf_flow(plant, ratio)
    assert growth_rate(at_operating_point(plant, OperatingPoint(flow, ratio))) == pytest.approx(
        0.0, abs=1e-6
    )
    below = at_operating_point(plant, OperatingPoint(0.98 * flow, ratio))
    assert not free_cycle(below, settle_s=40.0).exists
    near, far = (
        free_cycle(
            at_operating_point(plant, OperatingPoint(flow * (1 + d), ratio)), settle_s=40.0
        ).velocity_m_s
        for d in (0.01, 0.04)
    )
    assert far / near == pytest.approx(2.0, rel=0.05)


def test_van_der_pol_has_unit_amplitude() -> None:
    """a₀ = √(4α/3γ) = 1 (Eq. 2.12) to second order in α = 1/4: α²/64 and the like, 1 %. Y is
    0.25 η'/ω0 of the fundamental; the frequency falls by α²/16 = 0.4 %."""
    cycle = free_cycle(van_der_pol())
    assert cycle.frequency_hz == pytest.approx(170.0 * (1 - (1 / 4) ** 2 / 16), rel=1e-3)
    rig = simulation(van_der_pol(), 0.1)
    rig.run(silence(2.0), stride=round(RATE))
    out = rig.run(silence(0.5))
    assert np.max(np.abs(out[:, 1])) == pytest.approx(1.0, rel=0.01)


def test_duffing_has_two_branches_where_the_thesis_has_them() -> None:
    """Softening, F = 0.06 (2 V): below resonance a low and a high solution coexist (Fig. 2.10).

    The averaged equation's roots of ((1 − w² − ¾·0.25·A²)² + (0.06 w)²) A² = F², harmonics
    neglected: of order 0.25 A²/32 = 0.5 % of A.
    """
    w, force = 0.92, 0.06
    polynomial = np.poly1d(
        [0.1875**2, -2 * 0.1875 * (1 - w**2), (1 - w**2) ** 2 + (0.06 * w) ** 2, -(force**2)]
    )
    roots = np.sqrt(np.sort(polynomial.roots[np.abs(polynomial.roots.imag) < 1e-9].real))
    assert roots.size == 3
    plant = duffing()
    t = np.arange(2 * round(2.0 * RATE) + 1) / (2 * RATE)
    found = []
    for size in (0.0, roots[2]):
        rig = simulation(plant, 0.0)
        rig.x[0] = size  # x = A cos ωt with the response a quarter period behind near resonance
        angle = np.angle(1 - w**2 - 0.1875 * size**2 + 0.06j * w)
        out = rig.run(force / 0.03 * np.cos(w * 2 * np.pi * 170.0 * t + angle))[-4000:]
        found.append(float(np.max(np.abs(out[:, 1]))))
    assert found == pytest.approx([roots[0], roots[2]], rel=0.02)


@pytest.mark.parametrize("sizes", [[1] * 50 + [350], [7, 93, 300], [399, 1]])
def test_a_rig_read_in_any_blocks_gives_the_same_samples(sizes: list[int]) -> None:
    def record(blocks: list[int]) -> FloatArray:
        with build_rig(seed=4, effects="sealed") as rig:
            rig.start()
            return np.concatenate([rig.read(n).samples for n in blocks])

    assert np.array_equal(record(sizes), record([400]))
