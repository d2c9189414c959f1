"""`inspect`: all checks over all runs, each run only as far as it can be analysed."""

from dataclasses import dataclass

from identify.quality import (
    background,
    channels,
    entrainment,
    forcing,
    modulation,
    operating,
    samples,
    signs,
    steadiness,
)
from identify.quality.tones import Tone, on_harmonics, tones
from identify.quality.view import View, view
from identify.record import Campaign
from identify.results import QualityFlag


@dataclass(frozen=True)
class Quality:
    """What was found. `excluded`: names of runs that must not enter a fit; `tones`: foreign tones
    that most runs share."""

    flags: tuple[QualityFlag, ...]
    excluded: frozenset[str]
    tones: tuple[Tone, ...]

    @property
    def doubted(self) -> dict[str, float]:
        """Runs that enter a fit with less weight, all their harmonics, by name, and the relative
        error that they may have."""
        out: dict[str, float] = {}
        for f in self.flags:
            if f.severity == "down_weighted" and not f.harmonics:
                out[f.run] = max(f.error, out.get(f.run, 0.0))
        return out


def inspect(campaign: Campaign) -> Quality:
    """Find what is wrong with a campaign's recordings. Never raises for what a recording holds.

    A run is judged in the order in which one defect looks like another: lost samples make side
    lines, side lines look like foreign tones.
    """
    flags: list[QualityFlag] = operating.elsewhere(campaign)
    views: list[View] = []
    other = _excluded(flags)
    for run in campaign.runs:
        if run.name in other:
            continue
        found = channels.broken(run)
        flags += found
        if not found:
            views.append(view(run, campaign.medium))
    for v in views:
        flags += [*channels.weak(v), *channels.short(v), *channels.clipped(v)]
        flags += [*samples.recorded_gaps(v), *samples.held(v), *forcing.other_line(v)]
    flags += forcing.silence(views)
    good = _kept(views, flags)
    for v in good:
        flags += [*entrainment.quiet(v), *samples.repeated(v), *samples.lost_in_one(v)]
        if v.run.kind != "free":
            flags += samples.phase_steps(v, ["drive"])
    good = _kept(good, flags)
    flags += [f for v in good for f in forcing.frequency(v)]
    flags += forcing.amplitudes(good)
    flags += entrainment.foreign_cycle(good)
    good = _kept(good, flags)
    free = entrainment.free_line(good)
    for v in good:
        flags += entrainment.entrainment(v, free)
    good = _kept(good, flags)
    for v in good:
        flags += [*samples.phase_steps(v, v.inputs), *modulation.quasi_periodic(v)]
        flags += modulation.another_oscillation(v, free)
    good = _kept(good, flags)
    flags += [*signs.microphones(good), *signs.drives(good, free), *background.excess(good)]
    for v in good:
        flags += steadiness.steadiness(v)
    good = _kept(good, flags)
    found_tones, found = tones(good, free)
    flags += [*found, *on_harmonics(good, found_tones)]
    order = {run.name: i for i, run in enumerate(campaign.runs)}
    flags.sort(key=lambda f: order.get(f.run, -1))
    return Quality(tuple(flags), _excluded(flags), found_tones)


def _excluded(flags: list[QualityFlag]) -> frozenset[str]:
    return frozenset(f.run for f in flags if f.severity == "excluded")


def _kept(views: list[View], flags: list[QualityFlag]) -> list[View]:
    out = _excluded(flags)
    return [v for v in views if v.name not in out]
