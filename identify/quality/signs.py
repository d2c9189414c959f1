"""Swapped and inverted channels, told from the other runs of the campaign.

Two microphones a few centimetres apart see nearly the same pressure: h_k = p2/p1 at harmonic k is
near 1, nearly the same in all runs. An inverted one turns it by π at every harmonic (a node of
the sound between the microphones does so at one), an exchange makes it 1/h_k. Forced runs on the
same side of the free cycle's frequency answer their drive within a quarter turn of each other.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from identify.quality.entrainment import FreeLine
from identify.quality.findings import finding
from identify.quality.spectrum import floor
from identify.quality.view import View
from identify.results import QualityFlag

FloatArray = npt.NDArray[np.float64]
ComplexArray = npt.NDArray[np.complex128]

COMPARED = 3  # harmonics
CLEAR = 30.0  # amplitude over noise of a harmonic that is compared
NEAR_WAVES = 1.0  # largest wavenumber × spacing, rad
ALIKE = 0.15  # runs whose frequencies are within that share are compared
MOST_TURN = 2 * np.pi / 3  # beyond this an angle is a turned sign


def ratios(view: View) -> ComplexArray:
    """log h_k (COMPARED,) of the two microphones; nan where a harmonic is too weak."""
    out = np.full(COMPARED, np.nan, dtype=complex)
    if view.microphones is None:
        return out
    count = min(COMPARED, view.coefficients.shape[1])
    c = view.coefficients[:2, :count]
    for k in range(count):
        f = (k + 1) * view.frequency_hz
        b = round(f / view.bin_hz)
        beside = np.r_[max(b - 25, 1) : max(b - 5, 2), b + 5 : b + 25]
        beside = beside[beside < view.spectrum.shape[1]]
        noise = np.sqrt([floor(p) for p in np.abs(view.spectrum[:, beside]) ** 2])
        waves = 2 * np.pi * f / view.medium.sound_speed_m_s * view.microphones.spacing_m
        if np.all(np.abs(c[:, k]) > CLEAR * noise) and waves < NEAR_WAVES:
            out[k] = np.log(c[1, k] / c[0, k])
    return out


def microphones(views: Sequence[View]) -> list[QualityFlag]:
    """`inverted_channel` and `swapped_channels` of the two microphones."""
    table = np.array([ratios(v) for v in views]).reshape(len(views), COMPARED)
    turned = np.abs(table.imag) > MOST_TURN
    known = np.isfinite(table.real)
    wrong = [bool(np.all(t[k])) and k.sum() > 0 for t, k in zip(turned, known, strict=True)]
    several = [bool(w) and k.sum() > 1 for w, k in zip(wrong, known, strict=True)]
    out = []
    minority = 2 * sum(wrong) < len(views)
    for v, w, sure in zip(views, wrong, several, strict=True):
        if w and (minority or sure):
            names = " or ".join(v.inputs)
            detail = (
                f"{names}: the two microphones are in opposition at every harmonic, "
                + ("in the other runs they are not" if minority else "in most runs")
                + "; check polarity and the sign of volts_per_unit"
            )
            out.append(finding(v.name, "inverted_channel", "excluded", detail))
    places = np.log([v.frequency_hz for v in views])
    for i, v in enumerate(views):
        # the ratio depends on frequency: a cold run far away may well have the inverse one
        like = np.abs(places - places[i]) < ALIKE
        if not wrong[i] and exchanged(table[like], int(np.sum(like[:i]))):
            detail = (
                f"{v.inputs[0]} and {v.inputs[1]}: their ratio is the inverse of the other runs'; "
                "exchange them"
            )
            out.append(finding(v.name, "swapped_channels", "excluded", detail))
    return out


def exchanged(table: ComplexArray, i: int) -> bool:
    """Whether run i's log h_k (runs, K) is the negative of the other runs'."""
    others = np.delete(table, i, axis=0)
    enough = (np.isfinite(others.real).sum(axis=0) >= 3) & np.isfinite(table[i].real)
    if not enough.any():
        return False
    o = others[:, enough]
    usual = np.nanmedian(o.real, axis=0) + 1j * np.nanmedian(o.imag, axis=0)
    own = table[i, enough]
    spread = np.nanmedian(np.abs(o - usual), axis=0)
    same, opposite = np.linalg.norm(own - usual), np.linalg.norm(own + usual)
    return bool(opposite < 0.25 * same and same > 10 * np.linalg.norm(spread))


def drives(views: Sequence[View], free: FreeLine | None) -> list[QualityFlag]:
    """`inverted_channel` of the drive: the response is opposite to that of like runs."""
    forced = [v for v in views if v.run.kind == "forced"]
    if free is None or len(forced) < 4:
        return []
    side = np.array([v.frequency_hz > free.frequency_hz for v in forced])
    angle = np.array(
        [
            np.angle(v.coefficients[: len(v.inputs), 0].mean() / v.coefficients[-1, 0])
            for v in forced
        ]
    )
    out = []
    for i, v in enumerate(forced):
        like = (side == side[i]) & (np.arange(len(forced)) != i)
        if like.sum() < 3:
            continue
        mean = np.mean(np.exp(1j * angle[like]))
        apart = np.abs(np.angle(np.exp(1j * (angle[like] - np.angle(mean)))))
        own = abs(np.angle(np.exp(1j * (angle[i] - np.angle(mean)))))
        if apart.max() < np.pi / 4 and own > 0.75 * np.pi:
            detail = (
                f"drive: the response is {np.degrees(own):.0f}° from that of the other runs on the "
                "same side of the free frequency; check the polarity of drive and microphones"
            )
            out.append(finding(v.name, "inverted_channel", "excluded", detail))
    return out
