"""False alarms and power of the diagnosis on simulated campaigns.

    python benchmarks/trace_study.py clean   --count 400     model exactly as declared
    python benchmarks/trace_study.py effects --count 600     one or two effects the model lacks
    python benchmarks/trace_study.py leftout --count 200     one effect that no candidate names
    python benchmarks/trace_study.py clean-turbulent   --count 200     as clean, noise in the loop
    python benchmarks/trace_study.py effects-turbulent --count 100     as effects, noise in the loop
    python benchmarks/trace_study.py leftout-thesis --count 96     the same on the thesis's rig
    python benchmarks/trace_study.py thesis  --count 96      the thesis's rig, effect by effect
    python benchmarks/trace_study.py mixed   --count 100     the same with none, one or two of them

Campaigns come from the simulated rig's own physics (random rigs, 30 to 80 dB noise, white or
coloured, 4 to 16 runs); the diagnosis sees arrays only. Prints verdicts, wrong claims, a confusion
table by effect, how often 95 % intervals of traced effects hold the truth and what validation is
left. `--out FILE` gets one JSON line a campaign, and the next call with it goes on where the last
one ended, unless `identify` has changed since (but for its reports); `--again FILE` reports on such
lines alone.
With `--given` the true effects are the only candidates: how well their sizes are known, quickly.
"""

import argparse
import hashlib
import json
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import identify
from identify.chances import chi2_tail
from identify.effects import CANDIDATES
from identify.effects.scatter import Scatter
from identify.executor import InProcess
from identify.fit import Fit
from identify.identification import prepare
from identify.record import Campaign, DeclaredModel, Medium, Run, Signal
from identify.trace import try_effects, usable
from identify.trace.spreads import try_scatters
from simulated_rig import build_config
from simulated_rig.campaigns import SimulatedCampaign, simulate_campaign
from simulated_rig.config import RigConfig
from simulated_rig.effects import EFFECTS, Effect
from simulated_rig.random_rigs import MOST_TWO, random_campaign, random_rig

Truth = dict[str, float]
TURBULENCE = (-3.0, -1.3)  # decades of volts of drive
TURBULENT = ("clean-turbulent", "effects-turbulent")
UNSEEN = 1e-3  # chance of what an effect gains beside what was claimed, above which none sees it
EXCESS = (1.5, 2.0, 3.0, 10.0, 100.0)  # steps of χ²/dof
CLEAR = 2.0  # χ²/dof above which the residual exceeds the noise clearly: by as much as noise is
RIGHT = ("right", "right, the rest unseen")
SIZES = (0.5, 0.2, 0.85)  # of `thesis`: in the range from barely visible to gross


def _time(t: Truth) -> float:
    return 1 / (2 * np.pi * t["pole_hz"])


def _change(name: str, t: Truth, s: float) -> float:
    return t[name] * s / 1200


RESONANT: dict[str, Callable[[Truth, float], float]] = {
    "frequency_hz": lambda t, s: t["frequency_hz"],
    "damping": lambda t, s: t["damping"],
}

# (effect, form claimed, variant simulated): parameters of which both sides speak, and their truth.
# Drifts are simulated over 1200 s and claimed up to the last run used, which began after s seconds.
COMPARED: dict[tuple[str, str, str], dict[str, Callable[[Truth, float], float]]] = {
    ("flame_delay", "", ""): {"delay_s": lambda t, s: t["delay_s"]},
    ("flame_dynamics", "pole", "extra_pole"): {"time_s": lambda t, s: _time(t)},
    ("actuator_dynamics", "pole", "voice_coil"): {"time_s": lambda t, s: _time(t)},
    ("actuator_dynamics", "delay", "delay"): {"delay_s": lambda t, s: t["delay_s"]},
    ("actuator_dynamics", "resonance", "resonance"): {
        "frequency_hz": lambda t, s: t["resonance_hz"],
        "damping": lambda t, s: t["damping"],
    },
    ("acoustic_mode", "mode", ""): RESONANT,
    ("acoustic_mode", "side_resonator", "side_resonator"): RESONANT,
    ("actuator_nonlinearity", "quadratic", "distortion"): {"a2": lambda t, s: t["quadratic_per_v"]},
    ("actuator_nonlinearity", "cubic", "compression"): {"a3": lambda t, s: -t["cubic_per_v2"]},
    ("channel_mismatch", "skew", "skew"): {"skew_s": lambda t, s: t["skew_s"]},
    **{
        ("parameter_drift", what, what): {"relative_change": partial(_change, f"{what}_change")}
        for what in ("frequency", "damping", "flame_gain", "speaker_gain")
    },
}

# Effects that are a form of another: a side resonator acts as one more mode of the tube.
SAME = {"side_resonator": "acoustic_mode"}


def to_campaign(c: SimulatedCampaign) -> Campaign:
    """The simulated recordings as identification takes them."""
    step = 2 * c.full_scale_v / 2**c.bits
    runs = []
    for r in c.runs:
        signals = {
            name: Signal(x, "pressure", "Pa", position, c.full_scale_v / volts, step / volts)
            for name, x, position, volts in zip(
                ("p1", "p2"), (r.p1, r.p2), c.positions_m, c.volts_per_pa, strict=True
            )
        }
        signals["drive"] = Signal(r.drive, "voltage", "V", None, c.full_scale_v, step)
        runs.append(
            Run(
                r.name,
                r.plan.kind,
                c.sample_rate_hz,
                signals,
                r.plan.frequency_hz,
                r.plan.amplitude_v,
                r.plan.started_s,
                r.plan.role,
            )
        )
    medium = Medium(c.density_kg_m3, c.sound_speed_m_s)
    return Campaign(c.title, tuple(runs), medium, DeclaredModel(modes=c.declared_modes), c.title)


def any_rig(
    mode: str, seed: int, only: str | None
) -> tuple[RigConfig, list[Effect], dict[str, int]]:
    """A random rig, one or two effects or none, and how many runs of each kind."""
    rng = np.random.default_rng([seed, 71])
    mode, _, turbulent = mode.partition("-")
    volts = float(10 ** np.random.default_rng([seed, 72]).uniform(*TURBULENCE))
    rig = random_rig(
        seed,
        coloured=bool(rng.uniform() < 0.3),
        turbulence_v=volts if turbulent else 0.0,
        modes=MOST_TWO,
    )
    effects = []
    if mode != "clean":
        keys = [k for k in EFFECTS if only is None or k.startswith(only)]
        count = 1 if only or mode == "leftout" or rng.uniform() < 0.8 else 2
        for key in rng.choice(keys, size=count, replace=False):
            effects.append(EFFECTS[str(key)].draw(rng, float(rng.uniform())))
    forced = int(rng.integers(3, 13)) if mode == "clean" else int(rng.integers(7, 11))
    validation = min(3, max(1, forced // 3))
    cold = int(rng.uniform() < 0.2)
    return rig, effects, {"forced": forced, "validation": validation, "cold": cold}


def thesis_rig(seed: int) -> tuple[RigConfig, list[Effect], dict[str, int]]:
    """The thesis's rig in the layout of the recorded campaigns, effect by effect, size by size."""
    keys = sorted(EFFECTS)
    rng = np.random.default_rng([seed, 11])
    size = SIZES[seed // len(keys) % len(SIZES)]
    effect = EFFECTS[keys[seed % len(keys)]].draw(rng, size)
    return build_config(noise_db=36.0), [effect], {"forced": 7, "validation": 3, "cold": 0}


def mixed_rig(seed: int) -> tuple[RigConfig, list[Effect], dict[str, int]]:
    """The thesis's rig with none, one or two effects of any size, more or fewer runs and noise."""
    rng = np.random.default_rng([seed, 13])
    count = int(rng.choice([0, 1, 2], p=[0.1, 0.3, 0.6]))
    keys = rng.choice(sorted(EFFECTS), size=count, replace=False)
    effects = [EFFECTS[str(k)].draw(rng, float(rng.uniform())) for k in keys]
    runs = {"forced": int(rng.integers(6, 12)), "validation": int(rng.integers(2, 4)), "cold": 0}
    return build_config(noise_db=float(rng.uniform(30.0, 50.0))), effects, runs


OWN_RIG = {"thesis": thesis_rig, "mixed": mixed_rig, "leftout-thesis": thesis_rig}


def rest_p(campaign: Campaign, claimed: Fit, effects: Sequence[str], missing: set[str]) -> float:
    """Chance of what the effects `missing` gain at best on the fit of what was `claimed`, corrected
    for the forms tried: whether anybody could have seen them beside it."""
    data, run = prepare(campaign).data, InProcess()
    structure, fit = claimed.structure, claimed
    chance = [s for s in CANDIDATES if isinstance(s, Scatter) and s.name in effects]
    if chance:  # what is left beside it is asked within it
        (t,) = try_scatters(structure, data, fit, chance[:1], run)
        assert t.spread is not None
        data, fit = t.spread.data, t.fit
    forms = [e for e in CANDIDATES if e.name in missing]
    scatters = [e for e in forms if isinstance(e, Scatter)]
    others = try_scatters(structure, data, fit, scatters, run)
    others += try_effects(
        structure, data, fit, [e for e in forms if usable(e, data, structure)],
        executor=run, keep=len(forms), far=False, progress=lambda share, text: None,
    )  # fmt: skip
    chances = [
        chi2_tail(fit.chi2 - t.deviance, len(t.effects[-1].parameters))
        for t in others
        if t.deviance < fit.chi2
    ]
    return min(1.0, len(forms) * min(chances, default=1.0))


def one(task: tuple[str, int, str | None, bool]) -> dict[str, Any]:
    """Simulate and diagnose one campaign."""
    mode, seed, only, given = task
    record: dict[str, Any] = {"seed": seed, "mode": mode}
    made = OWN_RIG[mode](seed) if mode in OWN_RIG else any_rig(mode, seed, only)
    rig, effects, conditions = made
    modes = len(rig.plant.modes)
    drawn = seed + 1000 if mode.endswith("thesis") else seed
    try:
        rig, plan = random_campaign(drawn, rig, effects, **conditions)
        campaign = to_campaign(simulate_campaign(rig, plan, drawn, declared_modes=modes))
    except ValueError as error:
        return {**record, "skipped": str(error)}
    record["truth"] = [
        {"variant": e.name if e.name in SAME else e.variant,
         "effect": SAME.get(e.name, e.name), "location": e.location,
         "parameters": {k: v["value"] for k, v in e.parameters().items()}}
        for e in effects
    ]  # fmt: skip
    record["modes"], record["runs"] = modes, len(campaign.runs)
    began = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            there = {t["effect"] for t in record["truth"]}
            gone = there if mode.startswith("leftout") else set()
            left = [e for e in CANDIDATES if not gone & {e.name, *e.generalises}]
            if given:
                left = [e for e in left if e.name in there]
            d = identify.diagnose(campaign, catalogue=left)
    except Exception as error:
        return {**record, "error": f"{type(error).__name__}: {error}"}
    record |= {
        "cpu_s": time.process_time() - began,
        "verdict": d.verdict,
        "claimed": [
            {"effect": e.effect, "form": e.form, "location": e.location,
             "parameters": {n: [v.value, v.stderr] for n, v in e.parameters.items()}}
            for e in d.effects
        ],
        "fitted": {
            n: [v.value, v.stderr]
            for n, v in d.after.fit.estimates.items()
            if n.startswith("mode") and n.endswith(("frequency_hz", "damping"))
        },
        "last_s": max(c.started_s for c in d.before.comparisons),
        "best": [list(c.effects) for c in d.candidates[:4]],
        "where": [] if d.whereabouts is None else list(d.whereabouts.likely),
        "converged": d.before.fit.converged,
        "chi2": [d.before.chi2_per_dof, d.after.chi2_per_dof],
        "dof": d.before.dof,
        "p": d.residual.p_value,
        "validation": [d.before.validation_error, d.after.validation_error, d.noise_floor],
        "expected": d.after.expected_error,
        "quality": sorted({f"{q.flag}:{q.severity}" for q in d.quality}),
    }  # fmt: skip
    if outcome(record) == "right in part":
        names = [e.effect for e in d.effects]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            record["rest_p"] = rest_p(campaign, d.after.fit, names, there - set(names))
    return record


def outcome(r: dict[str, Any]) -> str:
    """right, right but for what cannot be seen beside it, right in part, wrong, ambiguous (truth
    among them or not), unexplained or unseen."""
    truth = sorted({t["effect"] for t in r["truth"]})
    claimed = sorted({c["effect"] for c in r["claimed"]})
    if r["verdict"] == "traced":
        if claimed == truth:
            return "right"
        places = [{x["location"] for x in r[side]} for side in ("truth", "claimed")]
        if r["mode"].startswith("leftout") and places[0] == places[1]:
            return "another name, right place"
        if not set(claimed) < set(truth):
            return "WRONG"
        return "right, the rest unseen" if r.get("rest_p", 0.0) > UNSEEN else "right in part"
    if r["verdict"] == "ambiguous":
        # foreign tones are claimed beside whatever else is
        rest = [n for n in truth if n != "interference" or n not in claimed]
        among = rest in [sorted(set(b)) for b in r["best"]]  # one effect may come in two kinds
        return "ambiguous" if among else "ambiguous, truth out"
    if r["verdict"] == "unexplained":
        if not r["mode"].startswith("leftout"):
            return "unexplained"
        if not r["where"]:
            return "unexplained, no place"
        right = {t["location"] for t in r["truth"]} <= set(r["where"])
        return f"unexplained, {'right' if right else 'WRONG'} place"
    return "right" if not truth else "unseen"


def deviations(r: dict[str, Any]) -> list[tuple[str, float]]:
    """(claimed − true)/standard error of the parameters that both sides name; single effects."""
    if r["verdict"] != "traced" or len(r["truth"]) != 1 or len(r["claimed"]) != 1:
        return []
    truth, claim = r["truth"][0], r["claimed"][0]
    rules = COMPARED.get((claim["effect"], claim["form"], truth["variant"]), {})
    if claim["effect"] != truth["effect"] or not rules:
        return []
    last_s = r.get("last_s", 120.0 * (r["runs"] - 1))
    found = {name: claim["parameters"][f"{claim['effect']}.{name}"] for name in rules}
    if claim["form"] == "mode" and "fitted" in r:
        # which of the modes is the further one is a matter of naming: that which is nearest
        others = [
            {name: r["fitted"][f"mode{i}.{name}"] for name in rules}
            for i in range(2, r["modes"] + 1)
        ]
        true_hz = truth["parameters"]["frequency_hz"]
        found = min([found, *others], key=lambda m: abs(m["frequency_hz"][0] - true_hz))
    return [
        (
            f"{claim['effect']}/{truth['variant']}.{name}",
            (found[name][0] - rule(truth["parameters"], last_s)) / found[name][1],
        )
        for name, rule in rules.items()
    ]


def intervals(used: list[dict[str, Any]]) -> None:
    """Coverage of the 95 % intervals, and validation error over noise floor of what was traced."""
    found = [d for r in used for d in deviations(r)]
    if found:
        inside = np.array([abs(z) < 1.96 for _, z in found])
        print(f"95 % intervals of traced effects' parameters hold the truth: "
              f"{inside.sum()} of {inside.size} ({100 * inside.mean():.1f} %)")  # fmt: skip
        for key in sorted({k for k, _ in found}):
            z = [z for k, z in found if k == key]
            print(f"    {key:55s} {sum(abs(q) < 1.96 for q in z)} of {len(z)}")
    traced = [r for r in used if r["verdict"] == "traced" and r["validation"][2]]
    for what, least in (
        ("the noise floor", [r["validation"][2] for r in traced]),
        ("what noise and parameters let expect", [r["expected"] for r in traced]),
    ):
        left = [r["validation"][1] / x for r, x in zip(traced, least, strict=True) if x == x]
        if left:
            print(f"validation error after over {what}, traced: median {np.median(left):.2f}, "
                  f"95 % below {np.quantile(left, 0.95):.2f}, "
                  f"above 1.5 in {sum(x > 1.5 for x in left)} of {len(left)}")  # fmt: skip


def confusion(used: list[dict[str, Any]]) -> None:
    """What was claimed, by what was there: each effect of a campaign counts in its row, and what
    was claimed beside or instead of it in the columns."""
    names = sorted({t["effect"] for r in used for t in r["truth"]})
    names += sorted({c["effect"] for r in used for c in r["claimed"]} - set(names))
    verdicts = ("ambiguous", "unexplained", "no_discrepancy")
    print("confusion: rows what was there, columns what was claimed, or else the verdict")
    print(" " * 30 + "".join(f"{i:4d}" for i in range(1, len(names) + 1)) + "  amb  une  none")
    for i, name in enumerate([*names, "nothing"], start=1):
        row: Counter[str] = Counter()
        for r in used:
            there = {t["effect"] for t in r["truth"]} or {"nothing"}
            if name not in there:
                continue
            claimed = {c["effect"] for c in r["claimed"]} if r["verdict"] == "traced" else set()
            found = claimed & {name} | claimed - there
            row.update(found or ({"missed"} if claimed else {r["verdict"]}))
        cells = "".join(f"{row[n] or '.':>4}" for n in names)
        rest = "".join(f"{row[v] or '.':>5}" for v in verdicts)
        missed = f"   not seen beside another: {row['missed']}" if row["missed"] else ""
        print(f"    {f'{i} {name}' if name != 'nothing' else name:26s}{cells}{rest}{missed}")


def by_excess(used: list[dict[str, Any]]) -> None:
    """Outcomes by how far the whitened residual of the declared model exceeds the noise."""
    edges = (0.0, *EXCESS, np.inf)
    print("χ²/dof of the declared model: outcomes")
    for low, high in pairwise(edges):
        row = Counter(outcome(r) for r in used if low <= r["chi2"][0] < high)
        print(f"    {f'{low:g} to {high:g}':55s} {dict(row)}")


def rates(used: list[dict[str, Any]]) -> None:
    """Shares of right and wrong claims, with their 95 % intervals, of what there was to be seen."""
    there = [r for r in used if r["truth"] and outcome(r) != "unseen"]
    for what, those in (
        ("seen at all", there),
        (f"χ²/dof above {CLEAR:g}", [r for r in there if r["chi2"][0] > CLEAR]),
    ):
        if not those:
            continue
        print(f"of {len(those)} {what}:")
        for word, n in (
            ("right", sum(outcome(r) in RIGHT for r in those)),
            ("wrong", sum(outcome(r) == "WRONG" for r in those)),
        ):
            low, high = stats.binomtest(n, len(those)).proportion_ci(method="wilson")
            print(f"    {word:8s}{n} = {100 * n / len(those):.2f} % "
                  f"({100 * low:.2f} to {100 * high:.2f})")  # fmt: skip


def report(records: list[dict[str, Any]]) -> None:
    used = [r for r in records if "verdict" in r]
    print(f"{len(records)} campaigns: {len(used)} diagnosed, "
          f"{sum('skipped' in r for r in records)} skipped, "
          f"{sum('error' in r for r in records)} refused or failed")  # fmt: skip
    for text, n in Counter(r["error"][:100] for r in records if "error" in r).most_common(8):
        print(f"    {n} × {text}")
    print("outcomes:", dict(Counter(outcome(r) for r in used)))
    if not used:
        return
    rates(used)
    print(f"CPU s a diagnosis: median {np.median([r['cpu_s'] for r in used]):.1f}, "
          f"largest {max(r['cpu_s'] for r in used):.1f}")  # fmt: skip
    print("effect (variant): outcomes")
    table: dict[str, Counter[str]] = {}
    for r in used:
        key = " + ".join(sorted(f"{t['effect']}/{t['variant']}" for t in r["truth"])) or "none"
        table.setdefault(key, Counter())[outcome(r)] += 1
    for key, row in sorted(table.items()):
        print(f"    {key:55s} {dict(row)}")
    confusion(used)
    by_excess(used)
    intervals(used)
    for r in used:
        if outcome(r) == "WRONG":
            print("wrong:", r["seed"], r["truth"], "claimed", r["claimed"], "χ²/dof", r["chi2"])


def code() -> str:
    """Which state of `identify` diagnosed: lines of another are not counted with these.

    How a result is shown (`identify/report`) is no part of it.
    """
    digest = hashlib.sha256()
    root = Path(identify.__file__).parent
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        if not name.startswith("report/"):
            digest.update(name.encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def read(file: Path, mode: str) -> list[dict[str, Any]]:
    """The lines of an earlier `--out` that are of this mode."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return [r for r in map(json.loads, lines) if r["mode"] == mode]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mode", choices=("clean", "effects", "leftout", *TURBULENT, *OWN_RIG))
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", help="effects whose key starts so")
    parser.add_argument("--given", action="store_true", help="no candidate but what is there")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, help="one JSON line a campaign; goes on where it ended")
    parser.add_argument("--again", type=Path, help="report on the lines of an earlier --out")
    given = parser.parse_args()
    if given.again is not None:
        report(read(given.again, given.mode))
        return 0
    same = {"code": code(), "only": given.only, "given": given.given}
    done = {}
    if given.out and given.out.exists():
        earlier = read(given.out, given.mode)
        done = {r["seed"]: r for r in earlier if same.items() <= r.items()}
    seeds = range(given.first, given.first + given.count)
    tasks = [(given.mode, s, given.only, given.given) for s in seeds if s not in done]
    pool = ProcessPoolExecutor(given.jobs)
    try:
        # as they end: a long one does not keep the lines of others from the file
        for i, ended in enumerate(as_completed([pool.submit(one, task) for task in tasks])):
            record = ended.result() | same
            done[record["seed"]] = record
            if given.out:
                with given.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(record) + "\n")
            if sys.stderr.isatty() or (i + 1) % 20 == 0:
                print(f"{i + 1}/{len(tasks)}", file=sys.stderr)
    finally:
        pool.shutdown(cancel_futures=True)
    report([done[seed] for seed in seeds])
    return 0


if __name__ == "__main__":
    sys.exit(main())
