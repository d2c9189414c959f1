"""Starting values from data alone: how many random rigs end at the global optimum.

    python benchmarks/starts.py [--rigs 200] [--first 0] [--noise 35] [--out FILE] [--budget S]

A rig is drawn widely (one to three modes, dampings, residues, flame pole, growth, even term; all
with a stable limit cycle), recorded in one free and eight forced runs, and identified from the
recordings alone. The reference is the fit started at the true parameters. Outcomes:

    global      converged, and its χ² is the reference's (or lower) to within half a unit
    reported    not converged, and said so
    WRONG       converged somewhere else: an answer that is none
"""

import argparse
import sys
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from draws import Record, run
from trace_study import to_campaign

from daq.service.reproduction.material import true_parameters
from identify import assess, start
from identify.fit import fit_orbits
from identify.identification import prepare
from identify.structure import Structure
from simulated_rig.campaigns import simulate_campaign
from simulated_rig.random_rigs import random_campaign, random_rig

SAME = 0.5  # difference of χ² that counts as none: 0.7 of a standard error in one direction


def one(key: tuple[int, float]) -> Record:
    """One rig: the fit from data, and the one from the truth."""
    seed, noise_db = key
    rig = random_rig(seed, noise_db=noise_db)
    modes = len(rig.plant.modes)
    try:
        rig, plan = random_campaign(seed, rig, forced=8, validation=0)
    except ValueError as error:
        return {"skipped": str(error), "modes": modes}
    campaign = to_campaign(simulate_campaign(rig, plan, seed, declared_modes=modes))
    structure = Structure(mode_count=modes)
    values = true_parameters(rig.plant)
    truth = structure.parameters.to_internal([values[n] for n in structure.parameters.names])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = prepare(campaign, structure).data
        found = start.fit_from_data(structure, data)
        best = fit_orbits(structure, data, truth, continuation=(0.0,))
    return {
        "modes": modes,
        "converged": found.converged,
        "reason": found.reason,
        "chi2": found.chi2,
        "dof": found.dof,
        "p": assess.lack_of_fit_p(found.chi2, found.dof),
        "best_chi2": best.chi2,
        "best_converged": best.converged,
        "best_reason": best.reason,
        "compared": data.fit[0].compared,
        "truth": values,
        "found": found.values,
        "best": best.values,
    }


def outcome(r: Record) -> str:
    if "skipped" in r:
        return "skipped"
    if not r["converged"]:
        return "reported"
    return "global" if r["chi2"] < r["best_chi2"] + SAME else "WRONG"


def report(records: list[Record]) -> None:
    used = [r for r in records if "skipped" not in r]
    print(f"{len(records)} rigs, {len(records) - len(used)} could not be entrained")
    print("outcomes:", dict(Counter(outcome(r) for r in used)))
    for modes in sorted({r["modes"] for r in used}):
        rows = [r for r in used if r["modes"] == modes]
        print(f"    {modes} modes: {dict(Counter(outcome(r) for r in rows))}")
    if used:
        cpu = [r["cpu_s"] for r in used]
        print(f"CPU s a rig (both fits): median {np.median(cpu):.2f}, largest {max(cpu):.1f}")
    for r in used:
        if outcome(r) != "global":
            print(f"{outcome(r)}: rig {r['key'][0]}, {r['modes']} modes, χ² {r['chi2']:.5g} "
                  f"({r['reason']}) against {r['best_chi2']:.5g} ({r['best_reason']}), "
                  f"dof {r['dof']}, harmonics {r['compared']}")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--noise", type=float, default=35.0)
    parser.add_argument("--out", type=Path, help="JSON lines, to go on from")
    parser.add_argument("--budget", type=float, help="CPU seconds at most")
    given = parser.parse_args()
    keys = [[seed, given.noise] for seed in range(given.first, given.first + given.rigs)]
    report(run("rigs", keys, one, given.out, given.budget))
    return 0


if __name__ == "__main__":
    sys.exit(main())
