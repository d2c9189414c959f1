"""The residual's signature: on which harmonics, runs and kinds of run it lies, and along what.

A residual in even harmonics alone, or one that grows with the amplitude or the order of the runs,
tells an experimenter more than its size; no verdict rests on it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from identify import trace
from identify.chances import rank_correlation
from identify.results import Assessment


def signature(assessment: Assessment, scores: Mapping[str, trace.ScoreTest]) -> dict[str, Any]:
    """What the residual looks like: rms in noise units by harmonic, run, kind and parity, and the
    effects along whose tangents it lies (share of χ² that a small effect would take away)."""
    rows = [c for c in assessment.comparisons if c.role == "fit"]
    size = [np.abs(c.normalised) for c in rows]
    if not rows or not all(np.isfinite(s).all() for s in size):
        return {}
    table = np.stack([s[: min(len(q) for q in size)] for s in size])
    order = np.argsort([c.started_s for c in rows])
    by_run = np.sqrt(np.mean(table**2, axis=1))
    forced = [i for i, c in enumerate(rows) if c.kind == "forced"]
    out: dict[str, Any] = {
        "by_harmonic": [float(x) for x in np.sqrt(np.mean(table**2, axis=0))],
        "by_run": {c.run: float(x) for c, x in zip(rows, by_run, strict=True)},
        "odd": float(np.sqrt(np.mean(table[:, 0::2] ** 2))),
        "even": float(np.sqrt(np.mean(table[:, 1::2] ** 2))) if table.shape[1] > 1 else None,
    }
    for kind in ("forced", "free", "cold"):
        members = [i for i, c in enumerate(rows) if c.kind == kind]
        if members:
            out[kind] = float(np.sqrt(np.mean(table[members] ** 2)))
    if len(forced) >= 4:
        amplitude = [rows[i].amplitude_v for i in forced]
        asked = {
            "run_order": _rank_correlation(by_run[order], np.arange(len(order))),
            "amplitude": _rank_correlation(by_run[forced], np.array(amplitude)),
            "frequency": _rank_correlation(
                by_run[forced], np.array([rows[i].frequency_hz for i in forced])
            ),
        }
        out["correlation"] = {name: row for name, row in asked.items() if row is not None}
    total = float(np.sum(assessment.fit.residual**2))
    ranked = sorted(scores.items(), key=lambda item: -item[1].drop)[:8]
    out["tangents"] = {
        key: {"explains": s.drop / total, "unabsorbed": s.share, "p_value": s.p_value}
        for key, s in ranked
    }
    return out


def _rank_correlation(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> dict[str, float] | None:
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    rho, p = rank_correlation(a, b)
    return {"rho": rho, "p_value": p} if np.isfinite(rho) else None
