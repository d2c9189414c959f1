"""The plant reproduces the thesis's model: figures of ../shared/physics.md §1, from elsewhere.

Those figures are given with six digits, angles to 0.001°; the integrator's own error at 20 kHz
is below 1e-7 (see the step-size test), so 1e-4 leaves nothing to chance but transcription.
"""

import numpy as np
import pytest

from simulated_rig.cycle import free_cycle
from simulated_rig.plant import Plant
from simulated_rig.presets import thesis_four_mode, thesis_two_mode
from simulated_rig.simulation import Simulation, propagator
from simulated_rig.statespace import FloatArray, assemble

MICROPHONES = (0.6604, 0.7112)
RATE = 20000.0


def tone(frequency_hz: float, volts: float, seconds: float, rate: float = RATE) -> FloatArray:
    t = np.arange(2 * round(seconds * rate) + 1) / (2 * rate)
    return volts * np.sin(2 * np.pi * frequency_hz * t)


def coefficients(
    values: FloatArray, frequency_hz: float, start_s: float, count: int = 3, rate: float = RATE
) -> FloatArray:
    """Complex c_k, k = 1…count, phases relative to cos, over whole seconds."""
    t = start_s + np.arange(values.size) / rate
    k = np.arange(1, count + 1)[:, None]
    return 2 * np.mean(values * np.exp(-2j * np.pi * frequency_hz * k * t), axis=1)


def steady(plant: Plant, frequency_hz: float, force: float, rate: float = RATE) -> FloatArray:
    simulation = Simulation(propagator(plant, MICROPHONES, 1 / rate))
    drive = tone(frequency_hz, force / 1e10, 8.0, rate)
    y = simulation.run(drive)[-round(rate) :, 0] / plant.velocity_scale
    return coefficients(y, frequency_hz, 7.0, rate=rate)


@pytest.mark.parametrize(
    ("plant", "frequency", "force", "size", "angle", "second", "third"),
    [
        (thesis_two_mode(), 166.0, 1e10, 5.80933e6, -82.779, 2.39248e5, 1.02196e5),
        (thesis_two_mode(), 167.0, 1e10, 5.85377e6, -95.354, 2.35327e5, 1.02107e5),
        (thesis_two_mode(), 170.0, 1.5e10, 6.32136e6, -126.334, 2.61888e5, 1.20262e5),
        (thesis_two_mode(), 171.0, 2e10, 6.78041e6, -131.679, 3.00329e5, 1.45102e5),
        (thesis_four_mode(), 166.0, 1e10, 5.70834e6, -78.598, 1.80526e5, 2.74994e5),
    ],
)
def test_entrained_states(
    plant: Plant,
    frequency: float,
    force: float,
    size: float,
    angle: float,
    second: float,
    third: float,
) -> None:
    found = steady(plant, frequency, force)
    assert np.abs(found) == pytest.approx([size, second, third], rel=1e-4)
    assert np.degrees(np.angle(found[0])) == pytest.approx(angle, abs=2e-3)


@pytest.mark.parametrize(
    ("plant", "frequency", "size", "second", "third"),
    [
        (thesis_two_mode(), 169.713, 2.41447e6, 3.784e4, 6.83e3),
        (thesis_four_mode(), 169.799, 2.37302e6, 1.9857e4, 1.4433e4),
    ],
)
def test_free_limit_cycles(
    plant: Plant, frequency: float, size: float, second: float, third: float
) -> None:
    """Growth is about 6/s, and so is the return to the cycle: 8 s leave e⁻⁴⁸ of a deviation."""
    cycle = free_cycle(plant, settle_s=8.0)
    assert cycle.frequency_hz == pytest.approx(frequency, abs=1e-3)
    simulation = Simulation(propagator(plant, MICROPHONES, 1 / RATE), disturbance=0.2)
    y = simulation.run(np.zeros(2 * round(10 * RATE) + 1))[-round(RATE) :, 0]
    # A window of 1 s is no whole number of periods: fit the harmonics by least squares instead.
    t = np.arange(y.size) / RATE
    angle = 2 * np.pi * cycle.frequency_hz * t
    basis = [np.ones_like(t)]
    for k in range(1, 8):
        basis += [np.cos(k * angle), np.sin(k * angle)]
    fitted = np.linalg.lstsq(np.column_stack(basis), y / plant.velocity_scale, rcond=None)[0]
    found = np.hypot(fitted[1::2], fitted[2::2])
    assert found[0] == pytest.approx(size, rel=1e-4)
    # Given with four and three digits: half a unit of the last one.
    assert found[1] == pytest.approx(second, rel=3e-4)
    assert found[2] == pytest.approx(third, rel=1e-3)


def test_closed_loop_poles() -> None:
    """physics.md: 170.3145 Hz / −0.005609, 280.948 Hz / 0.05422 and −98.485 Hz (Table 4.5)."""
    plant = thesis_two_mode()
    system = assemble(plant, MICROPHONES)
    closed = system.a + np.outer(system.b[:, 0], system.z) * plant.characteristic.gain
    poles = np.linalg.eigvals(closed)
    pairs = sorted(poles[poles.imag > 0], key=abs)
    found = [(abs(p) / (2 * np.pi), -p.real / abs(p)) for p in pairs]
    assert found[0] == pytest.approx((170.3145, -0.005609), rel=2e-4)
    assert found[1] == pytest.approx((280.948, 0.05422), rel=2e-4)
    real = poles[np.abs(poles.imag) < 1e-6].real / (2 * np.pi)
    assert real == pytest.approx([-98.485], rel=1e-5)


def test_fourth_order_in_the_step() -> None:
    """Halving the step divides the error by 2⁴; 12 to 20 allows for the next order."""
    states = [steady(thesis_two_mode(), 166.0, 1e10, rate)[0] for rate in (5e3, 1e4, 8e4)]
    coarse, fine = abs(states[0] - states[2]), abs(states[1] - states[2])
    assert 12 < coarse / fine < 20
    assert fine / abs(states[2]) < 2e-6


def test_microphones_give_the_velocity_back() -> None:
    """Eqs. 5.1, 5.2: V = −(p₂ − p₁)/(ρ Δx jω) equals Y, harmonic by harmonic.

    Trapezoidal means over whole periods are exact for band-limited signals; what is left is the
    integrator's error, 1e-7 at this step.
    """
    plant = thesis_two_mode()
    simulation = Simulation(propagator(plant, MICROPHONES, 1 / RATE))
    out = simulation.run(tone(166.0, 1.0, 8.0))[-round(RATE) :]
    velocity = coefficients(out[:, 0], 166.0, 7.0)
    difference = coefficients(out[:, 3] - out[:, 2], 166.0, 7.0)
    omega = 2 * np.pi * 166.0 * np.arange(1, 4)
    assert -difference / (1.2 * 0.0508 * 1j * omega) == pytest.approx(velocity, rel=1e-5)


def test_pieces_of_any_size_are_equal_bit_for_bit() -> None:
    drive = tone(168.0, 0.7, 0.2)
    steps = (drive.size - 1) // 2
    whole = Simulation(propagator(thesis_two_mode(), MICROPHONES, 1 / RATE)).run(drive)
    rng = np.random.default_rng(5)
    pieces = Simulation(propagator(thesis_two_mode(), MICROPHONES, 1 / RATE))
    parts, at = [], 0
    while at < steps:
        take = min(int(rng.integers(1, 400)), steps - at)
        parts.append(pieces.run(drive[2 * at : 2 * (at + take) + 1]))
        at += take
    assert np.array_equal(np.concatenate(parts), whole)
