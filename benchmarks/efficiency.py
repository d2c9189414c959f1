"""Statistical efficiency on the thesis's two-mode rig: spread against the Cramér–Rao bound.

    python benchmarks/efficiency.py [--noise 35 55 75] [--draws 200] [--runs campaign|table-4.4]
                                    [--out FILE] [--budget 300]

A campaign (one free run, eight forced ones of 2 s at 10 kHz; or Table 4.4's four runs of 1 s, which
determine much less) is recorded once without noise; every draw adds white noise to the two
microphones' samples (`noise_db` below the free cycle's velocity over the whole band) and goes the
whole way: quality gate, Fourier coefficients, noise covariance from neighbouring bins, starts from
data, maximum likelihood. Nothing is told.

Printed for each noise level: RMSE over the bound, bias over the bound, coverage of the 95 %
intervals, and the same of balance least squares (exact polynomial form, pole found by scan); the
closed loop's poles with the thesis's own Eq. 4.17 (flame pole given) beside; mean and tail of
χ²/dof. The bound: (Σ JᵀC⁻¹J)⁻¹ at the true parameters with the true noise covariance, of the six
harmonics that a fit may use. A ratio of n draws is itself uncertain by 1/√(2n).
"""

import argparse
import sys
import warnings
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from draws import Record, run
from trace_study import to_campaign

from daq.service.reproduction.material import true_parameters
from identify import assess, dataset, harmonics, start
from identify.fit import Fit, covariance_of
from identify.identification import prepare
from identify.parameters import Estimate
from identify.record import Campaign, Signal
from identify.report.responses import closed_loop_poles
from identify.residual import OrbitResidual
from identify.structure import Structure
from identify.thesis import EntrainedRuns, closed_loop
from identify.whiteness import residual_tests
from simulated_rig.build import build_config, noise_pa
from simulated_rig.campaigns import PlannedRun, plan_campaign, simulate_campaign
from simulated_rig.config import Converter, RigConfig

FloatArray = npt.NDArray[np.float64]

STRUCTURE = Structure()
FLAME_POLE_HZ = 100.0
MOST = 6  # harmonics that a fit compares at most
SEED = 4
Z95 = 1.959964
TABLE_4_4 = ((166.0, 1.0), (167.0, 1.0), (170.0, 1.5), (171.0, 2.0))  # Hz, 1e10 of the thesis's


@lru_cache(maxsize=2)
def quiet(which: str) -> tuple[RigConfig, Campaign]:
    """The rig, and its campaign without noise."""
    config = build_config("thesis-two-mode")
    one, other = (replace(m, noise_pa=0.0) for m in config.microphones)
    config = replace(config, microphones=(one, other), converter=Converter(bits=32))
    if which == "campaign":
        plan = plan_campaign(config, SEED, forced=8, validation=0)
    else:
        plan = tuple(
            PlannedRun("forced", f, v, 120.0 * i, duration_s=1.0, settle_s=8.0)
            for i, (f, v) in enumerate(TABLE_4_4)
        )
    return config, to_campaign(simulate_campaign(config, plan, SEED, "efficiency"))


def noisy(which: str, noise_db: float, draw: int) -> Campaign:
    """The campaign with one draw of noise."""
    config, campaign = quiet(which)
    sigma = noise_pa(config, noise_db)
    rng = np.random.default_rng([draw, round(noise_db)])
    runs = []
    for r in campaign.runs:
        signals = dict(r.signals)
        for name in ("p1", "p2"):
            s: Signal = signals[name]
            added = s.values + sigma * rng.standard_normal(s.values.size)
            signals[name] = replace(s, values=added, resolution=None)
        runs.append(replace(r, signals=signals))
    return replace(campaign, runs=tuple(runs))


def truth() -> dict[str, float]:
    return true_parameters(quiet("campaign")[0].plant)


@lru_cache(maxsize=8)
def bound(which: str, noise_db: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Internal true parameters, their Cramér–Rao covariance, and the true closed-loop poles as
    (Re, Im) with their covariance stacked under them, (poles, 2 + 2, 2)."""
    config, campaign = quiet(which)
    sigma = noise_pa(config, noise_db)
    measured = harmonics.measure_campaign(campaign)
    data = dataset.build(
        measured, campaign.medium, harmonics.microphones(campaign.runs[0]), compared=MOST
    )
    spacing = config.microphones[1].position_m - config.microphones[0].position_m
    density = campaign.medium.density_kg_m3
    by_name = {h.name: h for h in measured}
    batches = []
    for b in data.fit:
        samples = np.array([by_name[n].duration_s for n in b.names]) * config.sample_rate_hz
        kw = b.at.omega[:, None] * np.arange(1, MOST + 1)
        # a coefficient of N samples of white noise σ has E|n|² = 4σ²/N; two microphones
        power = 2 * 4 * sigma**2 / samples[:, None] / (density * spacing * kw) ** 2
        covariance = np.stack([np.diag(np.r_[v, v]) / 2 for v in power])
        if b.free:
            # var ω = 24 σ²/(Σ k²A_k² N T²) of the microphones' sum, of variance 2σ²
            line = np.abs([by_name[n].pressure[:5] * 2 for n in b.names])
            weight = np.sum((np.arange(1, 6) * line) ** 2, axis=1)
            T = np.array([by_name[n].duration_s for n in b.names])
            f_stderr = np.sqrt(24 * 2 * sigma**2 / (weight * samples * T**2)) / (2 * np.pi)
            covariance = np.stack(
                [
                    dataset.free_covariance(c, y, s)
                    for c, y, s in zip(covariance, b.measured, f_stderr, strict=True)
                ]
            )
        whiteners = np.stack([dataset.whitener(c) for c in covariance])
        batches.append(replace(b, covariance=covariance, whitener=whiteners))
    values = truth()
    theta = STRUCTURE.parameters.to_internal([values[n] for n in STRUCTURE.parameters.names])
    found = OrbitResidual(STRUCTURE, batches)(theta[None], np.zeros(1, dtype=int), True)
    assert found.jacobian is not None
    covariance = covariance_of(found.jacobian[0])
    n = found.residual.shape[1]
    exact = Fit(STRUCTURE, theta, 0.0, n, covariance, found.residual[0], found.jacobian[0], True,
                "", 0)  # fmt: skip
    poles = closed_loop_poles(exact)
    pairs = poles.value.imag > 1.0
    value = np.stack([poles.value[pairs].real, poles.value[pairs].imag], axis=-1)[:, None]
    return theta, covariance, np.concatenate([value, poles.covariance[pairs]], axis=1)


def one(key: tuple[str, float, int]) -> Record:
    """One draw: estimates, standard errors, misfit; the balance's estimates."""
    which, noise_db, draw = key
    campaign = noisy(which, noise_db, draw)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ready = prepare(campaign, STRUCTURE)
        fit = start.fit_from_data(STRUCTURE, ready.data)
        rough = next(start.candidates(STRUCTURE, ready.data), None)
        runs = EntrainedRuns.from_dataset(ready.data)
        thesis = closed_loop(runs, FLAME_POLE_HZ, retained=2)
        poles = closed_loop_poles(fit) if fit.converged else None
    record: Record = {
        "noise_db": noise_db,
        "converged": fit.converged,
        "reason": fit.reason,
        "chi2": fit.chi2,
        "dof": fit.dof,
        "p": assess.lack_of_fit_p(fit.chi2, fit.dof),
        "tests": {t.name: t.p_value for t in residual_tests(fit, ready.data)},
        "compared": ready.data.fit[0].compared,
        "excluded": sorted(ready.quality.excluded),
        "estimates": {n: [e.value, e.stderr] for n, e in fit.estimates.items()},
        "balance": None if rough is None else STRUCTURE.parameters.plain(rough),
        "thesis": [[p.real, p.imag] for p in sorted(thesis.roots, key=abs) if p.imag > 1.0],
        "poles": None,
    }
    if poles is not None:
        pairs = poles.value.imag > 1.0
        record["poles"] = [
            [p.real, p.imag, float(np.sqrt(c[0, 0])), float(np.sqrt(c[1, 1]))]
            for p, c in zip(poles.value[pairs], poles.covariance[pairs], strict=True)
        ]
    return record


def ratios(error: FloatArray, limit: float) -> str:
    """RMSE and bias over the bound."""
    return f"{np.sqrt(np.mean(error**2)) / limit:8.3g} {np.mean(error) / limit:+8.2g}"


def report(which: str, noise_db: float, records: list[Record]) -> None:
    used = [r for r in records if r["converged"]]
    compared = sorted({r["compared"] for r in records})
    print(f"\n{which}, {noise_db:g} dB: {len(records)} draws, "
          f"{len(records) - len(used)} not converged, harmonics compared {compared}, CPU s a draw "
          f"{np.median([r['cpu_s'] for r in records]):.2f}")  # fmt: skip
    for r in records:
        if r["excluded"] or not r["converged"]:
            print(f"    draw {r['key'][2]}: excluded {r['excluded']}, {r['reason']}")
    if not used:
        return
    theta, covariance, poles = bound(which, noise_db)
    known = truth()
    limits = np.sqrt(np.diag(covariance)) * np.abs(STRUCTURE.parameters.slopes(theta))
    print(f"{'parameter':25s} {'truth':>11s} {'bound/truth':>11s} | {'RMSE/b':>8s} "
          f"{'bias/b':>8s} {'cover':>7s} {'s.e./b':>7s} | balance: {'RMSE/b':>8s} "
          f"{'bias/b':>8s}")  # fmt: skip
    rough = [r["balance"] for r in used if r["balance"] is not None]
    for name, limit in zip(STRUCTURE.parameters.names, limits, strict=True):
        estimates = [
            Estimate(value, stderr, "") for value, stderr in (r["estimates"][name] for r in used)
        ]
        error = np.array([e.value for e in estimates]) - known[name]
        inside = [low <= known[name] <= high for low, high in (e.interval(Z95) for e in estimates)]
        spread = np.sqrt(np.mean([e.stderr**2 for e in estimates])) / limit
        other = np.array([b[name] for b in rough]) - known[name]
        print(f"{name:25s} {known[name]:11.5g} {limit / abs(known[name]):11.2e} | "
              f"{ratios(error, limit)} {100 * np.mean(inside):6.1f}% {spread:7.3f} | "
              f"         {ratios(other, limit)}")  # fmt: skip
    print(f"{'closed-loop pole':25s} {'truth':>11s} {'bound':>11s} | {'RMSE/b':>8s} "
          f"{'bias/b':>8s} {'cover':>7s} {'':7s} | Eq. 4.17: {'RMSE/b':>7s} "
          f"{'bias/b':>8s}")  # fmt: skip
    for i in range(poles.shape[0]):
        for part, word in enumerate(("growth 1/s", "rad/s")):
            true = poles[i, 0, part]
            limit = float(np.sqrt(poles[i, 1 + part, part]))
            ours = np.array([r["poles"][i] for r in used if len(r["poles"]) > i])
            error = ours[:, part] - true
            inside = np.abs(error) <= Z95 * ours[:, 2 + part]
            theirs = np.array([r["thesis"][i][part] for r in used if len(r["thesis"]) > i]) - true
            print(f"{f'{i + 1} {word}':25s} {true:11.5g} {limit:11.2e} | "
                  f"{ratios(error, limit)} {100 * np.mean(inside):6.1f}% {'':7s} | "
                  f"         {ratios(theirs, limit)}")  # fmt: skip
    p = np.array([r["p"] for r in used])
    ratio = np.array([r["chi2"] / r["dof"] for r in used])
    dof = used[0]["dof"]
    nu = harmonics.VARIANCE_DOF
    mean = nu / (nu - 2)
    print(f"χ²/dof: mean {ratio.mean():.4f} (expected {mean:.4f}), sd {ratio.std():.4f} "
          f"(χ² of {dof} alone {np.sqrt(2 / dof):.4f}); p < 0.05 in {np.mean(p < 0.05):.1%}, "
          f"p < 0.01 in {np.mean(p < 0.01):.1%}, p > 0.95 in {np.mean(p > 0.95):.1%}")  # fmt: skip
    alarms = {n: np.array([r["tests"][n] for r in used if r["tests"]]) for n in used[0]["tests"]}
    for name, values in alarms.items():
        print(f"residual test {name:10s} p < 0.05 in {np.mean(values < 0.05):.1%}, "
              f"p < 0.01 in {np.mean(values < 0.01):.1%}")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--noise", type=float, nargs="+", default=[35.0, 55.0, 75.0])
    parser.add_argument("--runs", choices=("campaign", "table-4.4"), default="campaign")
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--out", type=Path, help="JSON lines, to go on from")
    parser.add_argument("--budget", type=float, help="CPU seconds a noise level at most")
    given = parser.parse_args()
    for noise_db in given.noise:
        keys = [[given.runs, noise_db, n] for n in range(given.draws)]
        report(given.runs, noise_db, run(f"{noise_db:g} dB", keys, one, given.out, given.budget))
    return 0


if __name__ == "__main__":
    sys.exit(main())
