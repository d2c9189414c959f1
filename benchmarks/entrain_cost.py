"""What entrainment costs in rig time: prediction, the thesis's stepping, and an oracle.

    python benchmarks/entrain_cost.py [--rigs 100] [--near] [--out FILE] [--budget S]

On rigs drawn at random, with noise, ten conditions on both sides of the limit cycle are entrained
three times: by the predicting controller (which measures growth rate and twist first), by stepping
the amplitude, and by an oracle that is told each threshold and goes to 1.25 times of it at once.
All three verify by the same test and all pay for the free run. The true thresholds come from the
rig's own equations (stability of its forced orbits), which neither controller sees. Targets: at
most 1.5 times the oracle's time, at least 3 times faster than stepping, thresholds within 5 %
(once settled for a recording, which is when the free line's decay has been seen), and within two
of the standard errors stated with them in 95 %. With `--near` the ten conditions lie so close to
the limit cycle that its phase locks, and only the thresholds are looked at.
"""

import argparse
import json
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from draws import Record
from draws import run as run_draws

from daq.acquire import Acquisition
from daq.conduct import entrain, find_columns, measure_law
from daq.coupling import Coupling
from daq.entrain import Settings, Task, threshold_sigma
from daq.lockin import free_cycle
from daq.plan import integer_bin
from daq.tongue import Law
from simulated_rig.config import RigConfig
from simulated_rig.cycle import free_cycle as true_cycle
from simulated_rig.random_rigs import random_rig
from simulated_rig.rig import SimulatedRig
from simulated_rig.stability import lock_in_volts

OFFSETS = (-0.05, -0.038, -0.027, -0.017, -0.01, 0.008, 0.015, 0.025, 0.036, 0.048)
NEAR = (-0.004, -0.003, -0.0022, -0.0015, -0.0008, 0.0007, 0.0013, 0.002, 0.0028, 0.0037)
MARGIN = 1.25
FREE_S = 2.0


@dataclass(frozen=True)
class Cost:
    """One strategy on one rig: rig time, how many were entrained; of these the frequency, the
    relative error of the threshold and the standard error stated for it."""

    seconds: float
    entrained: int
    thresholds: tuple[tuple[float, float, float], ...]


def tasks(config: RigConfig, near: bool) -> list[tuple[float, float]]:
    """Frequency and true threshold of each condition."""
    free_hz = true_cycle(config.plant).frequency_hz
    found = []
    for offset in NEAR if near else OFFSETS:
        frequency, _ = integer_bin(
            free_hz * (1 + offset), config.sample_rate_hz, 10.0 if near else 2.0
        )
        found.append((frequency, true_threshold(config, frequency)))
    return found


def true_threshold(config: RigConfig, frequency_hz: float) -> float:
    """From the plant's equations; the bracket grows because strong forcing can destabilise."""
    low = 1e-3
    for _ in range(40):
        try:
            return lock_in_volts(config.plant, frequency_hz, low, 1.6 * low, tolerance=3e-3)
        except ValueError:
            low *= 1.6
    raise ValueError(f"no drive up to {low:g} V entrains {frequency_hz:g} Hz")


def run(
    config: RigConfig,
    seed: int,
    wanted: list[tuple[float, float]],
    strategy: str,
    settle: float = 1.0,
) -> Cost:
    """Entrain all conditions; nothing is recorded, and `settle` 1 is satisfied at once."""
    with SimulatedRig(config, seed) as rig:
        rig.start()
        acquisition = Acquisition(rig)
        columns = find_columns(acquisition)
        begun = rig.clock.now()
        stretch = acquisition.read_seconds(FREE_S)
        free = free_cycle(columns.pressure_of(stretch), rig.sample_rate_hz)
        settings = Settings(
            limit_v=rig.limits.max_amplitude_v,
            slew_v_per_s=rig.limits.max_slew_v_per_s,
            margin=MARGIN,
            settle=settle,
            strategy="step" if strategy == "step" else "predict",
        )
        law: Law | None = None
        if strategy == "predict":
            law = measure_law(acquisition, columns, free, settings)
        hints: dict[bool, Coupling] = {}
        drive, entrained, found = 0.0, 0, []
        for frequency, edge in wanted:
            side = frequency > free.frequency_hz
            task = Task(frequency, over_threshold=MARGIN)
            if strategy == "oracle":
                task = replace(task, amplitude_v=MARGIN * edge)
            hint = hints.get(side, hints.get(not side)) if strategy == "predict" else None
            state, command = entrain(
                acquisition,
                columns,
                task,
                free,
                settings,
                coupling_hint=hint,
                law=law,
                amplitude_v=drive,
            )
            drive = command.amplitude_v if command.kind == "record" else 0.0
            if command.kind == "record":
                entrained += 1
                error = (state.threshold_v or np.nan) / edge - 1
                found.append((frequency, error, threshold_sigma(state) or np.nan))
            if state.coupling is not None and state.threshold_v is not None:
                hints[side] = state.coupling
        return Cost(rig.clock.now() - begun, entrained, tuple(found))


def one(key: tuple[int, bool]) -> Record:
    """One rig, every strategy; near the limit cycle only the thresholds, once settled."""
    seed, near = key
    config = random_rig(seed, noise_db=(30.0, 60.0))
    wanted = tasks(config, near)
    costs = {"settled": run(config, seed, wanted, "predict", settle=2e-4)}
    if not near:
        costs |= {name: run(config, seed, wanted, name) for name in ("predict", "step", "oracle")}
    return {"modes": len(config.plant.modes), **{k: asdict(c) for k, c in costs.items()}}


def thresholds(records: list[Record], name: str) -> dict[str, float]:
    """How far off, and whether the standard errors say so."""
    rows = np.array([row for r in records for row in r[name]["thresholds"]])
    error = np.abs(rows[:, 1])
    return {
        "median": float(np.median(error)),
        "largest": float(np.max(error)),
        "within_5_percent": float(np.mean(error < 0.05)),
        "within_two_sigma": float(np.mean(error < 2 * rows[:, 2])),
        "median_sigma": float(np.median(rows[:, 2])),
    }


def report(records: list[Record], near: bool) -> None:
    """Medians over the rigs, and the shares of what went wrong."""
    said: Record = {"rigs": len(records), "cpu_s": round(sum(r["cpu_s"] for r in records), 1)}
    conditions = len(records) * len(OFFSETS)
    for name in ("settled",) if near else ("settled", "predict"):
        said[f"{name}_thresholds"] = thresholds(records, name)
        said[f"{name}_entrained"] = sum(r[name]["entrained"] for r in records) / conditions
    if not near:
        strategies = ("predict", "step", "oracle")
        time = {n: np.array([r[n]["seconds"] for r in records]) for n in strategies}
        over = time["predict"] / time["oracle"]
        said["oracle_entrained"] = sum(r["oracle"]["entrained"] for r in records) / conditions
        said["predict_over_oracle"] = {
            "median": np.median(over),
            "q95": np.quantile(over, 0.95),
            "total": time["predict"].sum() / time["oracle"].sum(),
            "share_below_1_5": np.mean(over <= 1.5),
        }
        saved = time["step"] / time["predict"]
        said["step_over_predict"] = {
            "median": np.median(saved),
            "smallest": np.min(saved),
            "share_above_3": np.mean(saved >= 3),
        }
    print(json.dumps(said, indent=1, default=float))
    for record in records:
        for frequency, error, sigma in record["settled"]["thresholds"]:
            if abs(error) > 0.05:
                print(f"rig {record['key'][0]}, {record['modes']} modes, {frequency:.1f} Hz: "
                      f"threshold {100 * error:+.1f} % (stated ± {100 * sigma:.1f} %)")  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rigs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--near", action="store_true")
    parser.add_argument("--out", type=Path, help="JSON lines, to go on from")
    parser.add_argument("--budget", type=float, help="CPU seconds at most")
    given = parser.parse_args()
    keys = [[seed, given.near] for seed in range(given.first, given.first + given.rigs)]
    report(run_draws("rigs", keys, one, given.out, given.budget), given.near)
    return 0


if __name__ == "__main__":
    sys.exit(main())
