"""A whole rig as data: the plant, what changes while it runs, and the measuring chain.

`RigConfig` is what presets make, effects change and simulations read. Frozen: an effect returns a
new one.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

from drivers.types import OutputLimits
from simulated_rig.plant import Plant

DriftTarget = Literal["frequency", "damping", "flame_gain", "speaker_gain", "sound_speed"]


@dataclass(frozen=True)
class Drift:
    """A relative change of `target` with rig time.

    ``linear``: `change` is reached after `over_s` and goes on at that rate. ``walk``: a random
    walk (in steps of `WALK_STEP_S`) whose standard deviation is `change` after `over_s`.
    """

    target: DriftTarget
    change: float
    over_s: float = 1200.0
    kind: Literal["linear", "walk"] = "linear"


@dataclass(frozen=True)
class FlameModulation:
    """Slow random change of the flame's gain: relative rms, and the corner of its spectrum."""

    rms: float = 0.0
    corner_hz: float = 1.0


@dataclass(frozen=True)
class DriveScatter:
    """What a run's drive differs by from the recorded one: relative gain, phase; one draw a run."""

    gain_rms: float = 0.0
    phase_rms_rad: float = 0.0


@dataclass(frozen=True)
class Interference:
    """A tone that gets into both pressure channels (Pa), `share2` of it into the second."""

    frequency_hz: float
    amplitude_pa: float
    share2: float = 1.0
    harmonics: tuple[float, ...] = ()  # relative amplitudes of 2f, 3f, ...


@dataclass(frozen=True)
class Microphone:
    """One pressure channel: place, sensitivity, and its own faults.

    `skew_s` > 0: it shows a signal common to all channels so much later. `lowpass_hz`: its own
    first-order bandwidth. `gain` multiplies the true pressure; what is recorded as the
    sensitivity stays `volts_per_pa`.
    """

    position_m: float
    volts_per_pa: float = 0.002
    gain: float = 1.0
    phase_rad: float = 0.0  # constant phase lag at `phase_at_hz`, realised as a delay
    phase_at_hz: float = 170.0
    skew_s: float = 0.0
    lowpass_hz: float | None = None
    noise_pa: float = 0.0  # rms
    noise_corner_hz: float | None = None  # None: white; else first-order coloured

    @property
    def delay_s(self) -> float:
        """How much later the channel shows a signal common to all."""
        return self.phase_rad / (2 * 3.141592653589793 * self.phase_at_hz) + self.skew_s


@dataclass(frozen=True)
class Converter:
    """The analogue-to-digital converter and the filters before it, all channels alike.

    `antialias`: ``linear_phase`` is a delta-sigma converter's; ``elliptic`` adds the thesis's
    eight-pole low-pass at 1.5 kHz (Section 5.1.2.3), whose phase is the same in every channel but
    not the same delay at every harmonic. `multiplex_s`: one converter for all channels, switched
    on to the next after that time (0: simultaneous). `clock_error`: relative error of the one clock
    that both input and output run on. `jitter_s`: rms of each sampling instant. `drops_per_s`:
    mean rate of lost quanta of frames in `SimulatedRig`.
    """

    full_scale_v: float = 10.0
    bits: int = 16
    drive_noise_v: float = 0.0
    antialias: Literal["linear_phase", "elliptic"] = "linear_phase"
    multiplex_s: float = 0.0
    clock_error: float = 0.0
    jitter_s: float = 0.0
    drops_per_s: float = 0.0


@dataclass(frozen=True)
class RumbleNoise:
    """Acoustic background in both microphones, the same pressure: coloured, not in the loop."""

    level_pa: float = 0.0
    corner_hz: float = 60.0


@dataclass(frozen=True)
class RigConfig:
    """Everything that `SimulatedRig` and `simulate_campaign` need."""

    plant: Plant
    microphones: tuple[Microphone, Microphone] = (
        Microphone(0.6604, noise_pa=0.2),
        Microphone(0.7112, noise_pa=0.2),
    )
    converter: Converter = Converter()
    rumble: RumbleNoise = RumbleNoise()
    interference: tuple[Interference, ...] = ()
    drifts: tuple[Drift, ...] = ()
    modulation: FlameModulation = FlameModulation()
    scatter: DriveScatter = DriveScatter()
    amplifier_noise_v: float = 0.0  # rms up to 50 kHz, between the recorded drive and the speaker
    sample_rate_hz: float = 10000.0
    limits: OutputLimits = field(default_factory=lambda: OutputLimits(max_amplitude_v=5.0))

    @property
    def true_rate_hz(self) -> float:
        """Frames per second of plant time: the nominal rate with the clock's error."""
        return self.sample_rate_hz * (1.0 + self.converter.clock_error)

    @property
    def microphones_m(self) -> tuple[float, ...]:
        return tuple(m.position_m for m in self.microphones)


def with_noise(config: RigConfig, noise_pa: float) -> RigConfig:
    """The same rig with microphones of that white noise (Pa rms in the whole band)."""
    first, second = (replace(m, noise_pa=noise_pa) for m in config.microphones)
    return replace(config, microphones=(first, second))
