"""A rig by name: preset, effects, noise, clock."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from drivers.protocols import Clock
from drivers.types import OutputLimits, is_number, require
from simulated_rig.clocks import RealClock, VirtualClock
from simulated_rig.config import RigConfig, with_noise
from simulated_rig.cycle import free_cycle
from simulated_rig.effects import make_effect
from simulated_rig.presets import PRESETS
from simulated_rig.rig import SimulatedRig
from simulated_rig.seal import SealedEffect, seal

Effects = Mapping[str, Mapping[str, float]] | SealedEffect | Literal["sealed"]


def build_config(
    preset: str = "thesis-two-mode",
    seed: int = 0,
    effects: Effects | None = None,
    noise_db: float | None = None,
    sample_rate_hz: float = 10000.0,
    limits: OutputLimits | None = None,
) -> RigConfig:
    """The rig of that name as data; see `build_rig`."""
    if preset not in PRESETS:
        raise ValueError(f"preset={preset!r} is not one of {sorted(PRESETS)}")
    whole = isinstance(seed, int) and not isinstance(seed, bool)
    require(whole and seed >= 0, "seed", seed, "a whole number >= 0")
    sampled = is_number(sample_rate_hz) and 1000 <= sample_rate_hz <= 200_000
    require(sampled, "sample_rate_hz", sample_rate_hz, "a rate from 1000 to 200000 Hz")
    quiet = noise_db is None or (is_number(noise_db) and 0 <= noise_db <= 140)
    require(quiet, "noise_db", noise_db, "a level from 0 to 140 dB")
    config = RigConfig(plant=PRESETS[preset](), sample_rate_hz=sample_rate_hz)
    if limits is not None:
        config = replace(config, limits=limits)
    if noise_db is not None:
        config = with_noise(config, noise_pa(config, noise_db))
    if effects == "sealed":
        effects = seal(seed)
    if isinstance(effects, SealedEffect):
        return effects.apply(config)
    table = effects is None or isinstance(effects, Mapping)
    require(table, "effects", effects, "a table of parameters by effect, or 'sealed'")
    for key, parameters in (effects or {}).items():
        config = make_effect(key, parameters).apply(config)
    return config


def noise_pa(config: RigConfig, noise_db: float) -> float:
    """White microphone noise `noise_db` below the free cycle, in pressure difference.

    The two-microphone velocity is made of the difference ρ Δx ω V of two channels, each of which
    brings its noise: noise_pa · √2 is `noise_db` below the rms ρ Δx ω V/√2 of the free cycle. A
    stable plant is given a velocity of 0.1 m/s to refer to.
    """
    cycle = free_cycle(config.plant)
    speed = cycle.velocity_m_s if cycle.exists else 0.1
    first = config.plant.modes[0].frequency_hz
    omega = 2 * 3.141592653589793 * (cycle.frequency_hz if cycle.exists else first)
    spacing = abs(config.microphones[1].position_m - config.microphones[0].position_m)
    difference = config.plant.density_kg_m3 * spacing * omega * speed
    return float(difference / 2 * 10 ** (-noise_db / 20))


def build_rig(
    preset: str = "thesis-two-mode",
    seed: int = 0,
    effects: Effects | None = None,
    noise_db: float | None = None,
    clock: Literal["virtual", "realtime"] | Clock = "virtual",
    sample_rate_hz: float = 10000.0,
    limits: OutputLimits | None = None,
    name: str | None = None,
) -> SimulatedRig:
    """A simulated rig behind `drivers.protocols.DuplexRig`.

    Parameters
    ----------
    preset : a key of `PRESETS`.
    seed : of all noise, and of the seal where `effects` is ``"sealed"``.
    effects : parameters by effect (``{"flame_delay": {"delay_s": 4e-4}}``), a `SealedEffect`, or
        ``"sealed"``: the one that ``seal(seed)`` draws.
    noise_db : white noise of the two-microphone velocity below the free limit cycle, over the
        whole band; None: 0.2 Pa a microphone.
    clock : ``virtual`` (waiting is simulating), ``realtime``, or a clock of your own.

    Raises
    ------
    ValueError
        Unknown preset or effect, parameters that do not belong to the effect, or a value that is
        not acceptable.

    Examples
    --------
    >>> rig = build_rig(effects={"flame_delay": {"delay_s": 4e-4}})
    >>> with rig:
    ...     rig.start()
    ...     block = rig.read(100)
    >>> block.samples.shape
    (100, 3)
    """
    config = build_config(preset, seed, effects, noise_db, sample_rate_hz, limits)
    chosen: Clock
    if clock == "virtual":
        chosen = VirtualClock()
    elif clock == "realtime":
        chosen = RealClock()
    elif not hasattr(clock, "sleep"):
        raise ValueError(f"clock={clock!r} is not 'virtual', 'realtime' or a clock")
    else:
        chosen = clock
    return SimulatedRig(config, seed, chosen, name or f"simulated rig ({preset})")
