"""The rig's physics as data: modes, flame, speaker, open end. No equations are solved here.

For mode i of the tube (thesis Eq. 4.12), with the flame's characteristic f and the drive's force a,

    η_i'' + 2 ζ_i ω_i η_i' + ω_i² η_i = ψ_i(x_f) · d/dt f(z) + ψ_i(x_a) · g_a · a
    Y = Σ_i D_i η_i'                                 velocity at the flame, in the model's unit
    q' + ω_f q = k_f Y,   z = q behind any further poles and delay

`velocity_scale` turns Y into m/s. A `path` of ``direct`` puts f(z) itself on the right-hand side
(a restoring force, as in Duffing's equation) and lets f act on η₁ (`drives="displacement"`).
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

Preform = Literal["none", "tanh", "dead_zone", "play"]
PREFORMS: tuple[Preform, ...] = ("none", "tanh", "dead_zone", "play")


@dataclass(frozen=True)
class Mode:
    """One acoustic mode; ψ and D as in the thesis's Tables 4.1 and 4.7.

    `wavenumber` k (rad/m) and `phase` extend them to other places, ψ(x) ∝ cos(k x + phase) and
    D(x) ∝ sin(k x + phase); phase is 0 for a tube whose end x = 0 is closed, −π/2 where it is
    open. `pressure` is the common pressure's shape at the microphones, in the unit of ∫ D dx.
    """

    frequency_hz: float
    damping: float
    psi_flame: float
    velocity: float
    psi_speaker: float
    wavenumber: float
    pressure: float
    phase: float = 0.0


@dataclass(frozen=True)
class Flame:
    """From velocity to the characteristic's argument: k_f/(s + ω_f), more poles, a delay.

    `slow_share` of the response passes a further first-order lag at `slow_pole_hz` (a second
    time scale in parallel); `extra_poles_hz` are lags of unit gain in series (several equal
    ones: a gamma-distributed delay).
    """

    gain: float = 30.0
    pole_hz: float = 100.0
    delay_s: float = 0.0
    extra_poles_hz: tuple[float, ...] = ()
    slow_share: float = 0.0
    slow_pole_hz: float = 10.0


@dataclass(frozen=True)
class Characteristic:
    """f(z) = Σ_k coefficients[k] · s(z)^k, where s is z itself or a `preform` of given `width`.

    tanh: width · tanh(z/width). dead_zone: what exceeds ±width. play: backlash of half-width
    `width`, a characteristic with two branches (thesis Fig. 1.5). Unit of `width`: that of z.
    """

    coefficients: tuple[float, ...] = (0.0, 22.5, -15000.0 / 4000.0**2, -200.0 / 4000.0**3)
    preform: Preform = "none"
    width: float = 1.0

    @property
    def gain(self) -> float:
        """Slope at zero, before any preform."""
        return self.coefficients[1] if len(self.coefficients) > 1 else 0.0


@dataclass(frozen=True)
class Actuator:
    """From the recorded drive (V) to the force on the modes.

    Order: static distortion, then delay, then first-order lag (voice coil), then the second-order
    resonances of the cone (`resonance_hz`, `damping`) and of the plenum that leads into the tube,
    each of unit gain at zero frequency, then `gain` (force per V).
    """

    gain: float = 1e10
    quadratic_per_v: float = 0.0
    cubic_per_v2: float = 0.0
    clip_v: float | None = None
    delay_s: float = 0.0
    pole_hz: float | None = None
    resonance_hz: float | None = None
    damping: float = 0.1
    plenum_hz: float | None = None
    plenum_damping: float = 0.1

    @property
    def resonances(self) -> tuple[tuple[float, float], ...]:
        """(frequency in Hz, damping) of those second-order parts that there are."""
        pairs = ((self.resonance_hz, self.damping), (self.plenum_hz, self.plenum_damping))
        return tuple((f, z) for f, z in pairs if f is not None)


@dataclass(frozen=True)
class OpenEnd:
    """Loss growing with the velocity u (m/s) at the open end, projected back on the modes.

    Of mode 1 alone it would add the damping rates `quadratic_per_m`·|u| and
    `cubic_s_per_m2`·u² (1/s) to 2 ζ ω. The quadratic law is vortex shedding's.
    """

    quadratic_per_m: float = 0.0
    cubic_s_per_m2: float = 0.0
    length_m: float = 1.524


@dataclass(frozen=True)
class SideResonator:
    """A Helmholtz resonator at `position_m`: y'' + 2ζω y' + ω² y = ω² Σ ψ_i(x_r) η_i,
    pushing back −coupling · ψ_i(x_r) · y'' on mode i."""

    frequency_hz: float
    damping: float
    coupling: float
    position_m: float = 0.3


@dataclass(frozen=True)
class Turbulence:
    """Noise inside the loop: a first-order coloured force, as of so many volts rms of drive."""

    level_v: float = 0.0
    corner_hz: float = 300.0


@dataclass(frozen=True)
class Plant:
    """Everything in the loop, in the units of the thesis's tables; the scales make it SI."""

    modes: tuple[Mode, ...]
    flame: Flame = Flame()
    characteristic: Characteristic = Characteristic()
    actuator: Actuator = Actuator()
    open_end: OpenEnd = OpenEnd()
    resonators: tuple[SideResonator, ...] = ()
    turbulence: Turbulence = Turbulence()
    velocity_scale: float = 1e-7
    flame_position_m: float = 0.762
    path: Literal["derivative", "direct"] = "derivative"
    drives: Literal["velocity", "displacement"] = "velocity"
    lit: bool = True
    sensor_offset_m: float = 0.0
    density_kg_m3: float = 1.2
    sound_speed_m_s: float = 343.0
    seed_state: float = field(default=1e-3)

    def velocity_at(self, mode: Mode, position_m: float) -> float:
        """D of `mode` at a place, from its value at the flame by the ratio of sines.

        With the flame on a velocity node the ratio says nothing: the table's value stands.
        """
        at_flame = float(np.sin(mode.wavenumber * self.flame_position_m + mode.phase))
        if abs(at_flame) < 1e-3:
            return mode.velocity
        there = float(np.sin(mode.wavenumber * position_m + mode.phase))
        return mode.velocity * there / at_flame

    def psi_at(self, mode: Mode, position_m: float) -> float:
        """ψ of `mode` at a place, from its value at the flame by the ratio of cosines."""
        at_flame = float(np.cos(mode.wavenumber * self.flame_position_m + mode.phase))
        if abs(at_flame) < 1e-3:
            return mode.psi_flame
        there = float(np.cos(mode.wavenumber * position_m + mode.phase))
        return mode.psi_flame * there / at_flame
