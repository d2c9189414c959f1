"""Controllers to try on the rig; first of all the phase shifter of the thesis's Fig. 1.4.

Any of them is told the microphones' pressures once a frame and answers with volts for the next:
as a `LinearController`, which runs inside the compiled loop, or as a Python function. Which one it
is changes speed only.

The phase shifter is a band-pass, a phase shift and a gain. The band-pass is one resonator with
two outputs, which at its centre are a quarter period apart, so that any phase is a sum of the two:

    x'' + (ω_c/Q) x' + ω_c² x = ω_c² p,     u = c_1 x + c_2 x'/ω_c

and (c_1, c_2) follow from the demand that, at the centre, the sampled filter with the loop's one
frame of delay have exactly the gain and the phase asked for. A new phase is two new numbers: the
resonator's state stays, and nothing jumps but the sum.

Whether that stabilises the tube is a question of linear algebra. With p = C x + D u at the frames,
u held over each, and Φ, Γ the plant linearised at rest over one frame,

    x⁺ = Φ x + Γ u,   s⁺ = A_c s + B_c p,   u⁺ = C_c s⁺,

and all eigenvalues inside the unit circle mean that the rest is stable. What noise then leaves is
the covariance of the same system (a discrete Lyapunov equation). The plant's flame must have a
slope at rest and no delay for this; the time-stepping loop itself has no such limit.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import expm

from simulated_rig.config import RigConfig
from simulated_rig.plant import Plant
from simulated_rig.statespace import DRIVE, FLAME, NOISE, FloatArray, assemble

#: From the microphones' pressures (Pa), once a frame, to volts held over the next frame.
Law = Callable[[FloatArray], float]


@dataclass(frozen=True)
class LinearController:
    """s⁺ = `a` s + `b` p, u⁺ = `c` s⁺, clipped to ±`limit_v`.

    `a` (n, n), `b` (n, microphones) per Pa, `c` (n,) in V.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    limit_v: float = 5.0

    @property
    def order(self) -> int:
        return int(self.a.shape[0])

    def response(self, frequency_hz: float, rate_hz: float) -> FloatArray:
        """Volts per Pa of each microphone, (microphones,) complex, the frame of delay included."""
        z = np.exp(2j * np.pi * frequency_hz / rate_hz)
        inner = np.linalg.solve(z * np.eye(self.order) - self.a, self.b.astype(complex))
        # s⁺ is z s; the output leaves one frame after the pressure that it answers.
        return np.asarray(self.c @ inner)


def no_controller(microphones: int = 2) -> LinearController:
    """Says 0 V to everything."""
    return LinearController(np.zeros((1, 1)), np.zeros((1, microphones)), np.zeros(1))


@dataclass(frozen=True)
class PhaseShifter:
    """Band-pass, phase shift, gain (thesis Fig. 1.4).

    `phase_rad` > 0: the volts lead the pressure at `center_hz`. `quality` is centre over −3 dB
    bandwidth. `microphone` is the index of the one that it hears.
    """

    center_hz: float = 170.0
    quality: float = 4.0
    phase_rad: float = 0.0
    gain_v_per_pa: float = 1e-4
    limit_v: float = 5.0
    microphone: int = 0

    def __post_init__(self) -> None:
        for name in ("center_hz", "quality", "limit_v"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name}={value!r} is not a finite number > 0")
        if not (np.isfinite(self.gain_v_per_pa) and self.gain_v_per_pa >= 0):
            raise ValueError(f"gain_v_per_pa={self.gain_v_per_pa!r} is not a finite number >= 0")

    def linear(self, rate_hz: float, microphones: int = 2) -> LinearController:
        """As sampled at `rate_hz`.

        Raises
        ------
        ValueError
            When the centre is not well below half the rate, or there is no such microphone.
        """
        if self.center_hz > rate_hz / 8:
            raise ValueError(
                f"center_hz={self.center_hz!r} is not at most rate/8 = {rate_hz / 8} Hz"
            )
        if not 0 <= self.microphone < microphones:
            raise ValueError(f"microphone={self.microphone!r} is not one of {microphones}")
        w = 2 * np.pi * self.center_hz
        # States x and x'/ω_c; p held over the frame.
        big = np.zeros((3, 3))
        big[0, 1] = w
        big[1] = [-w, -w / self.quality, w]
        held = expm(big / rate_hz)
        b = np.zeros((2, microphones))
        b[:, self.microphone] = held[:2, 2]
        c = np.zeros(2)
        bare = LinearController(held[:2, :2], b, c, self.limit_v)
        at_center = [
            replace(bare, c=row).response(self.center_hz, rate_hz)[self.microphone]
            for row in np.eye(2)
        ]
        wanted = self.gain_v_per_pa * np.exp(1j * self.phase_rad)
        system = np.array([np.real(at_center), np.imag(at_center)])
        c = np.linalg.solve(system, [wanted.real, wanted.imag])
        return replace(bare, c=c)


@dataclass(frozen=True)
class LinearPlant:
    """The plant at rest, one frame a step: x⁺ = `phi` x + `drive` u + `noise` w, p = `c` x + `d` u
    + `d_noise` w; (m, n) and (m,) with m microphones, Pa and V."""

    phi: FloatArray
    drive: FloatArray
    noise: FloatArray
    c: FloatArray
    d: FloatArray
    d_noise: FloatArray


def linear_plant(plant: Plant, microphones_m: tuple[float, ...], rate_hz: float) -> LinearPlant:
    """Linearise `plant` at rest, exactly over one frame with drive and noise held.

    Raises
    ------
    ValueError
        For a flame delay, and for characteristics without a slope at rest.
    """
    shape = plant.characteristic
    if plant.flame.delay_s > 0:
        raise ValueError(f"delay_s={plant.flame.delay_s!r} is not 0: the flame's delay has no pole")
    if shape.preform not in ("none", "tanh"):
        raise ValueError(f"preform={shape.preform!r} has no slope at rest")
    system = assemble(plant, microphones_m)
    slope = shape.gain if plant.lit else 0.0
    loop = system.a + slope * np.outer(system.b[:, FLAME], system.z)
    inputs = system.b[:, [DRIVE, NOISE]]
    # f' = slope · c_z x'
    rates = system.pressure + slope * np.outer(system.pressure_direct, system.z)
    n = system.order
    big = np.zeros((n + 2, n + 2))
    big[:n, :n], big[:n, n:] = loop, inputs
    size = np.ones(n + 2)
    size[: system.modes] = 1 / np.sqrt(-np.diag(system.a[system.modes :])[: system.modes])
    size[n:] = 1 / np.maximum(np.max(np.abs(inputs), axis=0), 1.0)
    held = expm(big / rate_hz / size[:, None] * size[None, :]) * size[:, None] / size[None, :]
    return LinearPlant(
        phi=held[:n, :n],
        drive=held[:n, n],
        noise=held[:n, n + 1],
        c=system.pressure_static + rates @ loop,
        d=rates @ inputs[:, 0],
        d_noise=rates @ inputs[:, 1],
    )


def closed_loop(plant: LinearPlant, controller: LinearController) -> FloatArray:
    """Transition matrix of (x, s, u) over one frame."""
    n, k = plant.phi.shape[0], controller.order
    out = np.zeros((n + k + 1, n + k + 1))
    out[:n, :n], out[:n, -1] = plant.phi, plant.drive
    out[n : n + k, :n] = controller.b @ plant.c
    out[n : n + k, n : n + k] = controller.a
    out[n : n + k, -1] = controller.b @ plant.d
    out[-1] = controller.c @ out[n : n + k]
    return out


def growth_rate(plant: LinearPlant, controller: LinearController, rate_hz: float) -> float:
    """Largest growth rate of the closed loop's poles, 1/s: < 0 where the controller stabilises."""
    poles = np.linalg.eigvals(closed_loop(plant, controller))
    return float(np.log(np.max(np.abs(poles))) * rate_hz)


def residual_pa(
    config: RigConfig, controller: LinearController, rate_hz: float, microphone: int = 0
) -> float:
    """Rms pressure that turbulence and microphone noise leave of a stabilised tube.

    Turbulence is the first-order process w⁺ = κ w + √(1 − κ²) ε of `config`, κ = e^{−2πf_c/rate}.

    Raises
    ------
    ValueError
        When the closed loop is unstable: then noise is not what bounds the pressure.
    """
    plant = linear_plant(config.plant, config.microphones_m, rate_hz)
    step = closed_loop(plant, controller)
    if np.max(np.abs(np.linalg.eigvals(step))) >= 1.0:
        raise ValueError("the closed loop is unstable: there is no stationary residual")
    n, k, m = plant.phi.shape[0], controller.order, plant.c.shape[0]
    turbulence = config.plant.turbulence
    keep = np.exp(-2 * np.pi * turbulence.corner_hz / rate_hz)
    # (x, s, u, w) driven by ε and the microphones' white noise.
    size = n + k + 2
    big, push = np.zeros((size, size)), np.zeros((size, 1 + m))
    big[:-1, :-1] = step
    big[:n, -1] = plant.noise
    big[n : n + k, -1] = controller.b @ plant.d_noise
    big[n + k, -1] = controller.c @ big[n : n + k, -1]
    big[-1, -1] = keep
    push[-1, 0] = turbulence.level_v * np.sqrt(1 - keep**2)
    hiss = np.diag([mic.noise_pa for mic in config.microphones])
    push[n : n + k, 1:] = controller.b @ hiss
    push[n + k, 1:] = controller.c @ push[n : n + k, 1:]
    # States of one size, or the solver loses digits.
    scale = np.ones(size)
    scale[: len(config.plant.modes)] = 1 / (2 * np.pi * config.plant.modes[0].frequency_hz)
    covariance = _stationary(big / scale[:, None] * scale[None, :], push / scale[:, None])
    row = np.concatenate(
        [plant.c[microphone], np.zeros(k), [plant.d[microphone], plant.d_noise[microphone]]]
    )
    row = row * scale
    return float(np.sqrt(row @ covariance @ row))


def _stationary(step: FloatArray, push: FloatArray) -> FloatArray:
    """P = Σ_k step^k push pushᵀ stepᵀ^k by doubling: a sum of positive terms, so no digits cancel
    where the direct solution of P = step P stepᵀ + push pushᵀ is ill-conditioned."""
    total, power = push @ push.T, step
    while True:
        added = power @ total @ power.T
        total = total + added
        if np.trace(added) <= 1e-14 * np.trace(total):
            return np.asarray(total)
        power = power @ power


@dataclass(frozen=True)
class PhaseSearch:
    """An adaptive phase: two looks on either side of it, then a step to the quieter one.

    A value; `step` returns the next. `level_db` is what the last window left of the pressure. The
    step is `rate_rad_per_db` times the difference, at most `largest_rad`. Assumes that the loop
    settles within one window, and that the level falls towards one best phase within ±π/2.
    """

    phase_rad: float
    dither_rad: float = np.deg2rad(12.0)
    rate_rad_per_db: float = np.deg2rad(3.0)
    largest_rad: float = np.deg2rad(15.0)
    side: int = 1
    other_db: float | None = None

    @property
    def applied_rad(self) -> float:
        """The phase to be set for the coming window."""
        return self.phase_rad + self.side * self.dither_rad

    def step(self, level_db: float) -> "PhaseSearch":
        """What to try after a window with `applied_rad` that measured `level_db`."""
        if self.other_db is None:
            return replace(self, side=-self.side, other_db=level_db)
        # `side` is where the newer level comes from.
        slope = self.side * (level_db - self.other_db)
        move = np.clip(-self.rate_rad_per_db * slope, -self.largest_rad, self.largest_rad)
        return replace(self, phase_rad=self.phase_rad + float(move), other_db=None)
