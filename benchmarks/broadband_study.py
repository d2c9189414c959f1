"""Verdicts on broadband records of oscillators that lack something, by what is known of the noise.

    python benchmarks/broadband_study.py [--count 3] [--declared linear] [--jobs 2] [--sweep]

An oscillator under a random-phase multisine, or a sweep up and down, is integrated by an own
fine-stepped scheme, one effect added to it: some that the candidates name, some that they do not.
The linear oscillator is declared and the record diagnosed with the noise unknown, with the
excitation repeated, and with a quiet stretch at its end. Prints one line each: verdict, what is
claimed, and whether that is right, wrong or open; at the end, the counts. A wrong claim is worse
than «unexplained».
"""

import argparse
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import numba
import numpy as np
import numpy.typing as npt

from identify.broadband import BroadbandDiagnosis, Lines, diagnose_broadband

FloatArray = npt.NDArray[np.float64]

RATE, PERIOD, FINE = 600.0, 4096, 32
HZ, ZETA = 70.0, 0.05
KINDS = (
    "nothing", "cubic", "quadratic", "quintic", "friction", "cubic_damping", "input_cubic",
    "hysteresis", "second_mode", "output_square", "backlash", "softening", "clipped_input",
)  # fmt: skip
TRUE = {
    "cubic": {"nonlinearity_shape"},
    "quadratic": {"nonlinearity_shape"},
    "quintic": {"nonlinearity_shape"},
    "softening": {"nonlinearity_shape"},
    "friction": {"nonlinear_damping"},
    "cubic_damping": {"nonlinear_damping"},
    "input_cubic": {"actuator_nonlinearity"},
    "clipped_input": {"actuator_nonlinearity"},
    "backlash": {"nonlinearity_shape"},
    "hysteresis": {"nonlinearity_shape"},
}
NOISES = ("unknown", "repeated", "quiet stretch")


@numba.njit(cache=False)
def _spring(kind, y, size):  # type: ignore[no-untyped-def]
    if kind == 1:
        return y + size * y**3
    if kind == 2:
        return y + size * y**2
    if kind == 3:
        return y + size * y**5
    if kind == 10:  # none within a gap
        return (abs(y) - size) * np.sign(y) if abs(y) > size else 0.0
    if kind == 11:
        return np.sin(size * y) / size
    return y


@numba.njit(cache=False)
def _simulate(drive, w0, zeta, kind, size, h):  # type: ignore[no-untyped-def]
    """Semi-implicit midpoint steps of y″ = w₀²(u − spring) − 2ζw₀ y′ − …, from rest."""
    y, v, z = 0.0, 0.0, 0.0
    out = np.empty(drive.size)
    for i in range(drive.size):
        out[i] = y
        ym, vm = y, v
        force = 0.5 * (drive[i] + drive[(i + 1) % drive.size])
        for _ in range(3):
            a = w0 * w0 * (force - _spring(kind, ym, size)) - 2 * zeta * w0 * vm
            if kind == 4:
                a -= size * w0 * w0 * np.tanh(vm / (0.05 * w0))
            elif kind == 5:
                a -= 2 * zeta * w0 * size * vm**3 / w0**2
            elif kind == 7:  # Bouc–Wen: a spring that yields
                rate = vm - 2.0 * (0.5 * abs(vm) * z + 0.5 * vm * abs(z)) / size
                zm = z + 0.5 * h * rate
                a -= 0.5 * w0 * w0 * zm
            ym = y + 0.5 * h * (v + 0.5 * h * a)
            vm = v + 0.5 * h * a
        if kind == 7:
            z += h * rate
        y += h * vm
        v += h * a
    return out


def record(
    kind: str, seed: int, periods: int, repeated: bool, quiet: bool, sweep: bool
) -> tuple[FloatArray, FloatArray]:
    """Input and noisy output (samples,) of `periods` multisines, or of as long a sweep up and down
    (or of one a period, `repeated`): a linear output of size one."""
    rng = np.random.default_rng(seed)
    lines = np.arange(20, PERIOD * 3 // 10)

    def multisine() -> FloatArray:
        spectrum = np.zeros(PERIOD // 2 + 1, dtype=complex)
        spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
        u = np.fft.irfft(spectrum, PERIOD)
        return np.asarray(u / u.std())

    def swept(samples: int) -> FloatArray:
        share = np.arange(samples) / samples
        hz = 10.0 + 140.0 * (1 - np.abs(2 * share - 1))
        return np.asarray(np.sqrt(2) * np.sin(2 * np.pi * np.cumsum(hz) / RATE))

    one = multisine()
    if sweep:
        parts = [swept(PERIOD)] * periods if repeated else [swept(periods * PERIOD)]
    else:
        parts = [one if repeated else multisine() for _ in range(periods)]
    if quiet:
        parts.append(1e-4 * one)
    u = np.concatenate(parts)
    wide = np.zeros(u.size * FINE // 2 + 1, dtype=complex)
    wide[: u.size // 2 + 1] = np.fft.rfft(u)
    drive = np.fft.irfft(wide, u.size * FINE) * FINE
    w0, h = 2 * np.pi * HZ, 1 / (RATE * FINE)
    linear = _simulate(drive, w0, ZETA, 0, 0.0, h)[: periods * PERIOD * FINE].std()
    u, drive = u / linear, drive / linear
    push = drive.std()
    scale = float(10 ** rng.uniform(-1.0, 0.0))
    size = {
        "cubic": 0.1 * scale, "quadratic": 0.1 * scale, "quintic": 0.01 * scale,
        "friction": 0.1 * scale, "cubic_damping": scale, "input_cubic": 0.1 * scale / push**2,
        "hysteresis": 1.0 / scale, "output_square": 0.1 * scale, "backlash": 0.3 * scale,
        "softening": 0.4 * scale**0.5, "clipped_input": (2.5 - scale) * push,
        "second_mode": 0.3 * scale,
    }.get(kind, 0.0)  # fmt: skip
    if kind == "input_cubic":
        drive = drive + size * drive**3
    if kind == "clipped_input":
        drive = np.clip(drive, -size, size)
    y = _simulate(drive, w0, ZETA, KINDS.index(kind), size, h)
    if kind == "second_mode":
        y = y + size * _simulate(drive, 2.1 * w0, ZETA, 0, 0.0, h)
    if kind == "output_square":
        y = y + size * y**2
    y = y[::FINE]
    noise = float(10 ** rng.uniform(-3.0, -1.5)) * y[: periods * PERIOD].std()
    return u, y + noise * rng.standard_normal(y.size)


def diagnosed(task: tuple[str, int, str, str, bool]) -> tuple[str, int, str, BroadbandDiagnosis]:
    kind, seed, noise, declared, sweep = task
    repeated, quiet = noise == "repeated", noise == "quiet stretch"
    u, y = record(kind, seed, 5, repeated, quiet, sweep)
    found = diagnose_broadband(
        u, y, RATE,
        declared=declared,  # type: ignore[arg-type]
        estimation=slice(PERIOD, 4 * PERIOD),
        test=slice(4 * PERIOD, 5 * PERIOD),
        lines=Lines(tuple(PERIOD * i for i in range(1, 4)), PERIOD) if repeated else None,
        noise=slice(5 * PERIOD + 400, 6 * PERIOD) if quiet else None,
    )  # fmt: skip
    return kind, seed, noise, found


def judged(kind: str, found: BroadbandDiagnosis) -> str:
    """Right, wrong or open; a claim beside the true one counts as wrong."""
    claimed = {w.score.candidate.effect for w in found.claims}
    true = TRUE.get(kind, set())
    if found.verdict == "no_discrepancy":
        return "right" if kind == "nothing" else "unseen"
    if claimed - true:
        return "ambiguous" if found.verdict == "ambiguous" else "wrong"
    return (
        "right"
        if claimed and found.verdict == "traced"
        else "open, " + ("cause named" if claimed else "nothing claimed")
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--declared", default="linear")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--sweep", action="store_true", help="a sweep in place of a multisine")
    parser.add_argument("--kinds", nargs="*", default=KINDS)
    given = parser.parse_args()
    tasks = [
        (kind, seed, noise, given.declared, given.sweep)
        for kind in given.kinds
        for seed in range(given.first, given.first + given.count)
        for noise in NOISES
    ]
    counts: dict[str, Counter[str]] = {}
    with ProcessPoolExecutor(given.jobs) as pool:
        for kind, seed, noise, found in pool.map(diagnosed, tasks):
            outcome = judged(kind, found)
            counts.setdefault(noise, Counter())[outcome] += 1
            first, last = found.stages[0], found.final
            claims = ", ".join(w.score.candidate.kind for w in found.claims) or "nothing"
            print(
                f"{kind:<14}{seed:>4} {noise:<14}{outcome:<24}{found.verdict:<15}"
                f"{first.test_rms:8.4f} ->{last.test_rms:8.4f}  {claims}  {found.seconds:.0f} s",
                flush=True,
            )
    for noise, outcomes in counts.items():
        print(f"noise {noise}: {dict(outcomes)}")


if __name__ == "__main__":
    main()
