"""Whether two effects together are the two effects of the simulated rig together.

    python benchmarks/compositions.py                 every pair on the thesis's rig, at 80 dB
    python benchmarks/compositions.py --only sensor_offset

Each effect is fitted alone first; the pair starts from both, so that no search is asked. What a
pair leaves beyond the noise is an equation that does not compose: of `identify`, or of the rig.
"""

import argparse
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import combinations

import numpy as np
from trace_study import to_campaign

from identify import start, trace
from identify.effect import Effect
from identify.effects import CATALOGUE
from identify.fit import Fit, fit_orbits
from identify.identification import Prepared, prepare
from simulated_rig import build_config
from simulated_rig.campaigns import simulate_campaign
from simulated_rig.effects import EFFECTS
from simulated_rig.random_rigs import random_campaign

SEED, LEFT = 3, 3.0  # χ²/dof beyond which a pair does not compose

# What the rig simulates, and the form in which `identify` fits it.
FORMS = {
    "flame_delay": "flame_delay",
    "flame_dynamics/extra_pole": "flame_dynamics:pole",
    "flame_dynamics/second_time_scale": "flame_dynamics:second_time_scale",
    "flame_dynamics/distributed_delay": "flame_dynamics:distributed_delay",
    "nonlinearity_shape/quartic": "nonlinearity_shape:quartic",
    "nonlinearity_shape/quintic": "nonlinearity_shape:quintic",
    "nonlinearity_shape/dead_zone": "nonlinearity_shape:dead_zone",
    "nonlinearity_shape/hysteresis": "nonlinearity_shape:hysteresis",
    "acoustic_mode": "acoustic_mode:mode",
    "side_resonator": "acoustic_mode:side_resonator",
    "nonlinear_damping/quadratic": "nonlinear_damping:quadratic_end",
    "nonlinear_damping/cubic": "nonlinear_damping:cubic_end",
    "actuator_dynamics/delay": "actuator_dynamics:delay",
    "actuator_dynamics/voice_coil": "actuator_dynamics:pole",
    "actuator_dynamics/resonance": "actuator_dynamics:resonance",
    "actuator_nonlinearity/distortion": "actuator_nonlinearity:quadratic",
    "actuator_nonlinearity/compression": "actuator_nonlinearity:cubic",
    "actuator_nonlinearity/clipping": "actuator_nonlinearity:knee",
    "parameter_drift/frequency": "parameter_drift:frequency",
    "parameter_drift/damping": "parameter_drift:damping",
    "parameter_drift/flame_gain": "parameter_drift:flame_gain",
    "parameter_drift/speaker_gain": "parameter_drift:speaker_gain",
    "channel_mismatch/gain": "channel_mismatch:gain",
    "channel_mismatch/skew": "channel_mismatch:skew",
    "channel_mismatch/lowpass": "channel_mismatch:lowpass",
    "sensor_offset": "sensor_offset:modal_2",
}


def form_of(key: str, modes: int) -> Effect:
    """The effect as fitted, in the form for so many modes where it has a share of each."""
    name = FORMS[key].replace("modal_2", f"modal_{modes}")
    return next(e for e in CATALOGUE if e.key == name and e.mode_count in (None, modes))


def recorded(keys: Sequence[str], share: float) -> Prepared:
    """A campaign with these effects, each of that share of its range from visible to gross."""
    made = [EFFECTS[k].draw(np.random.default_rng(SEED), share) for k in keys]
    rig = build_config("thesis-two-mode", noise_db=80.0)
    rig, plan = random_campaign(SEED, rig, made, forced=9, validation=0)
    return prepare(to_campaign(simulate_campaign(rig, plan, SEED, declared_modes=2)))


def alone(item: tuple[str, float]) -> tuple[str, Fit | None]:
    """The effect's fit, as the search for it alone comes to it; None where it comes to nothing."""
    key, share = item
    try:
        ready = recorded([key], share)
    except ValueError as error:
        print(f"{key}: {error}", file=sys.stderr)
        return key, None
    base = start.fit_from_data(ready.structure, ready.data)
    found = trace.search(ready.structure, ready.data, base, catalogue=[form_of(key, 2)], depth=1)
    best = min(found.singles, key=lambda t: t.fit.chi2, default=None)
    return key, None if best is None else best.fit


def together(item: tuple[tuple[str, str], tuple[Fit, Fit], float]) -> tuple[tuple[str, str], str]:
    """What the pair leaves, from both alone."""
    pair, fits, share = item
    try:
        ready = recorded(pair, share)
    except ValueError as error:
        return pair, str(error)
    modes = 3 if "acoustic_mode" in pair else 2
    effects = [form_of(k, modes) for k in pair]
    structure = ready.structure.with_effects(*effects)
    count = len(ready.structure.parameters)
    known = {n: x for f in fits for n, x in f.values.items()}  # of a further mode: as of the first
    own = [e.to_internal([known.get(q.name, 1.0) for q in e.parameters]) for e in effects]
    starts = [np.r_[f.theta[:count], *own] for f in fits]
    found = [
        fit_orbits(structure, ready.data, theta, continuation=steps, iterations=200)
        for theta in starts
        for steps in ((0.0,), (0.01, 0.003, 0.0), (0.1, 0.03, 0.01, 0.003, 0.0))
    ]
    fit = min(found, key=lambda f: f.chi2 if np.isfinite(f.chi2) else np.inf)
    left = fit.chi2_per_dof
    return pair, f"{left:.3g}" + ("" if left < LEFT else f"  <<< {fit.reason}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="pairs of which one's name begins so")
    parser.add_argument("--share", type=float, default=0.5, help="size, from visible to gross")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    with ProcessPoolExecutor(given.jobs) as pool:
        fits = {}
        for key, fit in pool.map(alone, [(k, given.share) for k in FORMS]):
            left = "nothing" if fit is None else f"{fit.chi2_per_dof:.3g}"
            print(f"{key:40s} alone {left}", flush=True)
            if fit is not None and fit.chi2_per_dof < LEFT:
                fits[key] = fit
        pairs = [
            (a, b)
            for a, b in combinations(fits, 2)
            if form_of(a, 2).name != form_of(b, 2).name
            and (a.startswith(given.only) or b.startswith(given.only))
        ]
        items = [(p, (fits[p[0]], fits[p[1]]), given.share) for p in pairs]
        for pair, left in pool.map(together, items):
            print(f"{' + '.join(pair):70s} {left}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
