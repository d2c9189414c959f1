"""What a declared model may lack: effects switched on by name and size, in the rig's own physics.

An effect is one small frozen dataclass: `name` and `location` are those of the diagnosis format,
`variant` tells several causes under one name apart, the fields are its physical parameters, each
with unit and a range from barely visible to gross. `apply` returns the rig with the effect in it.
To add one: write the class, put it into `VARIANTS`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar

import numpy as np

from drivers.types import is_number
from simulated_rig.config import Drift, DriveScatter, FlameModulation, Interference, RigConfig
from simulated_rig.cycle import free_amplitude
from simulated_rig.plant import Mode, Preform, SideResonator


def parameter(
    unit: str,
    barely: float,
    gross: float,
    signed: bool = False,
    graded: bool = True,
    turns: bool = False,
) -> Any:
    """A field of an effect: unit, and its range from barely visible to gross (log-uniform).

    One that is `signed` is drawn of either sign, one that `turns` may be asked for below zero too;
    one that is not `graded` (where a mode lies) says nothing of the effect's size.
    """
    return field(
        metadata={
            "unit": unit,
            "barely": barely,
            "gross": gross,
            "signed": signed,
            "graded": graded,
            "turns": turns,
        }
    )


@dataclass(frozen=True)
class Effect:
    """Root of the effects."""

    name: ClassVar[str]
    location: ClassVar[str]
    variant: ClassVar[str] = ""

    @property
    def key(self) -> str:
        return f"{self.name}/{self.variant}" if self.variant else self.name

    @classmethod
    def draw(cls, rng: np.random.Generator, size: float | None = None) -> "Effect":
        """A random one; `size` 0…1 places every graded parameter between barely and gross."""
        values = {}
        common = rng.uniform() if size is None else size
        for f in fields(cls):
            low, high = np.log(f.metadata["barely"]), np.log(f.metadata["gross"])
            at = common if f.metadata["graded"] else rng.uniform()
            sign = rng.choice([-1.0, 1.0]) if f.metadata["signed"] else 1.0
            values[f.name] = float(sign * np.exp(low + at * (high - low)))
        return cls(**values)

    def parameters(self) -> dict[str, dict[str, float | str]]:
        """Values and units by name."""
        return {
            f.name: {"value": getattr(self, f.name), "unit": f.metadata["unit"]}
            for f in fields(self)
        }

    def apply(self, config: RigConfig) -> RigConfig:
        raise NotImplementedError


@dataclass(frozen=True)
class FlameDelay(Effect):
    """Convective delay of the flame's response (n-τ)."""

    name = "flame_delay"
    location = "flame"
    delay_s: float = parameter("s", 5e-5, 1e-3)

    def apply(self, config: RigConfig) -> RigConfig:
        flame = config.plant.flame
        delay = flame.delay_s + self.delay_s
        return replace(config, plant=replace(config.plant, flame=replace(flame, delay_s=delay)))


@dataclass(frozen=True)
class FlamePole(Effect):
    """One more lag in the flame's response."""

    name = "flame_dynamics"
    location = "flame"
    variant = "extra_pole"
    pole_hz: float = parameter("Hz", 3000.0, 400.0)

    def apply(self, config: RigConfig) -> RigConfig:
        flame = config.plant.flame
        poles = (*flame.extra_poles_hz, self.pole_hz)
        return replace(
            config, plant=replace(config.plant, flame=replace(flame, extra_poles_hz=poles))
        )


@dataclass(frozen=True)
class SecondTimeScale(Effect):
    """A share of the response passes a slow lag besides."""

    name = "flame_dynamics"
    location = "flame"
    variant = "second_time_scale"
    slow_share: float = parameter("1", 0.005, 0.2)
    slow_pole_hz: float = parameter("Hz", 20.0, 60.0, graded=False)

    def apply(self, config: RigConfig) -> RigConfig:
        flame = replace(
            config.plant.flame, slow_share=self.slow_share, slow_pole_hz=self.slow_pole_hz
        )
        return replace(config, plant=replace(config.plant, flame=flame))


@dataclass(frozen=True)
class DistributedDelay(Effect):
    """Delay spread along the flame: a gamma distribution of three stages with that mean."""

    name = "flame_dynamics"
    location = "flame"
    variant = "distributed_delay"
    mean_delay_s: float = parameter("s", 5e-5, 8e-4)

    def apply(self, config: RigConfig) -> RigConfig:
        if self.mean_delay_s == 0.0:
            return config
        stages = 3
        pole_hz = stages / (2 * np.pi * self.mean_delay_s)
        flame = config.plant.flame
        poles = (*flame.extra_poles_hz, *[float(pole_hz)] * stages)
        return replace(
            config, plant=replace(config.plant, flame=replace(flame, extra_poles_hz=poles))
        )


@dataclass(frozen=True)
class HigherPower(Effect):
    """A further power of the characteristic, `share` of the linear term at the free cycle's z."""

    name = "nonlinearity_shape"
    location = "nonlinearity"
    power: ClassVar[int] = 5

    def _with(self, config: RigConfig, share: float) -> RigConfig:
        characteristic = config.plant.characteristic
        z = free_amplitude(config.plant)
        old = characteristic.coefficients
        new = [*old, *[0.0] * (self.power + 1 - len(old))]
        new[self.power] += share * characteristic.gain / z ** (self.power - 1)
        shape = replace(characteristic, coefficients=tuple(new))
        return replace(config, plant=replace(config.plant, characteristic=shape))


@dataclass(frozen=True)
class Quartic(HigherPower):
    """A fourth-power term."""

    variant = "quartic"
    power = 4
    quartic_share: float = parameter("1", 0.002, 0.1, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, self.quartic_share)


@dataclass(frozen=True)
class Quintic(HigherPower):
    """A fifth-power term; negative, so that large amplitudes stay bounded."""

    variant = "quintic"
    power = 5
    quintic_share: float = parameter("1", 0.002, 0.1)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, -self.quintic_share)


@dataclass(frozen=True)
class Preformed(Effect):
    """The characteristic's argument is deformed; widths relative to the free cycle's z."""

    name = "nonlinearity_shape"
    location = "nonlinearity"
    preform: ClassVar[Preform] = "none"

    def _with(self, config: RigConfig, relative: float) -> RigConfig:
        width = relative * free_amplitude(config.plant)
        shape = replace(config.plant.characteristic, preform=self.preform, width=width)
        return replace(config, plant=replace(config.plant, characteristic=shape))


@dataclass(frozen=True)
class Saturation(Preformed):
    """tanh saturation."""

    variant = "saturation"
    preform = "tanh"
    saturation_width: float = parameter("1", 20.0, 3.0)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, self.saturation_width)


@dataclass(frozen=True)
class DeadZone(Preformed):
    """No response to small signals."""

    variant = "dead_zone"
    preform = "dead_zone"
    dead_zone_width: float = parameter("1", 0.002, 0.05)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, self.dead_zone_width)


@dataclass(frozen=True)
class Hysteresis(Preformed):
    """Backlash: two branches."""

    variant = "hysteresis"
    preform = "play"
    hysteresis_width: float = parameter("1", 0.001, 0.03)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, self.hysteresis_width)


@dataclass(frozen=True)
class QuadraticLoss(Effect):
    """Vortex shedding at the open end: loss ∝ |u| u."""

    name = "nonlinear_damping"
    location = "forward"
    variant = "quadratic"
    quadratic_per_m: float = parameter("1/m", 0.3, 20.0)

    def apply(self, config: RigConfig) -> RigConfig:
        end = replace(config.plant.open_end, quadratic_per_m=self.quadratic_per_m)
        return replace(config, plant=replace(config.plant, open_end=end))


@dataclass(frozen=True)
class CubicLoss(Effect):
    """Loss ∝ u³ at the open end."""

    name = "nonlinear_damping"
    location = "forward"
    variant = "cubic"
    cubic_s_per_m2: float = parameter("s/m^2", 0.3, 30.0)

    def apply(self, config: RigConfig) -> RigConfig:
        end = replace(config.plant.open_end, cubic_s_per_m2=self.cubic_s_per_m2)
        return replace(config, plant=replace(config.plant, open_end=end))


@dataclass(frozen=True)
class SpeakerResonance(Effect):
    """Cone or plenum: second order, unit gain at zero frequency."""

    name = "actuator_dynamics"
    location = "actuator"
    variant = "resonance"
    resonance_hz: float = parameter("Hz", 1500.0, 120.0)
    damping: float = parameter("1", 0.5, 0.1, graded=False)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = replace(
            config.plant.actuator, resonance_hz=self.resonance_hz, damping=self.damping
        )
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class VoiceCoil(Effect):
    """The coil's inductance: a first-order lag."""

    name = "actuator_dynamics"
    location = "actuator"
    variant = "voice_coil"
    pole_hz: float = parameter("Hz", 20000.0, 300.0)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = replace(config.plant.actuator, pole_hz=self.pole_hz)
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class SpeakerDelay(Effect):
    """Sound takes time from the cone to the tube."""

    name = "actuator_dynamics"
    location = "actuator"
    variant = "delay"
    delay_s: float = parameter("s", 5e-6, 5e-4)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = config.plant.actuator
        actuator = replace(actuator, delay_s=actuator.delay_s + self.delay_s)
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class Compression(Effect):
    """Amplitude compression between the recorded drive and the sound, or expansion: u − κ u³."""

    name = "actuator_nonlinearity"
    location = "actuator"
    variant = "compression"
    cubic_per_v2: float = parameter("1/V^2", 0.0005, 0.03, turns=True)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = replace(config.plant.actuator, cubic_per_v2=self.cubic_per_v2)
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class Distortion(Effect):
    """Even distortion of the speaker: u + κ u²."""

    name = "actuator_nonlinearity"
    location = "actuator"
    variant = "distortion"
    quadratic_per_v: float = parameter("1/V", 0.001, 0.05, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = replace(config.plant.actuator, quadratic_per_v=self.quadratic_per_v)
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class Clipping(Effect):
    """The amplifier clips at that many volts of recorded drive."""

    name = "actuator_nonlinearity"
    location = "actuator"
    variant = "clipping"
    clip_v: float = parameter("V", 2.2, 1.0)

    def apply(self, config: RigConfig) -> RigConfig:
        actuator = replace(config.plant.actuator, clip_v=self.clip_v)
        return replace(config, plant=replace(config.plant, actuator=actuator))


@dataclass(frozen=True)
class AcousticMode(Effect):
    """A further mode; its residues relative to those of the first mode."""

    name = "acoustic_mode"
    location = "forward"
    frequency_hz: float = parameter("Hz", 300.0, 620.0, graded=False)
    damping: float = parameter("1", 0.01, 0.08, graded=False)
    flame_residue_ratio: float = parameter("1", 0.01, 0.8, signed=True)
    speaker_residue_ratio: float = parameter("1", 0.01, 0.8, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        plant = config.plant
        first = plant.modes[0]
        k = 2 * np.pi * self.frequency_hz / plant.sound_speed_m_s
        # D as the first mode's shrunk by the frequency ratio (the table's 1/k²), ψ by what
        # then remains of the residues ψ_f D and ψ_a D.
        shrink = first.frequency_hz / self.frequency_hz
        mode = Mode(
            frequency_hz=self.frequency_hz,
            damping=self.damping,
            psi_flame=first.psi_flame * self.flame_residue_ratio / shrink,
            velocity=first.velocity * shrink,
            psi_speaker=first.psi_speaker * self.speaker_residue_ratio / shrink,
            wavenumber=float(k),
            pressure=first.pressure * shrink,
        )
        return replace(config, plant=replace(plant, modes=(*plant.modes, mode)))


@dataclass(frozen=True)
class SideBranch(Effect):
    """A Helmholtz resonator beside the tube."""

    name = "side_resonator"
    location = "forward"
    frequency_hz: float = parameter("Hz", 120.0, 420.0, graded=False)
    damping: float = parameter("1", 0.02, 0.08, graded=False)
    coupling: float = parameter("1", 0.001, 0.05)

    def apply(self, config: RigConfig) -> RigConfig:
        branch = SideResonator(self.frequency_hz, self.damping, self.coupling)
        plant = replace(config.plant, resonators=(*config.plant.resonators, branch))
        return replace(config, plant=plant)


@dataclass(frozen=True)
class SecondMicrophone(Effect):
    """A fault of the second microphone against the first."""

    name = "channel_mismatch"
    location = "sensor"

    def _with(self, config: RigConfig, **change: float) -> RigConfig:
        first, second = config.microphones
        return replace(config, microphones=(first, replace(second, **change)))


@dataclass(frozen=True)
class GainMismatch(SecondMicrophone):
    """Its sensitivity is off by that much."""

    variant = "gain"
    gain: float = parameter("1", 2e-4, 0.03, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, gain=1.0 + self.gain)


@dataclass(frozen=True)
class Skew(SecondMicrophone):
    """It shows a signal common to both that much later (a multiplexed converter)."""

    variant = "skew"
    skew_s: float = parameter("s", 5e-7, 5e-5, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, skew_s=self.skew_s)


@dataclass(frozen=True)
class MicrophoneLowpass(SecondMicrophone):
    """Its own bandwidth is limited."""

    variant = "lowpass"
    lowpass_hz: float = parameter("Hz", 60000.0, 2000.0)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, lowpass_hz=self.lowpass_hz)


@dataclass(frozen=True)
class SensorOffset(Effect):
    """The velocity is measured that far from the flame."""

    name = "sensor_offset"
    location = "sensor"
    offset_m: float = parameter("m", 0.002, 0.1, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return replace(config, plant=replace(config.plant, sensor_offset_m=self.offset_m))


@dataclass(frozen=True)
class Mains(Effect):
    """Hum in both channels, unequally, with its third harmonic."""

    name = "interference"
    location = "sensor"
    variant = "mains"
    hum_pa: float = parameter("Pa", 0.05, 10.0)

    def apply(self, config: RigConfig) -> RigConfig:
        hum = Interference(50.0, self.hum_pa, share2=0.7, harmonics=(0.1, 0.3))
        return replace(config, interference=(*config.interference, hum))


@dataclass(frozen=True)
class ForeignTone(Effect):
    """A foreign tone in the channels."""

    name = "interference"
    location = "sensor"
    variant = "tone"
    tone_hz: float = parameter("Hz", 90.0, 600.0, graded=False)
    tone_pa: float = parameter("Pa", 0.05, 10.0)

    def apply(self, config: RigConfig) -> RigConfig:
        tone = Interference(self.tone_hz, self.tone_pa, share2=0.5)
        return replace(config, interference=(*config.interference, tone))


@dataclass(frozen=True)
class Drifting(Effect):
    """A parameter changes linearly; by the stated share after 1200 s."""

    name = "parameter_drift"
    location = "experiment"

    def _with(self, config: RigConfig, drift: Drift) -> RigConfig:
        return replace(config, drifts=(*config.drifts, drift))


@dataclass(frozen=True)
class FrequencyDrift(Drifting):
    """All modal frequencies (temperature)."""

    variant = "frequency"
    frequency_change: float = parameter("1", 1e-4, 0.01, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, Drift("frequency", self.frequency_change))


@dataclass(frozen=True)
class FrequencyWalk(Drifting):
    """The same as a random walk with that standard deviation after 1200 s."""

    variant = "frequency_walk"
    frequency_walk: float = parameter("1", 1e-4, 0.006)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, Drift("frequency", self.frequency_walk, kind="walk"))


@dataclass(frozen=True)
class DampingDrift(Drifting):
    """All damping ratios."""

    variant = "damping"
    damping_change: float = parameter("1", 0.01, 0.5, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, Drift("damping", self.damping_change))


@dataclass(frozen=True)
class FlameGainDrift(Drifting):
    """The flame's gain (fuel)."""

    variant = "flame_gain"
    flame_gain_change: float = parameter("1", 0.001, 0.1, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, Drift("flame_gain", self.flame_gain_change))


@dataclass(frozen=True)
class SpeakerDrift(Drifting):
    """The speaker's gain (a warming coil)."""

    variant = "speaker_gain"
    speaker_gain_change: float = parameter("1", 5e-4, 0.1, signed=True)

    def apply(self, config: RigConfig) -> RigConfig:
        return self._with(config, Drift("speaker_gain", self.speaker_gain_change))


@dataclass(frozen=True)
class GainModulation(Effect):
    """Slow random modulation of the flame's gain."""

    name = "flame_gain_modulation"
    location = "flame"
    modulation_rms: float = parameter("1", 0.001, 0.03)
    corner_hz: float = parameter("Hz", 0.3, 3.0, graded=False)

    def apply(self, config: RigConfig) -> RigConfig:
        return replace(config, modulation=FlameModulation(self.modulation_rms, self.corner_hz))


@dataclass(frozen=True)
class RunScatter(Effect):
    """Drive amplitude and phase differ from run to run at random."""

    name = "drive_scatter"
    location = "actuator"
    gain_rms: float = parameter("1", 5e-4, 0.05)
    phase_rms_rad: float = parameter("rad", 5e-4, 0.05)

    def apply(self, config: RigConfig) -> RigConfig:
        return replace(config, scatter=DriveScatter(self.gain_rms, self.phase_rms_rad))


VARIANTS: tuple[type[Effect], ...] = (
    FlameDelay,
    FlamePole,
    SecondTimeScale,
    DistributedDelay,
    Quartic,
    Quintic,
    Saturation,
    DeadZone,
    Hysteresis,
    QuadraticLoss,
    CubicLoss,
    SpeakerResonance,
    VoiceCoil,
    SpeakerDelay,
    Compression,
    Distortion,
    Clipping,
    AcousticMode,
    SideBranch,
    GainMismatch,
    Skew,
    MicrophoneLowpass,
    SensorOffset,
    Mains,
    ForeignTone,
    FrequencyDrift,
    FrequencyWalk,
    DampingDrift,
    FlameGainDrift,
    SpeakerDrift,
    GainModulation,
    RunScatter,
)
#: Effects by key: ``name`` or ``name/variant``.
EFFECTS: dict[str, type[Effect]] = {
    (f"{v.name}/{v.variant}" if v.variant else v.name): v for v in VARIANTS
}


FAR = 100.0  # beyond barely visible and gross; farther off, a parameter is taken for a slip


def _require_plausible(key: str, kind: type[Effect], parameters: Mapping[str, Any]) -> None:
    for f in fields(kind):
        told = f.metadata
        value, high = parameters[f.name], FAR * max(told["barely"], told["gross"])
        vanishes = told["graded"] and told["gross"] > told["barely"]
        low = 0.0 if vanishes else min(told["barely"], told["gross"]) / FAR
        if told["signed"] or told["turns"]:
            low = -high
        if not is_number(value) or not low <= value <= high:
            raise ValueError(
                f"effect {key!r}: {f.name}={value!r} is not a number from {low:g} to {high:g} "
                f"({told['unit']})"
            )


def make_effect(key: str, parameters: Mapping[str, float]) -> Effect:
    """The effect of that name whose parameters these are.

    `key` may leave the variant out: ``make_effect("actuator_dynamics", {"pole_hz": 800.0})``.

    Raises
    ------
    ValueError
        Unknown name, no variant with exactly these parameters, or a value far from any that an
        experiment could show.
    """
    if not isinstance(parameters, Mapping):
        raise ValueError(f"effect {key!r}: parameters={parameters!r} is not a table")
    chosen = [v for v in VARIANTS if key in (v.name, f"{v.name}/{v.variant}")]
    if not chosen:
        raise ValueError(f"effect={key!r} is not one of {sorted(EFFECTS)}")
    for kind in chosen:
        if {f.name for f in fields(kind)} == set(parameters):
            _require_plausible(key, kind, parameters)
            return kind(**parameters)
    known = "; ".join(f"{v.variant or v.name}: {[f.name for f in fields(v)]}" for v in chosen)
    raise ValueError(f"parameters={sorted(parameters)} of effect {key!r} are not one of {known}")
