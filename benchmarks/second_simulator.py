"""Tracing on campaigns of a second simulator, whose effects nobody has fitted the candidates to.

    python benchmarks/second_simulator.py                      every effect by itself, and pairs
    python benchmarks/second_simulator.py flame_delay/0.8ms    those named; joined by +: together
    python benchmarks/second_simulator.py --drawn 58           effect by effect, of any size
    python benchmarks/second_simulator.py --drawn 40 --pairs --first 1000    two at a time
    python benchmarks/second_simulator.py --strangers          what no candidate names: the place
    python benchmarks/second_simulator.py --out DIR            the folders are kept there

The thesis's tube of four modes (Tables 4.1, 4.2, 4.7), of which two are declared, by plain
Runge–Kutta; runs and noise as in recorded campaigns (2 s at 10 kHz, int16, 1.7e-4 of the
velocity). It shares nothing with the simulated rig, and its effects are written as another hand
would: a damping of one mode that drifts, a flame that leads, losses in one mode alone, a warming
that settles. Those that are drawn have random sizes, from hardly visible to gross, in another tube
each and at 0.15 to 6 times the noise. The strangers are effects that no candidate is a law for:
they should end as unexplained, at their place. Prints, for each, the verdict, what is claimed or
where it may lie, χ²/dof before and after, and seconds.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from scipy.io import wavfile
from scipy.signal import lfilter

import identify
from daq.importers import open_campaign
from identify.executor import executor
from identify.load import load_campaign

FloatArray = npt.NDArray[np.float64]
Numbers = tuple[float, ...]

RATE_HZ, STEPS = 10_000, 4  # integration steps a sample
H = 1 / (RATE_HZ * STEPS)
SETTLE_S, RECORD_S = 12, 2
MARGIN = RATE_HZ // 5 * STEPS  # on both sides of a record: filters and slopes end there
WAVE_NUMBERS = np.array([3, 5, 7, 9]) * np.pi / (2 * 1.524)
FLAME_M, MICROPHONES_M = 0.762, (0.6604, 0.7112)
DENSITY, VELOCITY_SCALE = 1.2, 3e-7  # kg/m³; m/s a unit of the thesis's Y
FORCE_PER_V = 1e10
NOISE_PA = 0.7
FIT = ((164, 2.0), (166, 1.5), (168, 0.5), (171, 0.4), (173, 0.8), (175, 1.2), (178, 1.8))
HELD_OUT = ((167, 0.6), (172, 2.0), (180, 1.8))
TWO_PI = 2 * np.pi

HEAD = """format = "campaign-folder/1"
title = "{title}"
sample_rate_hz = 10000.0
[medium]
density_kg_m3 = 1.2
sound_speed_m_s = 343.0
[declared_model]
modes = 2
flame = "first_order_lowpass"
nonlinearity = "polynomial"
nonlinearity_degree = 3
"""
CHANNEL = """[[channels]]
name = "{name}"
quantity = "{quantity}"
volts_per_unit = {volts}
unit = "{unit}"
full_scale_v = 10.0
"""


@dataclass(frozen=True)
class Tube:
    """The tube with everything that an effect may change."""

    modes: int = 2
    frequency_hz: Numbers = (168.79, 281.33, 393.86, 506.39)
    damping: Numbers = (0.01, 0.05, 0.05, 0.05)
    at_flame: Numbers = (-0.41, -0.24, 0.17, 0.13)
    velocity: Numbers = (-0.16, 0.10, 0.071, -0.055)
    at_speaker: Numbers = (-0.22, -0.34, -0.032, 0.179)
    flame_rate: float = TWO_PI * 100
    flame_gain: float = 30.0
    powers: Numbers = (22.5, -15000 / 4000**2, -200 / 4000**3, 0.0)  # of q, q², q³, q⁵
    saturation: float = np.inf  # of the linear term, tanh
    quadratic_odd: float = 0.0
    # (b0 + b1 s + b2 s²)/(a0 + a1 s + s²) on the velocity before the flame
    flame_filter: Numbers = (1e6, 1e3, 1.0, 1e6, 1e3)
    delay_s: float = 0.0
    loss: tuple[float, int, bool] = (0.0, 2, False)  # size, power, on the velocity or mode 1 alone
    drive: Callable[[FloatArray], FloatArray] = lambda v: v
    speaker: Callable[[complex], complex] = lambda s: 1.0
    upper_microphone: Callable[[FloatArray], Any] | None = None
    measured: Numbers = (1.0, 1.0, 1.0, 1.0)  # each mode's velocity there over the flame's
    tones: tuple[tuple[float, float], ...] = ()  # Hz, Pa in both channels
    drift: Callable[["Tube", float], "Tube"] | None = None  # at a share of the campaign
    modulation: float = 0.0
    drive_scatter: tuple[float, float] = (0.0, 0.0)  # relative, rad
    rate_bend: float = 0.0  # of the flame's rate, by q²
    memory: tuple[float, float] = (0.0, 0.0)  # share of the linear term, 1/level (Bouc and Wen)
    stiffness: float = 0.0  # of mode 1's spring, by η²
    later_when_strong: float = 0.0  # more of the delay, by q²
    carried: tuple[float, float] = (0.0, 1e-3)  # share of the flame's force, and when, s
    hum_v: float = 0.0  # of 50 Hz at the speaker
    heating: float = 0.0  # of the voice coil: gain lost by V², without harmonics
    crosstalk: float = 0.0  # Pa in the upper channel by V of the drive
    microphones: tuple[Callable[[FloatArray], FloatArray], ...] = ()  # what each makes of Pa
    noise_pa: float = NOISE_PA


@numba.njit(cache=True)
def _earlier(past, i, part, delay):  # type: ignore[no-untyped-def]
    """What was so long before step i and a part, of a ring of samples up to step i."""
    where = i + part - delay / H
    at = int(np.floor(where))
    if at < 2:
        return 0.0
    n, t = past.size, where - at
    p1, p2 = past[at % n], past[(at + 1) % n]
    if at + 2 > i:  # linear at the newest, else cubic between four
        return p1 + t * (p2 - p1)
    p0, p3 = past[(at - 1) % n], past[(at + 2) % n]
    bend = 2 * p0 - 5 * p1 + 4 * p2 - p3 + t * (3 * (p1 - p2) + p3 - p0)
    return p1 + 0.5 * t * (p2 - p0 + t * bend)


@numba.njit(cache=True)
def _integrate(  # type: ignore[no-untyped-def]
    count, skip, w0, zeta, psi, D, psi_a, rate, gain, c, level, bent, filt, delay, loss, power,
    of_all, force, omega, modulation, rate_bend, memory, inverse_level, stiffness, late_bend,
    carried, carried_delay, hum,
):  # fmt: skip
    """Each mode's η and η' over `count` steps after `skip`, (2, count, modes). The state is η,
    η' − ψ f(q), q, the filter's two and a memory of q; so that no derivative of the characteristic
    is needed."""
    m = w0.size
    n = 2 * m + 4
    x, xx, k = np.zeros(n), np.zeros(n), np.zeros((4, n))
    x[0], x[2 * m] = 1.0, 300.0
    speed, out = np.zeros(m), np.zeros((2, count, m))
    past, forces = np.zeros(int(3 * delay / H) + 6), np.zeros(int(carried_delay / H) + 6)
    b0, b1, b2, a0, a1 = filt
    for i in range(skip + count):
        for stage in range(4):
            part = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
            for j in range(n):
                xx[j] = x[j] + (part * H * k[stage - 1, j] if stage else 0.0)
            q = xx[2 * m]
            linear = level * np.tanh(q / level) if level < 1e300 else q
            linear += memory * (xx[2 * m + 3] - q)
            f = c[0] * linear + c[1] * q**2 + c[2] * q**3 + c[3] * q**5 - bent * abs(q) * q
            f *= 1.0 + modulation[i]
            if stage == 0:
                forces[i % forces.size] = f
            if carried:
                f += carried * _earlier(forces, i, part, carried_delay)
            y = 0.0
            for j in range(m):
                speed[j] = xx[m + j] + psi[j] * f
                y += D[j] * speed[j]
            if stage == 0:
                past[i % past.size] = y
                if i >= skip:
                    out[0, i - skip] = xx[:m]
                    out[1, i - skip] = speed
            late = y
            if delay > 0:
                late = _earlier(past, i, part, delay * min(1 + late_bend * q * q, 3.0))
            s0, s1 = xx[2 * m + 1], xx[2 * m + 2]
            angle = omega * (i + part) * H
            u = hum * np.sin(TWO_PI * 50.0 * (i + part) * H)
            for h in range(3):
                a = (h + 1) * angle
                u += force[h].real * np.cos(a) - force[h].imag * np.sin(a)
            for j in range(m):
                lost = 0.0
                if of_all:
                    lost = loss * abs(y) ** (power - 1) * y * D[j]
                elif j == 0:
                    lost = loss * abs(speed[0]) ** (power - 1) * speed[0]
                k[stage, j] = speed[j]
                spring = 2 * zeta[j] * w0[j] * speed[j] + w0[j] ** 2 * xx[j]
                if j == 0:
                    spring += w0[0] ** 2 * stiffness * xx[0] ** 3
                k[stage, m + j] = psi_a[j] * u - spring - lost
            filtered = b2 * late + (b1 - b2 * a1) * s1 + (b0 - b2 * a0) * s0
            moved = gain * filtered - rate * (1 + rate_bend * q * q) * q
            k[stage, 2 * m] = moved
            k[stage, 2 * m + 3] = moved - inverse_level * abs(moved) * xx[2 * m + 3]
            k[stage, 2 * m + 1] = s1
            k[stage, 2 * m + 2] = late - a1 * s1 - a0 * s0
        for j in range(n):
            x[j] += H / 6 * (k[0, j] + 2 * k[1, j] + 2 * k[2, j] + k[3, j])
    return out


def _slope(x: FloatArray) -> FloatArray:
    """dx/dt to fourth order inside."""
    d = np.gradient(x, H)
    d[1:-1] -= (d[2:] - 2 * d[1:-1] + d[:-2]) / 6
    return d


def record(tube: Tube, frequency_hz: float, volts: float, rng: np.random.Generator) -> FloatArray:
    """One run's pressures in Pa and drive in V, shape (samples, 3)."""
    omega = TWO_PI * frequency_hz
    gain, phase = (size * rng.standard_normal() for size in tube.drive_scatter)
    tau = np.arange(4096) / 4096
    heated = volts / np.sqrt(1 + tube.heating * volts**2)
    wave = tube.drive(np.asarray((1 + gain) * heated * np.sin(TWO_PI * tau)))
    lines = 2 * np.fft.fft(wave)[1:4] / 4096 * FORCE_PER_V
    force = np.array(
        [f * tube.speaker(1j * k * omega) * np.exp(-1j * k * phase) for k, f in enumerate(lines, 1)]
    )
    count, skip = RECORD_S * RATE_HZ * STEPS + 2 * MARGIN, SETTLE_S * RATE_HZ * STEPS - MARGIN
    decay = np.exp(-TWO_PI * 3.0 * H)
    slow = lfilter([np.sqrt(1 - decay**2)], [1, -decay], rng.standard_normal(count + skip))
    each = (tube.frequency_hz, tube.damping, tube.at_flame, tube.velocity, tube.at_speaker)
    f, zeta, psi, D, psi_a = (np.array(x[: tube.modes]) for x in each)
    places, speeds = _integrate(
        count, skip, TWO_PI * f, zeta, psi, D, psi_a, tube.flame_rate, tube.flame_gain, tube.powers,
        tube.saturation, tube.quadratic_odd, tube.flame_filter, tube.delay_s, *tube.loss,
        force, omega, tube.modulation * slow, tube.rate_bend, *tube.memory, tube.stiffness,
        tube.later_when_strong, *tube.carried, FORCE_PER_V * tube.hum_v,
    )  # fmt: skip
    k = WAVE_NUMBERS[: tube.modes]
    seen = VELOCITY_SCALE * speeds @ (D * np.array(tube.measured[: tube.modes]))
    common = -3.6 * DENSITY * VELOCITY_SCALE * D / np.tan(k * FLAME_M) / k * (TWO_PI * f) ** 2
    mean = places @ common
    half = -0.5 * DENSITY * (MICROPHONES_M[1] - MICROPHONES_M[0]) * _slope(seen)
    pressures: list[FloatArray] = [mean - half, mean + half]
    if tube.upper_microphone is not None:
        response = tube.upper_microphone(np.fft.rfftfreq(count, H)[1:].astype(np.float64))
        spectrum = np.fft.rfft(pressures[1])
        spectrum[1:] *= response
        pressures[1] = np.fft.irfft(spectrum, count)
    pressures = [p[MARGIN:-MARGIN] for p in pressures]
    for i, made in enumerate(tube.microphones):
        pressures[i] = made(pressures[i])
    t = np.arange(RECORD_S * RATE_HZ) / RATE_HZ
    rumble = 0.3 * lfilter([1], [1, -0.95], rng.standard_normal(t.size))
    out = [p[::STEPS] + tube.noise_pa * (rumble + rng.standard_normal(t.size)) for p in pressures]
    out[1] = out[1] + tube.crosstalk * volts * np.sin(omega * t)
    for hz, size in tube.tones:
        out = [p + size * np.sin(TWO_PI * (hz * t + rng.uniform())) for p in out]
    return np.stack([*out, volts * np.sin(omega * t)], axis=1)


def write(tube: Tube, folder: Path, seed: int, title: str) -> None:
    """A campaign folder: a free run, seven to fit on, three held out, recorded in any order.

    Raises `OverflowError` where the oscillation grows without bound.
    """
    rng = np.random.default_rng([seed, 5])
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    text = HEAD.format(title=title)
    for name, place in zip(("p1", "p2"), MICROPHONES_M, strict=True):
        text += CHANNEL.format(name=name, quantity="pressure", volts=0.002, unit="Pa")
        text += f"position_m = {place}\n"
    text += CHANNEL.format(name="drive", quantity="voltage", volts=1.0, unit="V")
    runs = [(1.0, 0.0, "fit"), *((f, v, "fit") for f, v in FIT)]
    runs += [(f, v, "validation") for f, v in HELD_OUT]
    slots = [0, *(1 + rng.permutation(len(runs) - 1))]
    for i, ((frequency, volts, role), slot) in enumerate(zip(runs, slots, strict=True)):
        now = tube if tube.drift is None else tube.drift(tube, slot / (len(runs) - 1))
        signals = record(now, frequency, volts, rng) * np.array([0.002, 0.002, 1.0])
        if not np.isfinite(signals).all():
            raise OverflowError(f"{title}: run {i} grows without bound")
        counts = np.clip(np.round(signals / 10 * 2**15), -(2**15), 2**15 - 1)
        wavfile.write(folder / f"runs/{i:02d}.wav", RATE_HZ, counts.astype(np.int16))
        text += f'[[runs]]\nfile = "runs/{i:02d}.wav"\nstarted_s = {120 * slot}\n'
        text += f'role = "{role}"\nkind = "{"forced" if volts else "free"}"\n'
        if volts:
            text += f"frequency_hz = {frequency:.1f}\namplitude_v = {volts}\n"
    (folder / "campaign.toml").write_text(text)


def _lag(hz: float) -> Numbers:
    w, fast = TWO_PI * hz, 1e3  # a pole and a zero at `fast` cancel
    return (w * fast, w, 0.0, w * fast, w + fast)


def _lead(zero_hz: float, pole_hz: float) -> Numbers:
    z, w, fast = TWO_PI * zero_hz, TWO_PI * pole_hz, 1e3
    return (w * fast, w / z * (z + fast), w / z, w * fast, w + fast)


def _second(hz: float, zeta: float) -> Numbers:
    w = TWO_PI * hz
    return (w * w, 0.0, 0.0, w * w, 2 * zeta * w)


def _resonance(hz: float, zeta: float) -> Callable[[complex], complex]:
    w = TWO_PI * hz
    return lambda s: w * w / (s * s + 2 * zeta * w * s + w * w)


def _notch(hz: float, zeta: float, peak: float) -> Callable[[complex], complex]:
    w = TWO_PI * hz
    return lambda s: 1 + peak * 2 * zeta * w * s / (s * s + 2 * zeta * w * s + w * w)


def _heard_through(hz: float, zeta: float) -> Callable[[FloatArray], Any]:
    return lambda f: 1 / (1 + 2j * zeta * f / hz - (f / hz) ** 2)


def _with_play(width: float) -> Callable[[FloatArray], FloatArray]:
    """What follows one period of a drive with that play either way."""

    def moved(v: FloatArray) -> FloatArray:
        out, at = np.empty(2 * v.size), 0.0
        for i, x in enumerate(np.tile(v, 2)):
            out[i] = at = min(max(at, x - width), x + width)
        return out[v.size :]

    return moved


def _course(
    name: str, change: float, first: bool = False, settles: float = 0.0, after: float = 0.0,
    period: float = 0.0,
) -> Any:  # fmt: skip
    """A relative change of one of the tube's numbers (of all modes, or the first), linear, settling
    exponentially, at once `after` a share of the campaign, or to and fro within that `period`."""

    def now(tube: Tube, t: float) -> Tube:
        part = t
        if after:
            part = float(t > after)
        elif settles:
            part = 1 - np.exp(-t / settles)
        elif period:
            part = np.sin(TWO_PI * t / period)
        factor = 1 + change * part
        value = getattr(tube, name)
        if isinstance(value, float):
            value *= factor
        else:
            kept = 1 if first else len(value)
            value = (*(x * factor for x in value[:kept]), *value[kept:])
        moved: dict[str, Any] = {name: value}
        return replace(tube, **moved)

    return now


def _offset(metres: float) -> Numbers:
    ratio = np.sin(WAVE_NUMBERS * (FLAME_M + metres)) / np.sin(WAVE_NUMBERS * FLAME_M)
    return tuple(ratio.tolist())


def _bends(share: float, power: int) -> Callable[[FloatArray], FloatArray]:
    """A microphone that adds such a power of what it hears, by that share at 4 kPa."""
    return lambda p: p + share * p * (p / 4000) ** (power - 1)


BASE = Tube()
EFFECTS: dict[str, dict[str, Any]] = {
    "none": {},
    "acoustic_mode/third": {"modes": 3},
    "acoustic_mode/two": {"modes": 4},
    "nonlinear_damping/first_quadratic": {"loss": (8e-7, 2, False)},
    "nonlinear_damping/first_cubic": {"loss": (1.2e-13, 3, False)},
    "nonlinear_damping/velocity": {"loss": (3e-5, 2, True)},
    "flame_delay/0.15ms": {"delay_s": 0.15e-3},
    "flame_delay/0.8ms": {"delay_s": 0.8e-3},
    "flame_dynamics/pole": {"flame_filter": _lag(900)},
    "flame_dynamics/lead": {"flame_filter": _lead(800, 3000)},
    "flame_dynamics/second_order": {"flame_filter": _second(350, 0.4)},
    "nonlinearity_shape/quintic": {"powers": (*BASE.powers[:3], -2e-16)},
    "nonlinearity_shape/tanh": {"saturation": 3e4},
    "nonlinearity_shape/quadratic_odd": {"quadratic_odd": 1.5e-4},
    "actuator_dynamics/110Hz": {"speaker": _resonance(110, 0.2)},
    "actuator_dynamics/600Hz": {"speaker": _resonance(600, 0.3)},
    "actuator_dynamics/pole": {"speaker": lambda s: 1 / (1 + s / (TWO_PI * 400))},
    "actuator_dynamics/delay": {"speaker": lambda s: np.exp(-5e-4 * s)},
    "actuator_dynamics/highpass": {"speaker": lambda s: s / (s + TWO_PI * 60)},
    "actuator_dynamics/plenum": {
        "speaker": lambda s: _resonance(180, 0.5)(s) / (1 + s / (TWO_PI * 500))
    },
    "actuator_dynamics/notch": {"speaker": _notch(190, 0.15, -0.3)},
    "actuator_nonlinearity/unequal_halves": {"drive": lambda v: v + 0.02 * np.abs(v)},
    "actuator_nonlinearity/tanh": {"drive": lambda v: 3 * np.tanh(v / 3)},
    "actuator_nonlinearity/quadratic": {"drive": lambda v: v + 0.05 * v * v},
    "actuator_nonlinearity/cubic": {"drive": lambda v: v - 0.01 * v**3},
    "actuator_nonlinearity/clipping": {"drive": lambda v: np.clip(v, -1.5, 1.5)},
    "actuator_nonlinearity/crossover": {
        "drive": lambda v: np.sign(v) * np.maximum(np.abs(v) - 0.05, 0)
    },
    "actuator_nonlinearity/heating": {"heating": 0.04},
    "channel_mismatch/gain": {"upper_microphone": lambda f: 1.01},
    "channel_mismatch/skew": {"upper_microphone": lambda f: np.exp(2j * np.pi * 8e-6 * f)},
    "channel_mismatch/both": {
        "upper_microphone": lambda f: 0.985 * np.exp(-2j * np.pi * 12e-6 * f)
    },
    "channel_mismatch/lowpass": {"upper_microphone": lambda f: 1 / (1 + 1j * f / 6000)},
    "channel_mismatch/resonance": {"upper_microphone": _heard_through(2500, 0.3)},
    "channel_mismatch/highpass": {"upper_microphone": lambda f: 1j * f / (1j * f + 5)},
    "sensor_nonlinearity/cubic": {"microphones": (_bends(-0.01, 3),) * 2},
    "sensor_nonlinearity/lower": {"microphones": (_bends(0.003, 2),)},
    "sensor_offset/3cm": {"measured": _offset(-0.03)},
    "sensor_offset/6cm": {"measured": _offset(0.06)},
    "interference/mains": {"tones": ((50.0, 4.0), (150.0, 1.0))},
    "interference/tone": {"tones": ((131.7, 1.0),)},
    "parameter_drift/settling": {"drift": _course("frequency_hz", 0.004, settles=0.25)},
    "parameter_drift/first_frequency": {"drift": _course("frequency_hz", -0.003, first=True)},
    "parameter_drift/first_damping": {"drift": _course("damping", 0.1, first=True)},
    "parameter_drift/flame_input": {"drift": _course("flame_gain", 0.01)},
    "parameter_drift/flame_rate": {"drift": _course("flame_rate", 0.02)},
    "parameter_drift/speaker": {"drift": _course("at_speaker", 0.02)},
    "parameter_drift/speaker_settling": {"drift": _course("at_speaker", -0.02, settles=0.2)},
    "parameter_drift/frequency_step": {"drift": _course("frequency_hz", 0.002, after=0.45)},
    "parameter_drift/damping_cycle": {"drift": _course("damping", 0.05, period=0.8)},
    "flame_gain_modulation": {"modulation": 0.05},
    "drive_scatter/gain": {"drive_scatter": (0.01, 0.0)},
    "drive_scatter/phase": {"drive_scatter": (0.0, 0.02)},
}
PAIRS = (
    "flame_delay/0.15ms+channel_mismatch/gain",
    "acoustic_mode/third+parameter_drift/first_frequency",
    "acoustic_mode/third+flame_delay/0.8ms",
    "acoustic_mode/third+channel_mismatch/both",
    "actuator_dynamics/pole+nonlinearity_shape/quintic",
    "actuator_dynamics/delay+flame_delay/0.8ms",
    "actuator_nonlinearity/tanh+flame_dynamics/pole",
    "actuator_dynamics/110Hz+interference/mains",
    "channel_mismatch/skew+parameter_drift/flame_input",
    "nonlinear_damping/first_quadratic+sensor_offset/3cm",
    "nonlinearity_shape/tanh+parameter_drift/speaker",
    "flame_delay/0.15ms+nonlinear_damping/first_cubic",
)


#: What no candidate is a law for, by place: any of those before the stroke is right.
STRANGERS: dict[str, dict[str, Any]] = {
    "flame nonlinearity/slower when strong": {"rate_bend": 0.03 / 4000**2},
    "nonlinearity/Bouc-Wen memory": {"memory": (0.2, 1 / 2000)},
    "forward/stiffer when strong": {"stiffness": 1e-5 / 470**2},
    "actuator/motor follows displacement": {"drive": lambda v: v * (1 + 0.02 * np.roll(v, 1024))},
    "sensor/crosstalk of the drive": {"crosstalk": 0.5},
    "flame nonlinearity/later when strong": {"delay_s": 0.4e-3, "later_when_strong": 0.1 / 4000**2},
    "forward flame/carried to the end": {"carried": (0.03, 7e-3)},
    "actuator sensor/hum at the speaker": {"hum_v": 0.05},
    "experiment/flame steps": {"drift": _course("flame_gain", 0.02, after=0.6)},
    "experiment/flame's rate to and fro": {"drift": _course("flame_rate", 0.04, period=0.7)},
    "actuator/backlash": {"drive": _with_play(0.01)},
    "actuator/two notches": {
        "speaker": lambda s: _notch(190, 0.15, -0.3)(s) * _notch(340, 0.1, 0.4)(s)
    },
}


Random = np.random.Generator


def _size(rng: Random, low: float, high: float) -> float:
    """Any size between, by its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _signed(rng: Random, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0])) * _size(rng, low, high)


def _drawn_lead(rng: Random) -> Numbers:
    zero = _size(rng, 500, 2000)
    return _lead(zero, zero * _size(rng, 2, 6))


def _drawn_hum(rng: Random) -> tuple[tuple[float, float], ...]:
    size = _size(rng, 0.3, 8)
    return ((50.0, size), (150.0, 0.3 * size))


def _lag_of(hz: float) -> Callable[[complex], complex]:
    return lambda s: 1 / (1 + s / (TWO_PI * hz))


def _delay_of(seconds: float) -> Callable[[complex], complex]:
    return lambda s: complex(np.exp(-seconds * s))


def _highpass_of(hz: float) -> Callable[[complex], complex]:
    return lambda s: s / (s + TWO_PI * hz)


def _limited(level: float) -> Callable[[FloatArray], FloatArray]:
    return lambda v: level * np.tanh(v / level)


def _bent(size: float, power: int) -> Callable[[FloatArray], FloatArray]:
    return lambda v: v + size * v**power


def _unequal(size: float) -> Callable[[FloatArray], FloatArray]:
    return lambda v: v + size * np.abs(v)


def _other_gain(gain: float, skew_s: float = 0.0) -> Callable[[FloatArray], Any]:
    return lambda f: (1 + gain) * np.exp(2j * np.pi * skew_s * f)


DRAWN: dict[str, Callable[[Random], dict[str, Any]]] = {
    "acoustic_mode/third": lambda r: {"modes": 3},
    "acoustic_mode/two": lambda r: {"modes": 4},
    "nonlinear_damping/first_quadratic": lambda r: {"loss": (_size(r, 5e-8, 1.5e-6), 2, False)},
    "nonlinear_damping/first_cubic": lambda r: {"loss": (_size(r, 1e-14, 3e-13), 3, False)},
    "nonlinear_damping/velocity": lambda r: {"loss": (_size(r, 5e-6, 1e-4), 2, True)},
    "flame_delay": lambda r: {"delay_s": _size(r, 3e-5, 1.5e-3)},
    "flame_dynamics/pole": lambda r: {"flame_filter": _lag(_size(r, 400, 5000))},
    "flame_dynamics/lead": lambda r: {"flame_filter": _drawn_lead(r)},
    "flame_dynamics/second_order": lambda r: {
        "flame_filter": _second(_size(r, 300, 900), _size(r, 0.2, 0.8))
    },
    "nonlinearity_shape/quintic": lambda r: {"powers": (*BASE.powers[:3], -_size(r, 1e-17, 6e-16))},
    "nonlinearity_shape/tanh": lambda r: {"saturation": _size(r, 1.5e4, 1e5)},
    "nonlinearity_shape/quadratic_odd": lambda r: {"quadratic_odd": _signed(r, 2e-5, 4e-4)},
    "actuator_dynamics/resonance": lambda r: {
        "speaker": _resonance(_size(r, 90, 900), _size(r, 0.1, 0.5))
    },
    "actuator_dynamics/pole": lambda r: {"speaker": _lag_of(_size(r, 100, 2000))},
    "actuator_dynamics/delay": lambda r: {"speaker": _delay_of(_size(r, 1e-4, 3e-3))},
    "actuator_dynamics/highpass": lambda r: {"speaker": _highpass_of(_size(r, 20, 150))},
    "actuator_dynamics/notch": lambda r: {
        "speaker": _notch(_size(r, 150, 350), _size(r, 0.05, 0.3), -_size(r, 0.02, 0.6))
    },
    "actuator_nonlinearity/unequal_halves": lambda r: {"drive": _unequal(_signed(r, 3e-3, 0.1))},
    "actuator_nonlinearity/tanh": lambda r: {"drive": _limited(_size(r, 2, 8))},
    "actuator_nonlinearity/quadratic": lambda r: {"drive": _bent(_signed(r, 0.005, 0.1), 2)},
    "actuator_nonlinearity/cubic": lambda r: {"drive": _bent(_signed(r, 0.002, 0.04), 3)},
    "channel_mismatch/gain": lambda r: {"upper_microphone": _other_gain(_signed(r, 2e-3, 0.04))},
    "channel_mismatch/skew": lambda r: {
        "upper_microphone": _other_gain(0.0, _signed(r, 1e-6, 4e-5))
    },
    "channel_mismatch/both": lambda r: {
        "upper_microphone": _other_gain(_signed(r, 2e-3, 0.04), _signed(r, 1e-6, 4e-5))
    },
    "channel_mismatch/resonance": lambda r: {
        "upper_microphone": _heard_through(_size(r, 1200, 8000), _size(r, 0.05, 0.7))
    },
    "sensor_nonlinearity/both": lambda r: {
        "microphones": (_bends(_signed(r, 1e-3, 0.1), int(r.integers(2, 4))),) * 2
    },
    "sensor_nonlinearity/upper": lambda r: {
        "microphones": (lambda p: p, _bends(_signed(r, 1e-4, 0.02), int(r.integers(2, 4))))
    },
    "sensor_offset": lambda r: {"measured": _offset(_signed(r, 0.01, 0.08))},
    "interference/mains": lambda r: {"tones": _drawn_hum(r)},
    "parameter_drift/frequency": lambda r: {
        "drift": _course("frequency_hz", _signed(r, 3e-4, 1e-2))
    },
    "parameter_drift/damping": lambda r: {"drift": _course("damping", _signed(r, 0.01, 0.2))},
    "parameter_drift/flame_input": lambda r: {
        "drift": _course("flame_gain", _signed(r, 2e-3, 0.1))
    },
    "parameter_drift/speaker": lambda r: {"drift": _course("at_speaker", _signed(r, 3e-3, 0.1))},
    "parameter_drift/speaker_settling": lambda r: {
        "drift": _course("at_speaker", _signed(r, 3e-3, 0.1), settles=_size(r, 0.08, 0.5))
    },
    "parameter_drift/frequency_step": lambda r: {
        "drift": _course("frequency_hz", _signed(r, 3e-4, 1e-2), after=r.uniform(0.3, 0.7))
    },
    "parameter_drift/damping_step": lambda r: {
        "drift": _course("damping", _signed(r, 0.01, 0.2), after=r.uniform(0.3, 0.7))
    },
    "parameter_drift/frequency_cycle": lambda r: {
        "drift": _course("frequency_hz", _signed(r, 3e-4, 1e-2), period=r.uniform(0.5, 1.5))
    },
    "none": lambda r: {},
}


def drawn(seed: int, pairs: bool) -> tuple[str, Tube]:
    """One effect, by turns, or any two, of random size in a tube of its own."""
    rng = np.random.default_rng([seed, 99])
    some = [k for k in DRAWN if k != "none"]
    keys = [*rng.choice(some, 2, replace=False)] if pairs else [list(DRAWN)[seed % len(DRAWN)]]
    changes: dict[str, Any] = {}
    for key in keys:
        changes |= DRAWN[str(key)](rng)
    first, *others = BASE.damping
    tube = replace(
        BASE,
        damping=(first * rng.uniform(0.8, 1.15), *(d * rng.uniform(0.6, 1.4) for d in others)),
        frequency_hz=(
            BASE.frequency_hz[0], *(f * rng.uniform(0.97, 1.03) for f in BASE.frequency_hz[1:])
        ),
        flame_gain=BASE.flame_gain * rng.uniform(0.92, 1.15),
        flame_rate=BASE.flame_rate * rng.uniform(0.8, 1.25),
    )  # fmt: skip
    tube = replace(tube, **changes)
    return "+".join(map(str, keys)), replace(tube, noise_pa=NOISE_PA * _size(rng, 0.15, 6))


def with_effects(key: str) -> Tube:
    """The tube with the effects of that name, joined by +."""
    tube = BASE
    every = EFFECTS | STRANGERS
    for name in key.split("+"):
        if name not in every:
            raise SystemExit(f"effect={name!r} is not one of {', '.join(every)}")
        tube = replace(tube, **every[name])
    return tube


def told(found: dict[str, Any]) -> str:
    """The verdict, with what is claimed or, of several that explain the data, named."""
    if found["verdict"] == "traced":
        return "traced: " + " + ".join(e["effect"] for e in found["effects"])
    if found["verdict"] == "ambiguous":
        first = found["candidates"][0]
        named = [" + ".join(first["effects"]), *first["equivalent_to"]]
        return "ambiguous: " + " or ".join(named)
    where = found["whereabouts"]
    return str(found["verdict"]) + (f": {' or '.join(where['likely'])}" if where else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("effects", nargs="*", default=[*EFFECTS, *PAIRS])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--strangers", action="store_true", help="what no candidate names")
    parser.add_argument("--drawn", type=int, help="so many of random sizes in place of those named")
    parser.add_argument("--pairs", action="store_true", help="of those drawn: two at a time")
    parser.add_argument("--first", type=int, default=0, help="of those drawn: the first seed")
    options = parser.parse_args()
    if options.drawn is None:
        keys = STRANGERS if options.strangers else options.effects
        made = [(key, with_effects(key), 100 + i) for i, key in enumerate(keys)]
    else:
        seeds = range(options.first, options.first + options.drawn)
        made = [(*drawn(seed, options.pairs), 5000 + seed) for seed in seeds]
    with tempfile.TemporaryDirectory() as temporary, executor(2) as run:
        for key, tube, seed in made:
            name = key.replace("/", "_").replace(" ", "_") + (f"_{seed}" if options.drawn else "")
            folder = (options.out or Path(temporary)) / name
            try:
                write(tube, folder, seed, key)
            except OverflowError as error:
                print(error, flush=True)
                continue
            recorded = load_campaign(open_campaign(folder))
            begin = time.monotonic()
            found = identify.diagnose(recorded, executor=run).to_json()
            seconds = time.monotonic() - begin
            ends = [found[w] and found[w]["chi2_per_dof"] for w in ("before", "after")]
            left = " → ".join("–" if x is None else f"{x:.3g}" for x in ends)
            print(f"{key:52s} {told(found):60s} χ²/dof {left:18s} {seconds:5.1f} s", flush=True)


if __name__ == "__main__":
    main()
