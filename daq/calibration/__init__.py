"""What a channel's volts mean: measured, dated, with uncertainty, applied at analysis.

    pistonphone   a known level at one frequency            volts per pascal
    exchange      two microphones swapped in place          their relative response over frequency
    skew          one signal in two channels                the time between their samples
    response      stepped sine or sweep                     drive to pressure over frequency

Each gives a `Calibration` that the `CalibrationBook` keeps as a file; a run's header then carries
the values in force, or says that one is missing or stale. Raw samples stay raw.
"""

from daq.calibration.book import Calibration, CalibrationBook
from daq.calibration.exchange import Exchange, exchange_calibration
from daq.calibration.pistonphone import pistonphone
from daq.calibration.response import FrequencyResponse, stepped_sine, sweep
from daq.calibration.skew import Skew, inter_channel_skew, tolerable_skew

__all__ = [
    "Calibration",
    "CalibrationBook",
    "Exchange",
    "FrequencyResponse",
    "Skew",
    "exchange_calibration",
    "inter_channel_skew",
    "pistonphone",
    "stepped_sine",
    "sweep",
    "tolerable_skew",
]
