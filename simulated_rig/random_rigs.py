"""Rigs drawn at random, widely, but always with a stable limit cycle that can be entrained.

What is drawn: one to three modes, their dampings and residues, the flame's pole, the loop's
growth rate, the characteristic's even term, the cycle's size, the speaker's gain, microphones,
noise. What is solved for: the flame's gain that gives the drawn growth rate (bisection on the
closed loop's eigenvalues). What is checked: every other pole is stable, the free cycle exists, is
steady, lies near the first mode and is of the wanted size.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from simulated_rig.build import noise_pa
from simulated_rig.campaigns import PlannedRun, lock_in_volts, plan_campaign
from simulated_rig.config import Converter, Microphone, RigConfig, RumbleNoise
from simulated_rig.cycle import free_cycle
from simulated_rig.effects import Effect
from simulated_rig.plant import Actuator, Characteristic, Flame, Mode, Plant, Turbulence
from simulated_rig.statespace import assemble

FLAME_M = 0.762
ATTEMPTS = 60
MOST_TWO = (1, 2, 2, 2, 3)  # numbers of modes to choose from, as laboratories declare


def closed_loop_poles(plant: Plant, gain: float) -> np.ndarray:
    """Eigenvalues (rad/s) of the loop closed with the characteristic's slope `gain`."""
    system = assemble(plant, (0.0, 0.05))
    return np.asarray(np.linalg.eigvals(system.a + np.outer(system.b[:, 0], system.z) * gain))


def _growth(plant: Plant) -> float:
    """Largest real part over the circular frequency of the first mode; of oscillating poles."""
    poles = closed_loop_poles(plant, plant.characteristic.gain)
    return float(np.max(poles.real)) / (2 * np.pi * plant.modes[0].frequency_hz)


def _modes(rng: np.random.Generator, count: int) -> tuple[Mode, ...]:
    frequency = float(np.exp(rng.uniform(np.log(110.0), np.log(260.0))))
    first = frequency
    modes = []
    for index in range(count):
        if index:
            frequency *= float(rng.uniform(1.35, 1.9))
        damping = np.exp(rng.uniform(np.log(0.005), np.log(0.025)))
        if index:
            damping = np.exp(rng.uniform(np.log(0.012), np.log(0.07)))
        shrink = first / frequency
        k = 2 * np.pi * frequency / 343.0
        velocity = -0.16 * shrink * float(rng.uniform(0.6, 1.3))
        # The first mode is the one that the flame drives: its ψ D is positive.
        psi_flame = -0.41 * shrink * float(rng.uniform(0.5, 1.3))
        sign = 1.0 if index == 0 else float(rng.choice([-1.0, 1.0]))
        psi_speaker = 0.22 * float(rng.uniform(0.5, 1.5)) * float(rng.choice([-1.0, 1.0]))
        excess = float(rng.uniform(0.8, 3.0)) * float(rng.choice([-1.0, 1.0]))
        modes.append(
            Mode(
                frequency_hz=frequency,
                damping=float(damping),
                psi_flame=psi_flame * sign,
                velocity=velocity,
                psi_speaker=psi_speaker * shrink,
                wavenumber=float(k),
                pressure=excess * abs(velocity) / float(k),
            )
        )
    return tuple(modes)


def _plant(rng: np.random.Generator, count: int) -> Plant | None:
    """One try; None where the draw has no good limit cycle."""
    modes = _modes(rng, count)
    pole_hz = modes[0].frequency_hz * float(np.exp(rng.uniform(np.log(0.3), np.log(1.5))))
    wanted = float(np.exp(rng.uniform(np.log(0.003), np.log(0.012))))
    shape = Characteristic((0.0, 22.5, 0.0, -200.0 / 4000.0**3))
    plant = Plant(modes=modes, flame=Flame(gain=1.0, pole_hz=pole_hz), characteristic=shape)
    low, high = 0.1, 3000.0
    if _growth(_driven(plant, high)) < wanted:
        return None
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if _growth(_driven(plant, middle)) < wanted else (low, middle)
    plant = _driven(plant, high)
    poles = closed_loop_poles(plant, shape.gain)
    unstable = poles[poles.real > 0]
    if unstable.size != 2 or np.any(unstable.imag == 0):
        return None
    offset = abs(np.abs(unstable[0].imag) / (2 * np.pi * modes[0].frequency_hz) - 1.0)
    if offset > 0.15:
        return None
    return _sized(rng, plant)


def _driven(plant: Plant, gain: float) -> Plant:
    return replace(plant, flame=replace(plant.flame, gain=gain))


def _sized(rng: np.random.Generator, plant: Plant) -> Plant | None:
    """Even term in proportion, velocity and speaker scaled to a laboratory's sizes."""
    cycle = free_cycle(plant)
    if not cycle.exists or cycle.steadiness > 1e-4:
        return None
    shape = plant.characteristic
    even = float(rng.uniform(-0.15, 0.15)) * shape.gain / cycle.z_peak
    shape = replace(shape, coefficients=(0.0, shape.gain, even, shape.coefficients[3]))
    plant = replace(plant, characteristic=shape)
    cycle = free_cycle(plant)
    if not cycle.exists or cycle.steadiness > 1e-4:
        return None
    if abs(cycle.frequency_hz / plant.modes[0].frequency_hz - 1) > 0.1:
        return None
    wanted = float(rng.uniform(0.1, 0.4))
    scale = plant.velocity_scale * wanted / cycle.velocity_m_s
    plant = replace(plant, velocity_scale=scale, actuator=Actuator(gain=1.0))
    cycle = replace(cycle, velocity_m_s=wanted)
    volts = lock_in_volts(RigConfig(plant), cycle, cycle.frequency_hz * 1.03)
    gain = volts / float(rng.uniform(0.3, 0.9))
    return replace(plant, actuator=Actuator(gain=gain))


def random_rig(
    seed: int,
    modes: Sequence[int] = (1, 2, 3),
    noise_db: float | tuple[float, float] = (30.0, 80.0),
    coloured: bool = False,
    turbulence_v: float = 0.0,
    bits: int = 24,
) -> RigConfig:
    """A rig drawn from `seed`.

    Parameters
    ----------
    modes : numbers of modes to choose from.
    noise_db : microphone noise below the free cycle (see `noise_pa`), or a range to draw from.
    coloured : noise of one decade's low-pass character instead of white, and rumble common to
        both microphones.
    turbulence_v : noise inside the loop, as of so many volts of drive.

    Raises
    ------
    ValueError
        When no draw has a stable limit cycle (has not been seen).
    """
    rng = np.random.default_rng([seed, 0x819])
    for _ in range(ATTEMPTS):
        plant = _plant(rng, int(rng.choice(np.array(modes))))
        if plant is not None:
            break
    else:
        raise ValueError(f"seed={seed}: no stable limit cycle in {ATTEMPTS} draws")
    plant = replace(plant, turbulence=Turbulence(turbulence_v))
    spacing = float(rng.uniform(0.04, 0.08))
    centre = 0.6858
    config = RigConfig(
        plant=plant,
        microphones=(
            Microphone(round(centre - spacing / 2, 4)),
            Microphone(round(centre + spacing / 2, 4)),
        ),
        converter=Converter(bits=bits),
    )
    level = noise_db if isinstance(noise_db, (int, float)) else float(rng.uniform(*noise_db))
    pascal = noise_pa(config, level)
    corner = float(np.exp(rng.uniform(np.log(100.0), np.log(1000.0)))) if coloured else None
    first, second = (
        replace(m, noise_pa=pascal, noise_corner_hz=corner) for m in config.microphones
    )
    rumble = RumbleNoise(level_pa=3 * pascal if coloured else 0.0)
    return replace(config, microphones=(first, second), rumble=rumble)


def random_campaign(
    seed: int,
    config: RigConfig,
    effects: Sequence[Effect] = (),
    forced: int = 8,
    validation: int = 3,
    cold: int = 0,
) -> tuple[RigConfig, tuple[PlannedRun, ...]]:
    """`config` with `effects`, and a plan that entrains it; ready for `simulate_campaign`.

    Raises
    ------
    ValueError
        When with these effects the rig has no limit cycle or cannot be entrained.
    """
    for effect in effects:
        config = effect.apply(config)
    return config, plan_campaign(config, seed, forced=forced, validation=validation, cold=cold)
