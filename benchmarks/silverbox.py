"""The Silverbox, official split: simulation error of each stage from the linear model on.

    python benchmarks/silverbox.py [--declared linear|cubic|cubic_quadratic] [--json FILE]

The first 40 000 samples (the arrow) are the test and only ever predicted; their first 50 give the
initial state and do not count, as the benchmark's own rules have it. The ten multisine realisations
are fitted. Data: ../shared/measured/silverbox, or the folder in ENTRAIN_MEASURED_DATA.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from identify.broadband import BroadbandDiagnosis, Lines, diagnose_broadband, realisations

SAMPLE_RATE_HZ = 1e7 / 2**14
TEST = slice(0, 40_000)
ESTIMATION = slice(40_650, 127_400)
NOISE = slice(128_400, 131_000)  # the arrow's weak beginning once more, in neither set
LINES: Lines = realisations(40_586, 8692.6, 390, 8192, 10)


def data_file() -> Path:
    """Where the recording is expected."""
    default = Path(__file__).resolve().parents[2] / "shared" / "measured"
    return Path(os.environ.get("ENTRAIN_MEASURED_DATA", default)) / "silverbox" / "SNLS80mV.csv"


def load() -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Input and output, shape (131 072,), V."""
    table = np.genfromtxt(data_file(), delimiter=",", skip_header=1, usecols=(0, 1))
    return table[:, 0], table[:, 1]


def run(declared: str = "linear", max_effects: int = 6) -> BroadbandDiagnosis:
    """Diagnose the Silverbox with `declared` as the experimenter's belief."""
    u, y = load()
    return diagnose_broadband(
        u,
        y,
        SAMPLE_RATE_HZ,
        declared=declared,  # type: ignore[arg-type]
        estimation=ESTIMATION,
        test=TEST,
        lines=LINES,
        noise=NOISE,
        max_effects=max_effects,
        title="silverbox",
    )


def table(result: BroadbandDiagnosis) -> str:
    """Stages, residual by line sets, final parameters."""
    rows = [
        f"{'model':<54}{'par':>4}{'multisine':>11}{'arrow':>9}{'odd':>8}{'even':>8}{'>band':>8}"
    ]
    for stage in result.stages:
        name = f"declared: {result.declared}"
        if stage.added is not None:
            name = f"+ {stage.added.candidate.effect}: {stage.added.candidate.kind}"
        sets = stage.lines_rms
        rows.append(
            f"{name:<54}{stage.fit.theta.size:>4}{1e3 * stage.fit_rms:>11.4f}"
            f"{1e3 * stage.test_rms:>9.4f}"
            + "".join(
                f"{1e3 * sets[key]:>8.4f}" for key in ("odd_excited", "even", "odd_above_band")
            )
        )
    rest = result.remainder
    rows.append(
        f"all in mV RMS; noise {1e3 * (rest.noise_rms or 0):.4f}; verdict {result.verdict};"
        f" left {rest.chi2_per_dof:.2f} times the noise power, most in {rest.worst_band_hz} Hz;"
        f" {result.seconds:.1f} s"
    )
    for w in result.weighed:
        answer = "claimed" if w in result.claims else "not claimed"
        rows.append(
            f"  without {w.score.candidate.kind}: {w.without:.3g} times the excess: {answer}"
        )
    rows += [
        f"  {name:<40}{p['value']:>14.6g} ± {p['stderr']:<9.2g}{p['unit']}"
        for name, p in result.final.parameters.items()
    ]
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--declared", default="linear")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if not data_file().exists():
        parser.error(
            f"{data_file()} is missing; it is in ../shared/measured: put that beside the checkout, "
            "or name its place in ENTRAIN_MEASURED_DATA"
        )
    result = run(given.declared)
    print(table(result))
    if given.json is not None:
        given.json.write_text(json.dumps(result.to_json(), indent=2, allow_nan=False))


if __name__ == "__main__":
    main()
