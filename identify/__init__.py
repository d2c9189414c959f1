"""Identification of a self-excited loop, and tracing of what its model lacks.

A pure library: arrays in, results out. `identify(campaign)` fits the declared model, `diagnose`
says what it lacks. See `identify.record` for what a campaign is, `identify.structure` for what a
model is made of, `identify.effects` for the candidates. What is where:

recordings      `record`, `load`, `quality`, `harmonics`, `linenoise`, `quantisation`, `dataset`
the loop        `pieces`, `effect`, `effects`, `structure`, `declare`, `parameters`, `dual`
steady states   `periods`, `polynomial`, `newton`, `balance`, `stability`, `lockin`
fits            `residual`, `descent`, `fit`, `start`, `profile`, `own`, `scatter`, `wander`,
                `drive`, `corrected`
judgement       `assess`, `whiteness`, `randomness`, `chances`, `trace`, `verdict`, `signature`
next runs       `reach`, `foresee`, `design`
in and out      `identification`, `diagnosis`, `results`, `report`, `export`, `statespace`,
                `executor`
beside these    `broadband` (one continuous record), `characterise` (no forcing), `thesis` (its
                own estimators)
"""

from identify.diagnosis import diagnose
from identify.effect import Effect
from identify.identification import identify
from identify.record import Campaign, DeclaredModel, Medium, Run, Signal
from identify.results import Assessment, Diagnosis, Identification
from identify.structure import Structure

__all__ = [
    "Assessment",
    "Campaign",
    "DeclaredModel",
    "Diagnosis",
    "Effect",
    "Identification",
    "Medium",
    "Run",
    "Signal",
    "Structure",
    "diagnose",
    "identify",
]
