"""Is the forcing what was asked for? Frequency, whole periods, amplitude, silence in free runs."""

from collections.abc import Sequence

import numpy as np

from identify.quality.findings import Severity, finding
from identify.quality.view import View
from identify.results import QualityFlag

WHOLE = 0.02  # periods by which a record may miss a whole number
LOST_BINS = 1.5  # between the strongest bin and the frequency found: that is another line
AMPLITUDE = 0.01  # relative difference from amplitude_v
ODD = 0.1  # … and of one run alone, by which it is spoilt
LEAK = 0.01  # of the forced runs' drive, in a free run
OTHER_SCALE = 10.0


def other_line(view: View) -> list[QualityFlag]:
    """`frequency_off_bin`, excluding: the drive's line is not where frequency_hz says."""
    nominal, drive = view.run.frequency_hz, view.drive
    if view.run.kind == "free" or nominal is None or drive is None:
        return []
    strongest = view.bin_hz * int(np.argmax(np.abs(np.fft.rfft(drive - np.mean(drive)))))
    if abs(strongest - view.frequency_hz) > LOST_BINS * view.bin_hz:
        detail = (
            f"the drive's line is at about {strongest:.2f} Hz, frequency_hz says {nominal:g}; "
            "correct frequency_hz or set the generator"
        )
        return [finding(view.name, "frequency_off_bin", "excluded", detail)]
    return []


def frequency(view: View) -> list[QualityFlag]:
    """`frequency_off_bin`: another than the nominal frequency, or no whole number of periods."""
    nominal = view.run.frequency_hz
    if view.run.kind == "free" or nominal is None:
        return []
    off = view.frequency_hz - nominal
    if abs(off) > 0.01 * view.bin_hz:
        detail = (
            f"the drive is at {view.frequency_hz:.4f} Hz, {off:+.2e} Hz from the nominal "
            f"{nominal:g} ({off / view.bin_hz:+.2f} bins); the measured frequency is used"
        )
        return [finding(view.name, "frequency_off_bin", "noted", detail)]
    periods = view.frequency_hz / view.bin_hz
    if abs(periods - round(periods)) > WHOLE:
        detail = (
            f"{periods:.2f} periods in the record, no whole number; coefficients are fitted "
            "instead of transformed: choose frequency or length so that it is whole"
        )
        return [finding(view.name, "frequency_off_bin", "noted", detail)]
    return []


def amplitudes(views: Sequence[View]) -> list[QualityFlag]:
    """`drive_amplitude`: the recorded drive against amplitude_v, run by run; the scale of a whole
    campaign (a divider not declared) is told from one run's."""
    asked = [
        (v, abs(v.coefficients[-1, 0]) / v.run.amplitude_v)
        for v in views
        if v.run.kind != "free" and v.run.amplitude_v
    ]
    if not asked:
        return []
    usual = float(np.median([r for _, r in asked]))
    odd = _odd_one([r for _, r in asked], usual)
    out = []
    for v, ratio in asked:
        if abs(ratio - 1) <= AMPLITUDE and ratio != odd:
            continue
        severity: Severity = "noted"
        flag, advice = "drive_amplitude", "the recorded drive is used"
        if len(asked) > 2 and not 1 / OTHER_SCALE < ratio / usual < OTHER_SCALE:
            flag, severity, advice = "swapped_channels", "excluded", "look for exchanged channels"
        elif ratio == odd:
            severity = "excluded"
            advice = "which of the two is wrong is not known: correct amplitude_v, or record again"
        detail = (
            f"the recorded drive is {ratio:.4g} times amplitude_v={v.run.amplitude_v:g}"
            f" (other runs: {usual:.4g}); {advice}"
        )
        out.append(finding(v.name, flag, severity, detail))
    return out


def _odd_one(ratios: Sequence[float], usual: float) -> float | None:
    """The one ratio that is far from all others, which agree."""
    odd = [r for r in ratios if abs(r / usual - 1) > AMPLITUDE]
    enough = len(ratios) > 3 and len(odd) == 1 and abs(odd[0] / usual - 1) > ODD
    return odd[0] if enough else None


def silence(views: Sequence[View]) -> list[QualityFlag]:
    """`drive_in_free_run`: a generator that was left on."""
    forced = [abs(v.coefficients[-1, 0]) for v in views if v.run.kind != "free"]
    out = []
    for v in views:
        if v.run.kind != "free" or v.drive is None or not forced:
            continue
        peak = float(np.sqrt(2) * np.std(v.drive))
        if peak > LEAK * float(np.median(forced)):
            detail = (
                f"the drive's amplitude is {peak:.3g} "
                f"(forced runs: {float(np.median(forced)):.3g}); switch the generator off"
            )
            out.append(finding(v.name, "drive_in_free_run", "excluded", detail))
    return out
