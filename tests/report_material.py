"""Fits, assessments and diagnoses for tests of the report and of the exports.

The loop is the thesis's two-mode tube (physics.md §1) in identified form; its steady states are
solved by harmonic balance, disturbed by seeded noise of known size, and fitted from the true
values. The «wrong» model is the same with other parameters, so that a misfit is visible.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from identify import balance
from identify.assess import assess, lock_in
from identify.dataset import build
from identify.effect import Conditions
from identify.fit import fit_orbits
from identify.harmonics import Harmonics
from identify.parameters import Estimate
from identify.record import Campaign, DeclaredModel, Medium, Run, Signal
from identify.results import (
    Assessment,
    Candidate,
    Diagnosis,
    Identification,
    QualityFlag,
    Residual,
    TracedEffect,
)
from identify.structure import Structure

FloatArray = npt.NDArray[np.float64]
FREE_HZ = 169.713
CONDITIONS = (  # Hz, V, role, seconds since the start
    (None, None, "fit", 0.0),
    (164.0, 2.0, "fit", 300.0),
    (166.0, 1.5, "fit", 120.0),
    (171.0, 0.4, "fit", 240.0),
    (175.0, 1.2, "fit", 180.0),
    (178.0, 1.8, "fit", 60.0),
    (167.0, 0.6, "validation", 360.0),
    (172.0, 2.0, "validation", 420.0),
)


def tube(structure: Structure | None = None, **changed: float) -> FloatArray:
    """Internal parameters of the tube (Tables 4.1, 4.2; velocity in m/s, drive in V)."""
    values = {
        "mode1.frequency_hz": 168.79,
        "mode1.damping": 0.010,
        "mode1.flame_residue": 44.28,
        "mode1.speaker_residue": 35.2,
        "mode2.frequency_hz": 281.33,
        "mode2.damping": 0.05,
        "mode2.flame_residue": -16.2,
        "mode2.speaker_residue": -34.0,
        "flame.pole_hz": 100.0,
        "flame.delay_s": 1.5e-4,
        "nonlinearity.c2": -1.25e4,
        "nonlinearity.c3": -1.25e7,
        **changed,
    }
    parameters = (structure or Structure()).parameters
    return parameters.unknowns(values)


def steady(structure: Structure, theta: FloatArray) -> list[tuple[float, npt.NDArray]]:
    """(frequency in Hz, velocity coefficients) of each of `CONDITIONS`."""
    out = []
    for hz, volts, _, _ in CONDITIONS:
        K = 8
        drive = np.zeros((1, K), dtype=complex)
        drive[0, 0] = volts or 0.0
        at = Conditions(
            omega=2 * np.pi * np.array([hz or FREE_HZ]),
            drive=drive,
            pressure=np.zeros((1, K), dtype=complex),
            velocity=np.zeros((1, K), dtype=complex),
            time=np.zeros(1),
            flame_on=np.ones(1),
            identity=np.zeros(1, dtype=np.int64),
            free=np.array([hz is None]),
            spacing_m=np.ones(1),
        )
        for phase in np.linspace(0, 2 * np.pi, 12, endpoint=False):  # until Newton finds it
            w = np.zeros((1, 1, K), dtype=complex)
            w[0, 0, 0] = (2e-4 if hz is None else 3e-4) * np.exp(1j * phase)
            orbits = balance.solve(structure, theta, at, start=w)
            if orbits.converged.all() and abs(orbits.velocity[0, 0]) > 0.05:
                break
        else:
            raise AssertionError(f"no steady state at {hz} Hz, {volts} V")
        out.append((float(orbits.omega[0] / (2 * np.pi)), orbits.velocity[0]))
    return out


def harmonics(structure: Structure, theta: FloatArray, noise: float = 1e-4) -> list[Harmonics]:
    """Measured harmonics of the campaign, white noise of `noise` times the free fundamental."""
    rng = np.random.default_rng(5)
    out = []
    orbits = steady(structure, theta)
    size = noise * abs(orbits[0][1][0])
    for (hz, volts, role, started), (frequency, y) in zip(CONDITIONS, orbits, strict=True):
        K = 6
        n = size * np.sqrt(0.5) * (rng.standard_normal(K) + 1j * rng.standard_normal(K))
        velocity = y[:K] + n
        if hz is None:
            velocity = velocity * np.exp(-1j * np.angle(velocity[0]) * np.arange(1, K + 1))
        drive = np.zeros(K, dtype=complex)
        drive[0] = volts or 0.0
        out.append(
            Harmonics(
                name="00_free" if hz is None else f"{hz:.0f}Hz_{volts}V",
                kind="free" if hz is None else "forced",
                role=role,
                frequency_hz=frequency + (1e-4 * rng.standard_normal() if hz is None else 0.0),
                frequency_stderr_hz=1e-4 if hz is None else 0.0,
                velocity=velocity,
                drive=drive,
                pressure=np.zeros(K, dtype=complex),
                covariance=np.eye(2 * K) * size**2 / 2,
                side=np.zeros((40, K), dtype=complex),
                pressure_noise=np.zeros(K),
                shared_noise=np.zeros(K, dtype=complex),
                drive_variance=0.0,
                started_s=started,
                duration_s=2.0,
                nominal_hz=hz,
                amplitude_v=volts,
            )
        )
    return out


# near the best that the model without delay can do, so that the fit takes a few steps only
WITHOUT_DELAY = {
    "mode1.frequency_hz": 169.18,
    "mode1.damping": 4.2e-3,
    "mode1.flame_residue": 26.6,
    "mode1.speaker_residue": 35.12,
    "mode2.frequency_hz": 282.1,
    "mode2.damping": 0.0493,
    "mode2.flame_residue": -9.56,
    "mode2.speaker_residue": -34.6,
    "flame.pole_hz": 66.3,
    "nonlinearity.c2": -17320.0,
    "nonlinearity.c3": -1.656e7,
}


@lru_cache(maxsize=1)
def pair() -> tuple[Assessment, Assessment]:
    """The declared model and the model with the delay that the data contain: before, after."""
    right, declared = Structure(flame_delay=True), Structure()
    measured = harmonics(right, tube(right))
    data = build(measured, Medium(), None)
    after = fit_orbits(right, data, tube(right), continuation=(0.0,))
    before = fit_orbits(declared, data, tube(declared, **WITHOUT_DELAY), continuation=(0.0,))
    for fit in (before, after):
        assert fit.converged, fit.reason
    first, second = (
        replace(assess(fit, data), lock_in=lock_in((fit, data))) for fit in (before, after)
    )
    return first, second


def identification() -> Identification:
    return Identification("tube", DeclaredModel(), pair()[1], (), 1.0)


def diagnosis(verdict: str = "traced") -> Diagnosis:
    before, after = pair()
    delay = after.parameters["flame.delay_s"]
    candidates = (
        _candidate("flame_delay", "flame", after, {"flame_delay.delay_s": delay}, 1e-300),
        _candidate("channel_mismatch", "sensor", before, {}, 0.4, ("sensor_offset",)),
    )
    traced = verdict == "traced"
    return Diagnosis(
        campaign="tube <b> & co",
        declared_model=DeclaredModel(),
        quality=(QualityFlag("164Hz_2.0V", "clipped", "3 samples at full scale", "excluded"),),
        before=before,
        residual=Residual(True, 0.0, {"odd_share": 0.9, "absorbed": 0.4}),
        candidates=candidates,
        verdict=verdict,  # type: ignore[arg-type]
        effects=(TracedEffect("flame_delay", "flame", "n-tau", {"flame_delay.delay_s": delay}),)
        if traced
        else (),
        after=after if traced else before,
        next_experiment=None if traced else {"reason": "tell them apart", "conditions": [{"a": 1}]},
        seconds=3.0,
    )


def _candidate(
    effect: str,
    location: str,
    a: Assessment,
    parameters: dict[str, Estimate],
    p: float,
    rivals: tuple[str, ...] = (),
) -> Candidate:
    return Candidate(
        effects=(effect,),
        forms=("",),
        locations=(location,),
        chi2=a.fit.chi2,
        chi2_per_dof=a.chi2_per_dof,
        validation_error=a.validation_error,
        p_value=p,
        parameters=parameters,
        equivalent_to=rivals,
        adequate=a.chi2_per_dof < 2,
    )


def recorded() -> Campaign:
    """A short campaign of raw velocity and drive signals, for spectra."""
    rate, n = 5000.0, 5000
    t = np.arange(n) / rate
    rng = np.random.default_rng(3)
    runs = []
    for (hz, volts, role, started), (f, y) in zip(
        CONDITIONS, steady(Structure(), tube()), strict=True
    ):
        k = np.arange(1, y.size + 1)
        v = (np.exp(2j * np.pi * f * np.outer(t, k)) @ y).real + 1e-5 * rng.standard_normal(n)
        u = (volts or 0.0) * np.cos(2 * np.pi * f * t)
        runs.append(
            Run(
                name="00_free" if hz is None else f"{hz:.0f}Hz_{volts}V",
                kind="free" if hz is None else "forced",
                sample_rate_hz=rate,
                signals={
                    "velocity": Signal(v, "velocity", "m/s"),
                    "drive": Signal(u, "voltage", "V"),
                },
                frequency_hz=hz,
                amplitude_v=volts,
                started_s=started,
                role=role,  # type: ignore[arg-type]
            )
        )
    return Campaign("tube", tuple(runs))


def without_convergence(a: Assessment) -> Assessment:
    """The same assessment as if its fit had failed: nothing in it may be relied on."""
    p = len(a.structure.parameters)
    fit = replace(
        a.fit,
        converged=False,
        reason="no start from the data led to a converged fit",
        chi2=np.inf,
        covariance=np.full((p, p), np.inf),
    )
    return replace(a, fit=fit, fit_error=np.nan, validation_error=np.nan, comparisons=())
