"""Clean recordings as arrays, and defects of graded size to put into them.

The clean campaign: a free run and forced ones locked to their drive, three harmonics, amplitude
and phase that follow Adler's equation, two microphones 5 cm apart, white noise, rumble common to
both, a 16-bit converter. Levels are those of the shared cases.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.signal import lfilter

from identify.record import Campaign, FloatArray, Medium, Run, Signal

RATE = 10000.0
FREE_HZ = 169.7
FREE_PA = 340.0
STEP_PA = 10 / 0.002 / 32768
CONDITIONS = ((164.0, 2.0), (166.0, 1.5), (168.0, 0.6), (171.0, 0.5), (173.0, 1.0), (178.0, 2.0))

Edit = Callable[[str, FloatArray, FloatArray], FloatArray]  # (channel, values, seconds) -> values


def run_of(
    name: str, frequency: float | None, volts: float, rng: np.random.Generator, seconds: float = 2.0
) -> Run:
    """One clean recording; `frequency` None: free."""
    n = round(seconds * RATE)
    t = np.arange(n) / RATE
    f = FREE_HZ if frequency is None else frequency
    if frequency is None:
        level, phase = FREE_PA, float(rng.uniform(0, 2 * np.pi))
    else:
        level = FREE_PA * (1 + volts)
        phase = float(np.arcsin(np.clip((f - FREE_HZ) / (6 * volts), -1, 1)))
    y = sum(
        a * np.cos(k * (2 * np.pi * f * t + phase) + k)
        for k, a in ((1, level), (2, 0.02 * level), (3, 0.006 * level))
    )
    rumble = lfilter([0.0373], [1, -0.963], rng.standard_normal(n)) * 4.0
    p1 = y + rumble + 0.3 * rng.standard_normal(n)
    p2 = 1.047 * y + rumble + 0.3 * rng.standard_normal(n)
    drive = volts * np.sin(2 * np.pi * f * t) if frequency is not None else np.zeros(n)
    drive = drive + 1e-4 * rng.standard_normal(n)
    signals = {
        "p1": _quantised(p1, "pressure", "Pa", 0.6604, STEP_PA),
        "p2": _quantised(p2, "pressure", "Pa", 0.7112, STEP_PA),
        "drive": _quantised(drive, "voltage", "V", None, 10 / 32768),
    }
    kind = "free" if frequency is None else "forced"
    asked = None if frequency is None else volts
    return Run(name, kind, RATE, signals, frequency, asked)  # type: ignore[arg-type]


def _quantised(x: FloatArray, quantity: str, unit: str, at: float | None, step: float) -> Signal:
    values = np.clip(np.round(x / step), -32768, 32767) * step
    return Signal(values, quantity, unit, at, 32768 * step, step)


def campaign_of(seed: int, seconds: float = 2.0) -> Campaign:
    """A free run and one for each of CONDITIONS."""
    rng = np.random.default_rng(seed)
    runs = [run_of("free", None, 0.0, rng, seconds)]
    runs += [run_of(f"{f:g}Hz", f, v, rng, seconds) for f, v in CONDITIONS]
    return Campaign(f"clean {seed}", tuple(runs), Medium())


def edited(campaign: Campaign, edit: Edit, *numbers: int) -> Campaign:
    """The campaign with `edit` applied to every channel of the runs `numbers` (all: none given)."""
    chosen = numbers or range(len(campaign.runs))
    runs = list(campaign.runs)
    for i in chosen:
        t = np.arange(runs[i].samples) / RATE
        signals = {
            n: replace(s, values=edit(n, np.array(s.values), t)) for n, s in runs[i].signals.items()
        }
        runs[i] = replace(runs[i], signals=signals)
    return replace(campaign, runs=tuple(runs))


def pressures(change: Callable[[FloatArray, FloatArray], FloatArray]) -> Edit:
    """An edit of the two pressure channels alike."""
    return lambda name, x, t: change(x, t) if name != "drive" else x


def one(channel: str, change: Callable[[FloatArray, FloatArray], FloatArray]) -> Edit:
    return lambda name, x, t: change(x, t) if name == channel else x


def clip(share: float) -> Edit:
    """The second microphone cut at `share` of its peak."""
    return one("p2", lambda x, t: np.clip(x, -share * np.abs(x).max(), share * np.abs(x).max()))


def drop(samples: int, at: int = 8371) -> Edit:
    """Samples lost in all channels: the record ends so much earlier."""
    return lambda name, x, t: np.delete(x, np.arange(at, at + samples))


def line(frequency: float, pascal: float, share2: float = 0.7) -> Edit:
    """A tone in both pressure channels."""

    def change(name: str, x: FloatArray, t: FloatArray) -> FloatArray:
        size = {"p1": pascal, "p2": share2 * pascal}.get(name, 0.0)
        return x + size * np.cos(2 * np.pi * frequency * t + 1.0)

    return change


def transient(size: float, seconds: float) -> Edit:
    """Amplitude that is `size` too large at first and settles exponentially."""
    return pressures(lambda x, t: x * (1 + size * np.exp(-t / seconds)))


def repeat(samples: int, at: int = 6000) -> Edit:
    """A buffer of every channel delivered twice instead of the next one."""

    def change(name: str, x: FloatArray, t: FloatArray) -> FloatArray:
        x[at + samples : at + 2 * samples] = x[at : at + samples]
        return x

    return change


def hold(samples: int, at: int = 6010) -> Edit:
    """The first microphone stuck at one value."""

    def change(x: FloatArray, t: FloatArray) -> FloatArray:
        x[at : at + samples] = x[at]
        return x

    return one("p1", change)
