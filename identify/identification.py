"""`identify`: a campaign in, the declared model's fit out, with everything needed to judge it.

Recordings → quality gate → Fourier coefficients with covariance → starts from the data →
maximum likelihood on the solved orbit → errors, uncertainties, the model's own limit cycle.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from identify import assess, corrected, dataset, drive, harmonics, profile, quality, start
from identify.dataset import Dataset
from identify.declare import ModelError
from identify.executor import InProcess, Progress
from identify.fit import Fit, failed, resolutions
from identify.harmonics import Harmonics
from identify.record import Campaign, DeclaredModel
from identify.results import Identification
from identify.structure import Structure
from identify.trace import astray, try_effects

FloatArray = npt.NDArray[np.float64]

DOUBT = 10.0  # times its noise that a run flagged as down-weighted is taken to err


@dataclass(frozen=True)
class Prepared:
    """A campaign ready to be fitted: its quality, measured harmonics and batches."""

    campaign: Campaign
    structure: Structure
    quality: quality.Quality
    measured: tuple[Harmonics, ...]
    data: Dataset


def declared_structure(model: DeclaredModel) -> Structure:
    """The structure that the experimenter believes.

    Raises
    ------
    ModelError : a word or number of the declared model is not known; says those that are.
    """
    flames = {"first_order_lowpass": 1, "second_order_lowpass": 2, "none": 0}
    delayed = model.flame.endswith("_delay")
    flame = model.flame.removesuffix("_delay").removesuffix("_with")
    if flame not in flames:
        raise ModelError(
            f"declared_model.flame={model.flame!r} is not one of {sorted(flames)}, "
            "with or without '_with_delay'"
        )
    try:
        return Structure(
            mode_count=model.modes,
            flame_order=int(model.options.get("flame_order", flames[flame])),
            flame_delay=delayed,
            nonlinearity=model.nonlinearity,
            degree=model.nonlinearity_degree,
            nodes=tuple(float(x) for x in model.options.get("nodes", ())),
        )
    except ValueError as error:
        raise ModelError(f"declared_model.{error}") from error


def prepare(campaign: Campaign, structure: Structure | None = None) -> Prepared:
    """Quality gate and Fourier coefficients of a campaign.

    Raises
    ------
    identify.harmonics.RecordError : a recording cannot be used; names run, channel and reason. Or
        none that was forced can: names what excludes each.
    ModelError : a declared model that is not known.
    """
    chosen = structure or declared_structure(campaign.declared_model)
    found = quality.inspect(campaign)
    tones = {t.frequency_hz: t.amplitude for t in found.tones}
    doubted = found.doubted
    measured = [
        h.doubted(DOUBT, doubted[h.name]) if h.name in doubted else h
        for h in harmonics.measure_campaign(campaign, skip=sorted(found.excluded), tones=tones)
    ]
    if not any(h.kind == "forced" and h.role == "fit" for h in measured):
        spoilt = [f for f in found.flags if f.run in found.excluded and f.severity == "excluded"]
        why = dict.fromkeys(f"{f.run}: {f.flag} ({f.detail})" for f in spoilt)
        raise harmonics.RecordError(
            f"campaign {campaign.title!r} has no usable forced run to fit on"
            + (f"; excluded are {'; '.join(why)}" if why else "; record at least one")
        )
    usable = next(r for r in campaign.runs if r.name == measured[0].name)
    mics = harmonics.microphones(usable)
    data = dataset.build(measured, campaign.medium, mics)
    chosen = replace(chosen, effects=data.among(chosen.effects))
    return Prepared(campaign, chosen, found, tuple(measured), data)


def identify(
    campaign: Campaign,
    *,
    structure: Structure | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Fit the declared model (or `structure`) to a campaign.

    A fit that does not converge says so in `assessment.fit.converged` and `.reason`; its
    parameters are then no answer. Raises what `prepare` raises.
    """
    began = time.perf_counter()
    report = progress or (lambda share, text: None)
    report(0.0, "measuring harmonics")
    ready = prepare(campaign, structure)
    report(0.2, "fitting the declared model")
    fit, data = fit_prepared(ready)
    report(0.9, "validating")
    assessment = replace(assess.assess(fit, data), lock_in=assess.lock_in((fit, data)))
    report(0.95, "intervals")
    bounds = profile.intervals(fit, data)
    report(1.0, "done")
    return Identification(
        campaign=campaign.identifier or campaign.title,
        declared_model=campaign.declared_model,
        assessment=assessment,
        quality=ready.quality.flags,
        seconds=time.perf_counter() - began,
        undetermined=undetermined(fit, data),
        intervals=bounds,
    )


def fit_prepared(ready: Prepared) -> tuple[Fit, Dataset]:
    """The fit of a campaign's structure, and the data with the noise as that fit corrects it."""
    fit = fit_structure(ready.structure, ready.data)
    data, fit = corrected.refitted(fit, ready.data)
    data, fit = drive.refitted(fit, data)
    return fit, data


def fit_structure(structure: Structure, data: Dataset) -> Fit:
    """The fit from data alone, of a structure with or without effects.

    Effects are added one after another to the fit without them, each led in from its own starts.
    """
    fit = start.fit_declared(replace(structure, effects=()), data)
    for effect in structure.effects:
        grown = try_effects(
            fit.structure,
            data,
            fit,
            [effect],
            executor=InProcess(),
            keep=1,
            far=not fit.converged or astray(fit),
            progress=lambda share, text: None,
        )
        if not grown:
            whole = len(structure.parameters)
            reason = f"no start exists with the element {effect.key!r}"
            return failed(structure, data, np.zeros(whole), reason)
        fit = grown[0].fit
    return fit


NOT_AT_ALL = 10.0  # standard deviations of a logarithm beyond which no factor is named


def undetermined(fit: Fit, data: Dataset, limit: float = 1.0) -> tuple[str, ...]:
    """Combinations of parameters that the data do not determine, as readable text.

    Right singular vectors of the whitened Jacobian in relative unknowns (the information's
    eigenvectors) along which the standard deviation exceeds `limit`: the fit may move so far along
    them without a misfit to be seen. A positive parameter moves by its own size, a signed one by
    the larger of its own and the size at which it would matter (`_sizes`).
    """
    if not fit.converged:
        return ()
    known = resolutions(fit.structure, fit.theta)
    asked = [i for i in range(fit.theta.size) if i not in known]
    names = [fit.structure.parameters.names[i] for i in asked]
    J = (fit.jacobian * _sizes(fit, data))[:, asked]
    _, sv, Vt = np.linalg.svd(J, full_matrices=False)
    out = []
    for s, v in zip(sv, Vt, strict=True):
        deviation = 1.0 / max(float(s), 1e-12)
        if deviation <= limit:
            continue
        first, *others = (int(i) for i in np.argsort(-np.abs(v))[:4])
        along = [
            f"{names[i]} (by {v[i] / v[first]:+.2g} times as much)".replace("-", "−")
            for i in others
            if abs(v[i]) > 0.2
        ]
        lost = deviation > NOT_AT_ALL
        how = "known not at all" if lost else f"known to a factor of {np.exp(deviation):.2g} only"
        moving = f", moved together with {', '.join(along)}" if along else ""
        out.append(f"{names[first]}{moving}: {how}")
    return tuple(out)


def _sizes(fit: Fit, data: Dataset) -> FloatArray:
    """How far each internal unknown must move to matter: 1 (in logarithm) for a positive one; for
    a residue the largest of its kind; for a coefficient c_d what makes c_d w^d as large as w."""
    parameters, values = fit.structure.parameters, fit.values
    largest_w = _largest_input(fit, data)
    out = []
    for q in parameters.parameters:
        size = abs(values[q.name])
        word = q.name.rpartition(".")[2]
        if word.endswith("_residue"):
            size = max(abs(v) for n, v in values.items() if n.endswith(word))
        elif q.name.startswith("nonlinearity.c"):
            size = max(size, largest_w ** (1 - int(word[1:])))
        elif q.name.startswith("nonlinearity.value"):
            size = max(size, largest_w)
        out.append(1.0 if q.kind == "positive" else max(size / q.scale, 1.0 if size == 0 else 0.0))
    return np.array(out)


def _largest_input(fit: Fit, data: Dataset) -> float:
    """Largest amplitude of the flame's input on the measured orbits (m)."""
    forced = [b for b in data.fit if not b.cold.all()]
    orbits = [assess.predict(fit.structure, fit.theta, b).orbits for b in forced]
    return max(float(np.max(np.abs(o.inputs[0]))) for o in orbits)
