"""Speed of harmonic balance and of the fit, as ratios in one run. CPU seconds, one thread.

    OMP_NUM_THREADS=1 python benchmarks/fit_speed.py

1. One steady state by harmonic balance against `solve_ivp` (DOP853) settling and recording one
   second of the same condition, both to the same error of the fundamental.
2. A fit of ten runs, two modes, from data alone (asked: under 1 s).
3. One evaluation of residual and Jacobian, and one fit from a near start, against the number of
   runs (1 … 64: linear asked) and of modes (1 … 4: at most quadratic asked).
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from daq.service.reproduction.material import true_parameters
from identify import balance, dataset, start
from identify.dataset import Dataset
from identify.effect import Conditions
from identify.fit import fit_orbits
from identify.harmonics import Harmonics
from identify.record import Medium
from identify.residual import OrbitResidual
from identify.structure import Structure
from simulated_rig.plant import Plant
from simulated_rig.presets import thesis_four_mode

FloatArray = npt.NDArray[np.float64]
NOISE = 1e-4  # of a coefficient, relative to the free cycle
FREE_M_S = 0.24
COMPARED = 4


def seconds(work: Callable[[], object], least: float = 0.3) -> float:
    """CPU seconds of one call, the median of as many as fit."""
    work()
    taken: list[float] = []
    while sum(taken) < least or len(taken) < 3:
        began = time.process_time()
        work()
        taken.append(time.process_time() - began)
    return float(np.median(taken))


def plant_of(modes: int) -> Plant:
    """The thesis's tube with its first `modes` modes; the gain such that it sings as with two."""
    whole = thesis_four_mode()
    return replace(whole, modes=whole.modes[:modes])


def conditions(plant: Plant, runs: int, harmonics: int) -> Conditions:
    """Forced runs between 160 and 180 Hz well within the tongue."""
    f = 160.0 + 20.0 * (np.arange(runs) + 0.5) / runs
    drive = np.zeros((runs, harmonics), dtype=complex)
    drive[:, 0] = -1j * (0.5 + 0.15 * np.abs(f - 169.8))
    velocity = np.zeros_like(drive)
    velocity[:, 0] = 2 * FREE_M_S * np.exp(-2j)
    nothing = np.zeros_like(drive)
    return Conditions(2 * np.pi * f, drive, nothing, velocity, np.linspace(0, 1, runs),
                      np.ones(runs), np.arange(runs), np.zeros(runs, dtype=bool),
                      np.ones(runs))  # fmt: skip


def truth(structure: Structure, plant: Plant) -> FloatArray:
    values = true_parameters(plant)
    return structure.parameters.to_internal([values[n] for n in structure.parameters.names])


def data_of(modes: int, runs: int) -> tuple[Structure, FloatArray, Dataset]:
    """Noisy coefficients of `runs` steady states."""
    plant, structure = plant_of(modes), Structure(mode_count=modes)
    theta = truth(structure, plant)
    K = COMPARED + dataset.EXTRA_HARMONICS
    at = conditions(plant, runs, K)
    orbits = balance.solve(structure, theta, at)
    if not orbits.converged.all():
        raise RuntimeError(f"{modes} modes, {runs} runs: a steady state was not found")
    rng = np.random.default_rng(0)
    size = NOISE * FREE_M_S
    measured = []
    for i in range(runs):
        n = (rng.standard_normal(K) + 1j * rng.standard_normal(K)) * size / np.sqrt(2)
        measured.append(
            Harmonics(
                name=f"{i}", kind="forced", role="fit",
                frequency_hz=float(at.omega[i] / (2 * np.pi)), frequency_stderr_hz=0.0,
                velocity=orbits.velocity[i] + n, drive=at.drive[i],
                pressure=np.zeros(K, dtype=complex), covariance=np.eye(2 * K) * size**2 / 2,
                side=np.zeros((2, K), dtype=complex), pressure_noise=np.zeros(K),
                shared_noise=np.zeros(K, dtype=complex), drive_variance=0.0,
                started_s=60.0 * i, duration_s=1.0,
                nominal_hz=None, amplitude_v=float(abs(at.drive[i, 0])),
            )
        )  # fmt: skip
    return structure, theta, dataset.build(measured, Medium(), None, compared=COMPARED)


def steady_state() -> None:
    """Harmonic balance against integration, at equal error of the fundamental."""
    plant, structure = plant_of(2), Structure()
    theta = truth(structure, plant)
    frequency, volts = 166.0, 1.0

    def one(harmonics: int) -> complex:
        at = conditions(plant, 1, harmonics)
        drive = np.zeros_like(at.drive)
        drive[:, 0] = -1j * volts
        at = replace(at, omega=np.array([2 * np.pi * frequency]), drive=drive)
        orbits = balance.solve(structure, theta, at)
        assert orbits.converged.all()
        return complex(orbits.velocity[0, 0])

    reference = one(24)
    w = 2 * np.pi * np.array([m.frequency_hz for m in plant.modes])
    loss = 2 * np.array([m.damping for m in plant.modes]) * w
    psi_f, psi_a, D = (
        np.array([getattr(m, n) for m in plant.modes])
        for n in ("psi_flame", "psi_speaker", "velocity")
    )
    _, c1, c2, c3 = plant.characteristic.coefficients
    pole, gain = 2 * np.pi * plant.flame.pole_hz, plant.flame.gain
    force, omega = plant.actuator.gain * volts, 2 * np.pi * frequency

    def rates(t: float, x: FloatArray) -> FloatArray:
        eta, v, q = x[:2], x[2:4], x[4]
        dq = gain * (D @ v) - pole * q
        flame = (c1 + 2 * c2 * q + 3 * c3 * q * q) * dq
        drive = force * np.sin(omega * t)
        return np.concatenate([v, psi_f * flame + psi_a * drive - loss * v - w**2 * eta, [dq]])

    def integrated(tolerance: float, settle_s: int) -> complex:
        t = settle_s + np.arange(4000) / 4000.0
        x0 = np.array([0.0, 0.0, 1e6, 0.0, 0.0])
        found = solve_ivp(rates, (0.0, settle_s + 1.0), x0, "DOP853", t_eval=t, rtol=tolerance,
                          atol=tolerance * 1e3)  # fmt: skip
        y = (D @ found.y[2:4]) * plant.velocity_scale
        return complex(2 * np.mean(y * np.exp(-1j * omega * t)))

    print("1. one steady state, 166 Hz, 1 V, two modes (relative error of the fundamental, CPU s)")
    for harmonics, tolerance, settle_s in ((3, 1e-5, 1), (5, 1e-7, 2), (9, 1e-9, 3)):
        ours, began = seconds(partial(one, harmonics)), time.process_time()
        theirs = integrated(tolerance, settle_s)
        spent = time.process_time() - began
        print(f"   balance, {harmonics} harmonics: {abs(one(harmonics) / reference - 1):.1e} in "
              f"{ours:.2e} s; DOP853, rtol {tolerance:g}, {settle_s} s settling: "
              f"{abs(theirs / reference - 1):.1e} in {spent:.2e} s; "
              f"ratio {spent / ours:.0f}")  # fmt: skip


def fits() -> None:
    structure, _, data = data_of(2, 10)
    found = start.fit_from_data(structure, data)
    taken = seconds(lambda: start.fit_from_data(structure, data))
    print(f"2. ten runs, two modes, from data alone: {taken:.2f} s, χ²/dof "
          f"{found.chi2_per_dof:.2f}, {found.reason}")  # fmt: skip


def scaling() -> None:
    print("3. CPU ms of one residual with Jacobian, and of a fit started 0.1 % beside the optimum")
    for label, cases in (
        ("runs, two modes", [(2, n) for n in (1, 2, 4, 8, 16, 32, 64)]),
        ("modes, sixteen runs", [(m, 16) for m in (1, 2, 3, 4)]),
    ):
        print(f"   {label}")
        for modes, runs in cases:
            structure, theta, data = data_of(modes, runs)

            def evaluation() -> object:
                residual = OrbitResidual(structure, data.fit)  # noqa: B023 used at once
                return residual(theta[None], np.zeros(1, dtype=int), True)  # noqa: B023

            line = f"      {modes} modes, {runs:2d} runs: {1e3 * seconds(evaluation):7.2f}"
            if runs >= 4:
                near = theta + 1e-3 * np.random.default_rng(1).standard_normal(theta.size)
                taken = seconds(
                    lambda: fit_orbits(structure, data, near, continuation=(0.003, 0.0))  # noqa: B023
                )
                line += f"  {1e3 * taken:8.1f}"
            print(line)


if __name__ == "__main__":
    steady_state()
    fits()
    scaling()
    sys.exit(0)
