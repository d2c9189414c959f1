"""Identification and tracing with arbitrary excitation: one oscillator, one feedback."""

from identify.broadband.candidates import Candidate, Score, candidates
from identify.broadband.diagnose import BroadbandDiagnosis, Stage, diagnose_broadband
from identify.broadband.fit import Fit, Whitener, fit
from identify.broadband.lines import Lines, realisations
from identify.broadband.model import NAMES, Excitation, Structure

__all__ = [
    "NAMES",
    "BroadbandDiagnosis",
    "Candidate",
    "Excitation",
    "Fit",
    "Lines",
    "Score",
    "Stage",
    "Structure",
    "Whitener",
    "candidates",
    "diagnose_broadband",
    "fit",
    "realisations",
]
