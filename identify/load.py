"""Reads a campaign from the run store's files into plain arrays.

The only module of `identify` that knows the run store, and it knows the files alone
(`daq/store_file.py`; docs/run-store.md describes them): `campaign.json`, and one HDF5 file a run in
`runs/`. Samples become physical values here: value = counts · volts_per_count / volts_per_unit,
and channels that are known to lag (`skew_s`) are moved forward by an eighth-point Lagrange filter,
whose error stays below 3e-5 up to a tenth of the sample rate.
"""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from identify.record import Campaign, DeclaredModel, FloatArray, Medium, Run, Signal

RUN_FORMAT = "entrain-run/1"
CARD_FORMAT = "campaign/1"


class LoadError(ValueError):
    """A campaign's folder or one of its files is not what the run store writes."""


def load_campaign(campaign_dir: Path | str) -> Campaign:
    """Read every completed run of a campaign.

    Parameters
    ----------
    campaign_dir
        The campaign's folder in a run store (``STORE/campaigns/ID``).

    Returns
    -------
    Campaign
        Runs in the order of their names, signals in physical units; runs that did not succeed
        are among them, marked by `exit_status`. Where the card says that it continues another
        campaign of the store (`notes.continues`), that one's runs come first, named ``id/name``.

    Raises
    ------
    LoadError
        Naming the file and what is wrong with it.
    """
    folder = Path(campaign_dir)
    card = _card(folder / "campaign.json")
    own = tuple(load_run(path) for path in sorted((folder / "runs").glob("*.h5")))
    medium = card.get("medium") or {}
    declared = dict(card.get("declared_model") or {})
    known = {key: declared.pop(key) for key in _DECLARED if key in declared}
    options = {**declared.pop("options", {}), **declared}
    return Campaign(
        title=str(card.get("title", folder.name)),
        runs=(*_earlier_runs(folder, card), *own),
        medium=Medium(**{key: float(value) for key, value in medium.items()}),
        declared_model=DeclaredModel(**known, options=options),
        identifier=str(card.get("id", folder.name)),
    )


def _earlier_runs(folder: Path, card: dict[str, Any]) -> tuple[Run, ...]:
    """Runs of all campaigns that this one continues, the first campaign's first."""
    found: tuple[Run, ...] = ()
    seen = {folder.name}
    while (earlier := (card.get("notes") or {}).get("continues")) is not None:
        name = str(earlier)
        if name in seen or Path(name).name != name:
            raise LoadError(f"{folder / 'campaign.json'}: continues={name!r} leads nowhere")
        seen.add(name)
        place = folder.parent / name
        card = _card(place / "campaign.json")
        runs = (load_run(path) for path in sorted((place / "runs").glob("*.h5")))
        found = (*(replace(run, name=f"{name}/{run.name}") for run in runs), *found)
    return found


_DECLARED = ("modes", "flame", "nonlinearity", "nonlinearity_degree")


def load_run(path: Path | str) -> Run:
    """Read one run file; raises `LoadError`."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            if file.attrs.get("format") != RUN_FORMAT:
                raise LoadError(
                    f"{path}: format={file.attrs.get('format')!r} is not {RUN_FORMAT!r}"
                )
            entry = dict(file["entry"].attrs)
            samples = file["entry/data/samples"]
            counts = samples[()]
            rate = float(samples.attrs["sample_rate_hz"])
            signals = {
                str(name): _signal(counts, dict(detector.attrs), rate)
                for name, detector in file["entry/instrument"].items()
            }
            gaps = file["entry/quality/gaps"][()]
            return _run(entry, rate, signals, gaps)
    except LoadError:
        raise
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        raise LoadError(
            f"{path}: not a readable run file ({error}); record or import the run again"
        ) from error


def _run(entry: dict[str, Any], rate: float, signals: dict[str, Signal], gaps: Any) -> Run:
    notes = json.loads(str(entry["notes"]))
    if len(gaps):
        notes["gaps"] = gaps.tolist()
    return Run(
        name=str(entry["title"]),
        kind=str(entry["kind"]),  # type: ignore[arg-type]  # written by the store, checked there
        sample_rate_hz=rate,
        signals=signals,
        frequency_hz=_optional(entry["frequency_hz"]),
        amplitude_v=_optional(entry["amplitude_v"]),
        started_s=float(entry["started_s"]),
        role=str(entry["role"]),  # type: ignore[arg-type]
        exit_status=str(entry["exit_status"]),
        notes={**notes, "exit_reason": str(entry["exit_reason"])},
    )


def _signal(counts: Any, detector: dict[str, Any], rate_hz: float) -> Signal:
    scale = float(detector["volts_per_count"]) / float(detector["volts_per_unit"])
    column = np.ascontiguousarray(counts[:, int(detector["column"])], dtype=np.float64)
    integer = np.issubdtype(counts.dtype, np.integer)
    return Signal(
        values=advanced(column * scale, float(detector.get("skew_s", 0.0)) * rate_hz),
        quantity=str(detector["quantity"]),
        unit=str(detector["units"]),
        position_m=_optional(detector["position_m"]),
        full_scale=abs(float(detector["full_scale_v"]) / float(detector["volts_per_unit"])),
        resolution=abs(scale) * _counts_a_step(column) if integer else _grid(column * scale),
    )


def _counts_a_step(counts: FloatArray) -> int:
    """How many counts the converter's step is: more than one where fewer bits than the file's are
    left-justified in it. Of thirty differences all are even by chance once in 2³⁰."""
    steps = np.diff(np.unique(counts)).astype(np.int64)
    return int(np.gcd.reduce(steps)) if steps.size >= 30 else 1


def _grid(values: FloatArray) -> float | None:
    """The converter's step in samples that a driver handed over as numbers; None: no grid.

    Values on a grid differ by whole multiples of their smallest difference; single precision
    blurs that by 1e-7 of the largest.
    """
    steps = np.diff(np.unique(values))
    steps = steps[steps > 4e-7 * np.max(np.abs(values), initial=0.0)]
    if not steps.size:
        return None
    step = float(steps.min())
    near = steps[steps < 5.5 * step] / step
    # thirty steps that all happen to be whole multiples to a tenth: once in 5^30
    return step if near.size > 30 and np.max(np.abs(near - np.round(near))) < 0.1 else None


def advanced(values: FloatArray, samples: float) -> FloatArray:
    """`values` as they would have been `samples` (any real number) later; the ends repeat.

    Lagrange interpolation on eight points: weights Π (d − m)/(n − m) at d = the fraction.
    """
    if samples == 0.0:
        return values
    whole = math.floor(samples)
    fraction = samples - whole
    nodes = np.arange(-3, 5)
    weights = np.array(
        [
            math.prod((fraction - m) / (n - m) for m in nodes.tolist() if m != n)
            for n in nodes.tolist()
        ]
    )
    reach = abs(whole) + 8
    padded = np.pad(values, reach, mode="edge")
    moved = np.correlate(padded, weights, mode="valid")  # moved[i] = Σ w_n padded[i + n]
    start = reach - 3 + whole
    return moved[start : start + values.size]


def _card(path: Path) -> dict[str, Any]:
    try:
        card = json.loads(path.read_text("utf-8"))
    except FileNotFoundError as error:
        raise LoadError(f"{path}: no such file; is this a campaign of a run store?") from error
    except (OSError, ValueError) as error:
        raise LoadError(f"{path}: not readable JSON ({error})") from error
    if not isinstance(card, dict) or card.get("format") != CARD_FORMAT:
        raise LoadError(f"{path}: format is not {CARD_FORMAT!r}")
    return card


def _optional(value: float) -> float | None:
    return None if math.isnan(value) else float(value)
