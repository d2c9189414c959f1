"""Data quality gate: what is wrong with each recording, before anything is fitted.

`inspect` names defects run by run, says which runs must not enter a fit, and finds tones that
stand in the channels whatever the rig does. A run is excluded only by what spoils its Fourier
coefficients; everything else is noted.
"""

from identify.quality.gate import Quality, inspect
from identify.quality.tones import Tone

__all__ = ["Quality", "Tone", "inspect"]
