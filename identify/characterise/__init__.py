"""Characterises recordings of a self-excited oscillation that nothing forces."""

from identify.characterise.analysis import (
    characterise,
    characterise_file,
    characterise_recording,
    primary,
)
from identify.characterise.envelope import Estimate
from identify.characterise.figure import figure
from identify.characterise.read import Recording, RecordingError, read_text
from identify.characterise.result import Characterisation
from identify.characterise.stochastic import StochasticMode, identify_envelope

__all__ = [
    "Characterisation",
    "Estimate",
    "Recording",
    "RecordingError",
    "StochasticMode",
    "characterise",
    "characterise_file",
    "characterise_recording",
    "figure",
    "identify_envelope",
    "primary",
    "read_text",
]
