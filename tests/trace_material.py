"""Campaigns of the simulated rig with effects in it, and short ways to search them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from daq.importers import open_campaign
from identify import start, trace
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import by_key
from identify.effects.scatter import Scatter
from identify.executor import InProcess, Progress
from identify.fit import Fit
from identify.identification import Prepared, prepare
from identify.load import load_campaign
from identify.record import Campaign
from identify.structure import Structure
from identify.trace.under_way import UnderWay
from simulated_rig import build_config
from simulated_rig.campaigns import RecordedRun, simulate_campaign, write_campaign
from simulated_rig.config import RigConfig
from simulated_rig.effects import EFFECTS, make_effect
from simulated_rig.random_rigs import random_campaign, random_rig
from simulated_rig.seal import SealedEffect


def campaign(
    folder: Path,
    seed: int,
    key: str,
    drive_noise_v: float = 0.0,
    noise_db: float = 60.0,
    **parameters: float,
) -> Campaign:
    """A random two-mode rig with one effect: its campaign as read from disk."""
    rig = random_rig(seed, noise_db=noise_db, modes=(2,))
    effects = [make_effect(key, parameters)] if key else []
    rig, plan = random_campaign(seed, rig, effects, forced=9, validation=2)
    rig = replace(rig, converter=replace(rig.converter, drive_noise_v=drive_noise_v))
    write_campaign(simulate_campaign(rig, plan, seed, declared_modes=2), folder)
    return load_campaign(open_campaign(folder))


def recorded(folder: Path, seed: int, key: str, **parameters: float) -> tuple[Prepared, Fit]:
    """Such a campaign prepared, and the declared fit."""
    ready = prepare(campaign(folder, seed, key, **parameters))
    return ready, start.fit_from_data(ready.structure, ready.data)


def only(ready: Prepared, base: Fit, key: str) -> trace.Tried:
    """The best fit with that effect and no other tried."""
    found = trace.try_effects(
        ready.structure, ready.data, base, [by_key(key)], executor=InProcess(), keep=1,
        far=trace.astray(base), progress=lambda share, text: None,
    )  # fmt: skip
    return trace.started_again(found, ready.data, InProcess())[0]


def record(
    folder: Path,
    seed: int,
    rig: RigConfig,
    effects: Sequence[SealedEffect],
    *,
    forced: int,
    validation: int,
    cold: int = 0,
    modes: int = 2,
    change: Callable[[RecordedRun], RecordedRun] = lambda run: run,
) -> Prepared:
    """A random campaign on a rig with these effects, so many modes declared, each recording
    changed, written and read."""
    runs = {"forced": forced, "validation": validation, "cold": cold}
    rig, plan = random_campaign(seed, rig, effects, **runs)
    made = simulate_campaign(rig, plan, seed, declared_modes=modes)
    write_campaign(replace(made, runs=tuple(map(change, made.runs))), folder)
    return prepare(load_campaign(open_campaign(folder)))


def thesis_campaign(
    folder: Path,
    seed: int,
    effects: Mapping[str, dict[str, float]] | Sequence[tuple[str, dict[str, float]]],
    noise_db: float = 36.0,
    validation: int = 2,
    preset: str = "thesis-two-mode",
) -> Prepared:
    """The thesis's rig with these effects, recorded and prepared; two modes are declared."""
    pairs = effects.items() if isinstance(effects, Mapping) else effects
    made = [make_effect(key, parameters) for key, parameters in pairs]
    rig = build_config(preset, noise_db=noise_db)
    return record(folder, seed, rig, made, forced=7, validation=validation)


def altered_campaign(
    folder: Path,
    seed: int,
    change: Callable[[RecordedRun], RecordedRun],
    effects: Sequence[SealedEffect] = (),
) -> Prepared:
    """The thesis's rig, two modes declared, each of its recordings changed; of 24 bits, so that no
    change is lost between two counts."""
    rig = build_config(noise_db=36.0)
    rig = replace(rig, converter=replace(rig.converter, bits=24))
    return record(folder, seed, rig, effects, forced=7, validation=2, change=change)


def search_for(ready: Prepared, *keys: str) -> tuple[trace.Tried, list[trace.Tried]]:
    """The best explanation by these effects, and its rivals."""
    base = start.fit_from_data(ready.structure, ready.data)
    found = trace.search(ready.structure, ready.data, base, catalogue=[by_key(k) for k in keys])
    best = trace.best_form([t for t in found.tried if t.explains])
    return best, trace.rivals(best, found.tried)


def drawn_values(key: str) -> dict[str, float]:
    """The parameters of an effect of the rig, of a middling size."""
    drawn = EFFECTS[key].draw(np.random.default_rng(5), 0.5)
    return {name: float(p["value"]) for name, p in drawn.parameters().items()}


def fitted(parameters: int, chi2_per_dof: float) -> Fit:
    """A fit of 119 residuals of which only this is looked at."""
    dof, p = 119 - parameters, parameters
    none, rest = np.zeros((p, p)), np.zeros(119)
    chi2 = dof * chi2_per_dof
    return Fit(Structure(2), np.zeros(p), chi2, dof, none, rest, none, True, "", 1)


def of_runs(runs: int) -> Any:
    """Data of which only the number of forced runs is looked at, fitted and held out alike."""
    batch = SimpleNamespace(runs=runs, free=False)
    return SimpleNamespace(fit=(batch,), validation=(batch,))


def searching(
    base: Fit,
    report: Progress = lambda share, text: None,
    available: Sequence[Effect] = (),
    scatters: Sequence[Scatter] = (),
) -> UnderWay:
    """A search under way from there, on data of which nothing is looked at."""
    none = Dataset((), (), 0.0)
    return UnderWay(
        base.structure, none, base, InProcess(), report, tuple(available), (), tuple(scatters)
    )


class Supposed(trace.Tried):
    """A set of effects with a fit of which only the misfit and the count of numbers are given."""

    @cached_property
    def tuned_evidence(self) -> float:
        return self.evidence_of_all


def tried_as(fit: Fit, *keys: str) -> trace.Tried:
    """A set of effects with that fit, adequate on both kinds of runs."""
    return Supposed(tuple(by_key(k) for k in keys), fit, 1e-3, 0.5, 0.5)
