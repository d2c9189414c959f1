"""Plants to start from. The tube's numbers are the thesis's Tables 4.1, 4.2 and 4.7."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from simulated_rig.plant import Actuator, Characteristic, Mode, Plant, Turbulence

TUBE_LENGTH_M = 1.524
# Pressure at the microphones over what the momentum equation gives along the table's shapes from
# the open end: recorded campaigns show 1 kPa beside 0.7 m/s, several times ρ c u.
PRESSURE_EXCESS = 3.6


def tube_mode(
    index: int, frequency_hz: float, damping: float, psi_f: float, velocity: float, psi_a: float
) -> Mode:
    """Mode i of the closed-open tube, k_i = i π/(2 L) (Eq. 4.2); D ∝ sin kx, so ∫ D dx from the
    open end, where the pressure vanishes, is −D cot(kx)/k."""
    k = index * np.pi / (2 * TUBE_LENGTH_M)
    pressure = -PRESSURE_EXCESS * velocity / np.tan(k * 0.762) / k
    return Mode(frequency_hz, damping, psi_f, velocity, psi_a, float(k), float(pressure))


# Table 4.1 has −0.10 for the second mode's dψ/dx; +0.10 is what −k sin kx and Table 4.5 demand.
THESIS_MODES = (
    tube_mode(3, 168.79, 0.010, -0.41, -0.16, -0.22),
    tube_mode(5, 281.33, 0.050, -0.24, +0.10, -0.34),
    tube_mode(7, 393.86, 0.050, 0.17, 0.071, -0.032),
    tube_mode(9, 506.39, 0.050, 0.13, -0.055, 0.179),
)


def thesis_two_mode() -> Plant:
    """The model of Section 4.1 with its two first modes."""
    return Plant(modes=THESIS_MODES[:2])


def thesis_four_mode() -> Plant:
    """The same with the third and fourth mode of Table 4.7."""
    return Plant(modes=THESIS_MODES)


def quiet_tube() -> Plant:
    """A stable tube (Fig. 1.3, lower curve): half the gain, noise inside the loop."""
    plant = thesis_four_mode()
    shape = plant.characteristic
    halved = (0.0, 0.5 * shape.gain, *shape.coefficients[2:])
    return replace(
        plant,
        characteristic=replace(shape, coefficients=halved),
        turbulence=Turbulence(level_v=0.02),
    )


def _oscillator(frequency_hz: float, damping: float, force_per_v: float) -> Plant:
    """One mode whose η has unit size; 1 V is a force of `force_per_v` in units of ω0²."""
    w = 2 * np.pi * frequency_hz
    mode = Mode(frequency_hz, damping, 1.0, 1.0 / w, 1.0, w / 343.0, 3.6 / w / (w / 343.0))
    return Plant(
        modes=(mode,),
        actuator=Actuator(gain=force_per_v * w**2),
        velocity_scale=0.25,
        drives="displacement",
    )


def van_der_pol(frequency_hz: float = 170.0) -> Plant:
    """v'' − d/dt(αv − γv³) + ω0² v = F ω0² sin ωt (Eq. 2.8), α = 1/4, γ = 1/3 (Table 2.4), so
    that the free amplitude √(4α/3γ) is 1. Time runs ω0 times faster; 1 V is F = 0.1."""
    plant = _oscillator(frequency_hz, 0.0, 0.1)
    w = 2 * np.pi * frequency_hz
    return replace(plant, characteristic=Characteristic((0.0, w / 4, 0.0, -w / 3)))


def duffing(frequency_hz: float = 170.0) -> Plant:
    """x'' + c x' + ω0² x − μ x³ = F cos ωt (Eq. 2.7), c = 0.06, |μ| = 0.25 (Table 2.3), of the
    softening kind that Fig. 2.10 and its text show. 1 V is F = 0.03."""
    plant = _oscillator(frequency_hz, 0.03, 0.03)
    w = 2 * np.pi * frequency_hz
    shape = Characteristic((0.0, 0.0, 0.0, 0.25 * w**2))
    return replace(plant, path="direct", characteristic=shape)


PRESETS: dict[str, Callable[[], Plant]] = {
    "thesis-two-mode": thesis_two_mode,
    "thesis-four-mode": thesis_four_mode,
    "quiet-tube": quiet_tube,
    "van-der-pol": van_der_pol,
    "duffing": duffing,
}
