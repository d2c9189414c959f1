"""The data quality gate: silent on clean recordings, and every defect named where it is.

Sizes that must be found follow from the noise of the material (0.3 Pa a microphone beside 340 Pa
and more, rumble of some Pa below 60 Hz); sizes beneath are tested to harm nobody.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from identify.identification import prepare
from identify.quality import Quality, inspect, tones
from identify.record import Campaign, Medium, Run, Signal
from tests import quality_material
from tests.quality_material import (
    FREE_HZ,
    FREE_PA,
    RATE,
    Edit,
    campaign_of,
    clip,
    drop,
    edited,
    hold,
    line,
    one,
    pressures,
    repeat,
    run_of,
    transient,
)

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture(scope="module")
def clean() -> Campaign:
    return campaign_of(1)


def judged(campaign: Campaign, edit: Edit, number: int = 3) -> tuple[Quality, dict[str, str], str]:
    """The verdict on run `number` with the edit: all, its flags with severities, its name; the
    other runs must be free of flags."""
    found = inspect(edited(campaign, edit, number))
    name = campaign.runs[number].name
    assert {f.run for f in found.flags} <= {name}
    return found, {f.flag: f.severity for f in found.flags}, name


@pytest.mark.parametrize("seed", range(6))
def test_clean_recordings_raise_nothing(seed: int) -> None:
    assert inspect(campaign_of(100 + seed)) == Quality((), frozenset(), ())


@pytest.mark.parametrize("seconds", [1.0, 3.0])
def test_clean_recordings_of_other_lengths_raise_nothing(seconds: float) -> None:
    assert inspect(campaign_of(7, seconds)) == Quality((), frozenset(), ())


def test_noise_free_commensurate_recordings_raise_nothing(clean: Campaign) -> None:
    """200 Hz at 10 kHz: fifty values over and over, exact repeats and equal tops by right."""
    t = np.arange(20000) / 10000
    y = 800 * np.cos(2 * np.pi * 200 * t + 0.3)
    run = clean.runs[1]
    signals = {
        "p1": replace(run.signals["p1"], values=np.round(y / 0.15) * 0.15),
        "p2": replace(run.signals["p2"], values=np.round(1.05 * y / 0.15) * 0.15),
        "drive": replace(run.signals["drive"], values=np.sin(2 * np.pi * 200 * t)),
    }
    odd = replace(run, name="200Hz", signals=signals, frequency_hz=200.0, amplitude_v=1.0)
    found = inspect(replace(clean, runs=(*clean.runs, odd)))
    assert [f for f in found.flags if f.run == "200Hz"] == []


@pytest.mark.shared
@pytest.mark.parametrize(
    "case",
    [
        "a-clean",
        "b-flame-delay",
        "c-speaker-resonance",
        "d-extra-mode",
        "e-mic-skew",
        "f-drift",
    ],
)
def test_shared_recordings_raise_nothing(case: str) -> None:
    assert inspect(shared_case(case)) == Quality((), frozenset(), ())


def shared_case(case: str) -> Campaign:
    """A campaign folder of int16 recordings, read without the project's importers."""
    import tomllib

    from scipy.io import wavfile

    from identify.record import Medium, Run

    folder = SHARED / "cases" / case
    card = tomllib.loads((folder / "campaign.toml").read_text())
    runs = []
    for r in card["runs"]:
        rate, x = wavfile.read(folder / r["file"])
        signals = {}
        for j, c in enumerate(card["channels"]):
            full = c["full_scale_v"] / c["volts_per_unit"]
            signals[c["name"]] = Signal(
                x[:, j] * (full / 32768),
                c["quantity"],
                c["unit"],
                c.get("position_m"),
                full,
                full / 32768,
            )
        asked = r.get("frequency_hz"), r.get("amplitude_v")
        runs.append(Run(r["file"], r["kind"], rate, signals, *asked, r["started_s"]))
    return Campaign(case, tuple(runs), Medium(**card["medium"]))


@pytest.mark.parametrize("share", [0.9, 0.95, 0.99, 0.995])
def test_flat_tops_are_clipping(clean: Campaign, share: float) -> None:
    """Even 0.5 % of the peak cut costs (2/3π)(0.1 rad)³ = 2e-4 of a pressure, twenty times that of
    the two pressures' difference."""
    _, flags, _ = judged(clean, clip(share))
    assert flags == {"clipped": "excluded"}


def test_full_scale_is_clipping(clean: Campaign) -> None:
    """The converter's end, 5000 Pa, a little below the signal's peak."""
    run = clean.runs[3]
    p1 = run.signals["p1"]
    limit = 0.97 * float(np.abs(p1.values).max())
    signal = replace(p1, values=np.clip(p1.values, -limit, limit), full_scale=limit)
    runs = list(clean.runs)
    runs[3] = replace(run, signals={**run.signals, "p1": signal})
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [(f.run, f.flag) for f in found.flags] == [(run.name, "clipped")]
    assert "full scale" in found.flags[0].detail
    assert found.excluded == {run.name}


@pytest.mark.parametrize("channel", ["p1", "p2", "drive"])
def test_dead_channels_exclude(clean: Campaign, channel: str) -> None:
    _, flags, _ = judged(clean, one(channel, lambda x, t: 0 * x + 1.0))
    assert flags == {"dead_channel": "excluded"}


@pytest.mark.parametrize("channel", ["p1", "p2"])
@pytest.mark.parametrize("share", [1e-3, 0.03])
def test_a_channel_of_noise_alone_is_dead(clean: Campaign, channel: str, share: float) -> None:
    """An open input shows its offset and noise."""

    def open_input(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        noise = np.random.default_rng(3).standard_normal(x.size)
        return np.asarray(0.2 + share * float(np.std(x)) * noise)

    found, flags, _ = judged(clean, one(channel, open_input))
    assert flags["dead_channel"] == "excluded"
    assert any(f.flag == "dead_channel" and channel in f.detail for f in found.flags)


def test_a_first_run_that_is_excluded_ends_nothing(clean: Campaign) -> None:
    """The microphones had been those of the first run, usable or not."""
    first = clean.runs[0]
    alone = {n: s for n, s in first.signals.items() if n != "p2"}
    spoilt = replace(clean, runs=(replace(first, signals=alone), *clean.runs[1:]))
    ready = prepare(spoilt)
    assert ready.quality.excluded == {first.name}
    assert len(ready.measured) == len(clean.runs) - 1


def test_runs_of_unlike_rates_are_compared_as_far_as_they_go(clean: Campaign) -> None:
    """A free line above half the rate of all forced runs had raised an error."""

    def slower(run: Run) -> Run:
        signals = {n: replace(s, values=s.values[::10]) for n, s in run.signals.items()}
        return replace(run, signals=signals, sample_rate_hz=RATE / 10)

    t = np.arange(clean.runs[0].samples) / RATE
    high = {
        n: replace(s, values=np.asarray(0.05 * np.sin(2 * np.pi * 1700.0 * t) + 0 * s.values))
        for n, s in clean.runs[0].signals.items()
    }
    runs = (replace(clean.runs[0], signals=high), *map(slower, clean.runs[1:]))
    assert inspect(replace(clean, runs=runs)) is not None


def test_missing_and_broken_channels_exclude(clean: Campaign) -> None:
    def wreck(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        x[17] = np.nan
        return x

    assert judged(clean, one("p1", wreck))[1] == {"not_finite": "excluded"}
    runs = list(clean.runs)
    signals = dict(runs[2].signals)
    del signals["drive"]
    runs[2] = replace(runs[2], signals=signals)
    runs[4] = replace(runs[4], exit_status="aborted")
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [f.flag for f in found.flags] == ["missing_channel", "not_completed"]
    assert found.excluded == {runs[2].name, runs[4].name}


@pytest.mark.parametrize("number", [0, 3])
@pytest.mark.parametrize("samples", [1, 5, 50])
def test_lost_samples_are_found(clean: Campaign, samples: int, number: int) -> None:
    """One sample is 2π·168/10000 = 0.106 rad of phase; the pressure's noise per period, over three
    periods, some 1e-3 rad. Free runs have only the pressures to tell by."""
    found, flags, name = judged(clean, drop(samples), number)
    assert flags == {"dropped_samples": "excluded"}
    assert found.excluded == {name}


def test_gaps_noted_by_the_acquisition_exclude(clean: Campaign) -> None:
    runs = list(clean.runs)
    runs[2] = replace(runs[2], notes={"gaps": [[500, 64]]})
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [(f.flag, f.severity) for f in found.flags] == [("dropped_samples", "excluded")]


@pytest.mark.parametrize("samples", [16, 64, 256])
def test_repeated_buffers_are_found(clean: Campaign, samples: int) -> None:
    found, flags, name = judged(clean, repeat(samples))
    assert flags.keys() <= {"repeated_samples", "dropped_samples"}
    assert found.excluded == {name}


@pytest.mark.parametrize("channel", ["p1", "p2"])
@pytest.mark.parametrize(("number", "samples"), [(0, 3), (3, 1), (3, 7), (4, 25)])
def test_samples_lost_in_one_channel_are_no_beating(
    clean: Campaign, channel: str, number: int, samples: int
) -> None:
    """Channels of two devices: a step's side lines are not taken for a cycle that goes on."""

    def change(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.r_[np.delete(x, np.s_[9000 : 9000 + samples]), x[: -samples - 1 : -1]]

    found, flags, name = judged(clean, one(channel, change), number)
    assert flags == {"dropped_samples": "excluded"}
    (flag,) = found.flags
    assert flag.detail.startswith(f"{channel}: the phase steps by +")
    assert found.excluded == {name}


@pytest.mark.parametrize(("samples", "severity"), [(6, "down_weighted"), (40, "excluded")])
def test_held_samples_are_found(clean: Campaign, samples: int, severity: str) -> None:
    assert judged(clean, hold(samples))[1] == {"repeated_samples": severity}


@pytest.mark.parametrize(
    ("db", "severity"),
    [(-6, "excluded"), (-10, "excluded"), (-18, "excluded"), (-25, "down_weighted"), (-45, None)],
)
def test_side_lines_near_the_free_frequency(
    clean: Campaign, db: float, severity: str | None
) -> None:
    """Twenty decibels below the free run's level is the thesis's limit."""
    found, flags, name = judged(clean, line(FREE_HZ, FREE_PA * 10 ** (db / 20), 1.047), 4)
    assert flags == ({} if severity is None else {"incompletely_entrained": severity})
    assert set(found.doubted) == ({name} if severity == "down_weighted" else set())
    assert all(5e-3 < error < 5e-2 for error in found.doubted.values())


def test_a_run_that_does_not_lock(clean: Campaign) -> None:
    """The free cycle goes on beside a weak forced response."""

    def change(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return 0.2 * x + FREE_PA * np.cos(2 * np.pi * FREE_HZ * t)

    found, flags, name = judged(clean, pressures(change))
    assert flags == {"not_entrained": "excluded"}
    assert found.excluded == {name}


@pytest.mark.parametrize(
    ("size", "seconds", "severity"),
    [
        (1e-3, 0.2, None),
        (1e-2, 0.6, "excluded"),
        (3e-2, 0.2, "excluded"),
        (1e-1, 0.2, "excluded"),
    ],
)
def test_settling_runs(clean: Campaign, size: float, seconds: float, severity: str | None) -> None:
    """A decay shifts the coefficient by size·τ/T: 1e-4 (harmless), 3e-3, 3e-3 and 1e-2."""
    _, flags, _ = judged(clean, transient(size, seconds))
    assert flags == ({} if severity is None else {"unsettled": severity})


@pytest.mark.parametrize("seconds", [0.03, 0.06])
def test_a_phase_that_settles_has_lost_no_samples(clean: Campaign, seconds: float) -> None:
    """As where the drive begins just before the recording: it had been called dropped samples."""

    def change(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.asarray(CubicSpline(t, x)(t + 4e-4 * np.exp(-t / seconds)))

    assert judged(clean, pressures(change))[1] == {"unsettled": "excluded"}


@pytest.mark.parametrize(("part", "words"), [(np.s_[:1500], "first"), (np.s_[-1500:], "last")])
def test_a_drive_that_comes_late_or_goes_early(clean: Campaign, part: slice, words: str) -> None:
    """Its silence had been called a stuck converter."""

    def change(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        x[part] = 0.0
        return x

    found, flags, _ = judged(clean, one("drive", change))
    assert flags["unsettled"] == "excluded"
    assert "repeated_samples" not in flags
    assert any(f"drive is silent for the {words} 0.1" in f.detail for f in found.flags)


def test_the_ringing_of_a_quiet_rig_is_no_limit_cycle(clean: Campaign) -> None:
    """It dies away, a thousand times below what is forced: nearly all of its velocity is noise,
    by whose measure its fall would do no harm."""
    rng = np.random.default_rng(3)

    def ring(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        noise = 0.03 * rng.standard_normal(t.size)
        return 0.2 * np.exp(-t / 2.5) * np.cos(2 * np.pi * FREE_HZ * t) + noise

    found = inspect(edited(clean, pressures(ring), 0))
    assert [(f.run, f.flag, f.severity) for f in found.flags] == [("free", "unsettled", "excluded")]


def test_a_slow_drift_excludes_nothing(clean: Campaign) -> None:
    """A per cent in the run: the mean is that of its middle. 0.6 % in 1200 s is not even seen."""
    found, flags, _ = judged(clean, pressures(lambda x, t: x * (1 + 0.005 * t)))
    assert flags == {"drift_inside_run": "down_weighted"}
    assert not found.excluded
    slow = edited(clean, pressures(lambda x, t: x * (1 + 5e-6 * t)))
    assert inspect(slow) == Quality((), frozenset(), ())


@pytest.mark.parametrize(
    ("frequency", "flag"), [(50.0, "mains_hum"), (180.0, "mains_hum"), (433.3, "foreign_tone")]
)
def test_a_tone_in_every_run_is_interference(clean: Campaign, frequency: float, flag: str) -> None:
    """Amplitude of the velocity: (1 − 0.7)·p/(ρ Δx ω), Eq. 5.2; noise 0.02 Pa a bin and channel
    (white) or 0.1 (rumble) against 2 Pa: 5 % of it."""
    pascal = 2.0
    found = inspect(edited(clean, line(frequency, pascal)))
    assert not found.excluded
    assert [t.frequency_hz for t in found.tones] == [pytest.approx(frequency, abs=0.1)]
    tone = found.tones[0]
    assert 0 < tone.frequency_stderr_hz < 0.02  # of bins of half a hertz
    assert abs(tone.frequency_hz - frequency) < 3 * tone.frequency_stderr_hz
    expected = 0.3 * pascal / (1.2 * 0.0508 * 2 * np.pi * frequency)
    assert tone.amplitude == pytest.approx(expected, rel=0.05)
    assert tone.unit == "m/s"
    assert tone.p_value < 1e-6
    assert {f.flag for f in found.flags} == {flag}
    assert {f.severity for f in found.flags} == {"noted"}
    assert {f.run for f in found.flags} == set(tone.runs)
    assert len(tone.runs) >= 4


def test_hum_in_a_quiet_free_run_is_no_limit_cycle(clean: Campaign) -> None:
    """The strongest line of a rig that does not sing: it stands as high in every forced run."""
    rng = np.random.default_rng(3)
    silent = edited(clean, pressures(lambda x, t: 0.3 * rng.standard_normal(t.size)), 0)
    found = inspect(edited(silent, line(50.0, 20.0)))
    assert found.excluded == {"free"}
    (flag,) = (f for f in found.flags if f.run == "free")
    assert flag.flag == "no_limit_cycle"
    assert "50.00 Hz, stands as high in 6 forced runs of 6" in flag.detail
    assert [t.frequency_hz for t in found.tones] == [pytest.approx(50.0, abs=0.1)]


@pytest.mark.parametrize(
    ("frequency", "run", "order"), [(504.3, "168Hz", 3), (509.4, "free", 3), (339.2, "free", 2)]
)
def test_a_tone_on_a_harmonic_counts_there_as_noise(
    clean: Campaign, frequency: float, run: str, order: int
) -> None:
    """Three times 168 and, within 0.3 Hz, three and two times 169.7 Hz. At the free cycle's
    harmonics, and where they combine with the drive's, a tone is told from the cycle in the forced
    runs, in which the cycle's fundamental is gone."""
    found = inspect(edited(clean, line(frequency, 2.0)))
    assert [t.frequency_hz for t in found.tones] == [pytest.approx(frequency, abs=0.1)]
    spoilt = {f.run: f for f in found.flags if f.flag == "tone_on_harmonic"}
    assert list(spoilt) == [run]
    assert spoilt[run].harmonics == (order,)
    assert spoilt[run].severity == "down_weighted"
    assert spoilt[run].to_json()["harmonics"] == [order]
    assert not found.doubted  # the run's other harmonics are as good as ever


@pytest.mark.parametrize("frequency", [165.5, 172.3])
def test_a_tone_among_the_forcing_frequencies_stands_still(
    clean: Campaign, frequency: float
) -> None:
    """In one run it might be what drive and free cycle combine to; that moves with the drive."""
    found = inspect(edited(clean, line(frequency, 1.0)))
    assert [t.frequency_hz for t in found.tones] == [pytest.approx(frequency, abs=0.05)]
    spoilt = {f.run for f in found.flags if f.flag == "tone_on_harmonic"}
    assert spoilt == {min(clean.runs[1:], key=lambda r: abs(r.frequency_hz - frequency)).name}
    assert not found.excluded


def test_a_multiple_of_the_mains_is_believed_where_one_run_shows_it() -> None:
    """Forced at and around 180 Hz: of its third multiple only the free run shows anything."""
    rng = np.random.default_rng(8)
    runs = [run_of("free", None, 0.0, rng)]
    runs += [run_of(f"{f:g}Hz", f, 3.0, rng) for f in (178.0, 179.0, 180.0, 181.0, 182.0)]
    quiet = Campaign("around 180 Hz", tuple(runs), Medium())
    third = edited(quiet, line(180.0, 1.0))
    assert inspect(third).tones == ()  # by itself it might be anything
    found = inspect(edited(third, line(60.0, 2.0)))
    assert [t.frequency_hz for t in found.tones] == [
        pytest.approx(60.0, abs=0.1),
        pytest.approx(180.0, abs=0.1),
    ]
    assert found.tones[1].runs == ("free",)
    spoilt = [(f.run, f.harmonics) for f in found.flags if f.flag == "tone_on_harmonic"]
    assert ("180Hz", (1,)) in spoilt


def test_a_multiple_of_the_mains_that_no_run_could_show_is_supposed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A free cycle of 149.6 Hz hides 150 Hz in every run; forced there, one run's fundamental
    counts for less. That it is there is not claimed."""
    monkeypatch.setattr(quality_material, "FREE_HZ", 149.6)
    rng = np.random.default_rng(8)
    runs = [run_of("free", None, 0.0, rng)]
    runs += [run_of(f"{f:g}Hz", f, 3.0, rng) for f in (146.0, 148.0, 150.0, 152.0, 155.0)]
    found = inspect(edited(Campaign("around 150 Hz", tuple(runs), Medium()), line(50.0, 2.0)))
    assert [t.frequency_hz for t in found.tones if not t.supposed] == [pytest.approx(50, abs=0.1)]
    supposed = [round(t.frequency_hz) for t in found.tones if t.supposed]
    assert supposed == [150, 300, 450, 600]  # each beside a harmonic of the free cycle
    assert found.tones[1].amplitude == pytest.approx(found.tones[0].amplitude / 3, rel=1e-3)
    spoilt = {f.run: f for f in found.flags if f.flag == "tone_on_harmonic"}
    assert set(spoilt) == {"150Hz", "free"}
    assert "unseen in any run" in spoilt["150Hz"].detail


@pytest.mark.parametrize(("frequency", "believed"), [(50.0, True), (60.0, True), (57.3, False)])
def test_faint_hum_is_believed_where_another_tone_would_not_be(
    clean: Campaign, frequency: float, believed: bool
) -> None:
    """No run shows it by itself; at a frequency of the mains, most runs together do."""
    found = inspect(edited(clean, line(frequency, 0.26)))
    assert [round(t.frequency_hz) for t in found.tones] == ([frequency] if believed else [])


@pytest.mark.parametrize(("frequency", "believed"), [(50.0, True), (57.3, False)])
def test_hum_of_which_many_runs_are_sure_together(frequency: float, believed: bool) -> None:
    """Of sixteen runs fewer than half have it beyond doubt (55088: one of 0.36 Pa, not named)."""
    rng = np.random.default_rng(2)
    forced = [(142.0 + 2.3 * k, 3.0) for k in range(15)]
    runs = [run_of("free", None, 0.0, rng)]
    runs += [run_of(f"{f:g}Hz", f, volts, rng) for f, volts in forced]
    found = inspect(edited(Campaign("many", tuple(runs), Medium()), line(frequency, 0.16)))
    assert [round(t.frequency_hz) for t in found.tones] == ([frequency] if believed else [])


@pytest.mark.parametrize(
    ("at_bins", "amplitude", "believed"),
    [
        ((0.3, -0.3, 0.1, -0.2), (1.0, 2.4, 0.7, 1.9), False),  # a resonance in noise
        ((0.01, 0.0, 0.02, 0.01), (1.0, 2.4, 0.7, 1.9), True),  # a tone more or less near
        ((0.3, -0.3, 0.1, -0.2), (1.0, 1.1, 0.9, 1.0), True),  # a fan
        ((0.3, -0.3), (1.0, 2.4), True),  # two runs say nothing
    ],
)
def test_what_is_shaken_by_noise_is_no_tone(
    at_bins: tuple[float, ...], amplitude: tuple[float, ...], believed: bool
) -> None:
    """A lightly damped mode stood within a bin of one place in most of thirteen runs (56426)."""
    assert tones.shaken(np.array(at_bins), np.array(amplitude)) is not believed


def test_a_tone_in_one_run_is_no_interference(clean: Campaign) -> None:
    found, flags, _ = judged(clean, line(433.3, 2.0))
    assert flags == {"foreign_tone": "noted"}
    assert found.tones == ()


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (0.3, "grows at (.*) ± (.*) 1/s: a mode that begins to sing beside the forcing; lower"),
        (-0.6, "dies away at (.*) ± (.*) 1/s: a mode that still rings; wait longer"),
    ],
)
def test_a_line_that_grows_or_dies_away_is_a_mode_of_the_rig(
    clean: Campaign, rate: float, words: str
) -> None:
    """The thesis's rig at 5 V and 164 Hz: its second mode, from 0.7 to 0.9 Pa within a second,
    had been a tone whose source one was to look for."""

    def mode(name: str, x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return x + line(284.35, 1.0)(name, 0 * x, t) * np.exp(rate * t)

    found, flags, _ = judged(clean, mode)
    assert flags == {"another_oscillation": "noted"}
    told = re.search(words, found.flags[0].detail)
    assert told is not None, found.flags[0].detail
    value, stderr = (float(x) for x in told.groups())
    assert abs(value - abs(rate)) < 3 * stderr
    assert stderr < abs(rate) / 10


def test_beating_in_several_runs_is_no_interference(clean: Campaign) -> None:
    """The free cycle's line and its combinations with the drive's, at the same place in all."""

    def beat(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        free = 2 * np.pi * FREE_HZ * t
        return x + 30 * np.cos(free) + 2 * np.cos(2 * free) + np.cos(3 * free)

    found = inspect(edited(clean, pressures(beat), 1, 2, 3, 4, 5, 6))
    assert found.tones == ()


def test_another_mode_that_sings_beside_the_forcing(clean: Campaign) -> None:
    """A far line with its combinations excludes; the same line without them is only a tone."""
    drive = clean.runs[3].frequency_hz
    assert drive is not None
    mixed = ((263.3, 100.0), (263.3 - drive, 10.0), (263.3 + drive, 10.0))

    def sing(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return x + sum(a * np.cos(2 * np.pi * f * t) for f, a in mixed)

    _, flags, _ = judged(clean, pressures(sing))
    assert flags["another_oscillation"] == "excluded"
    _, flags, _ = judged(clean, line(263.3, 100.0))
    assert "another_oscillation" not in flags


def test_modulated_runs_are_quasi_periodic(clean: Campaign) -> None:
    def modulate(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return x * (1 + 0.3 * np.cos(2 * np.pi * 23.7 * t))

    _, flags, _ = judged(clean, pressures(modulate))
    assert flags["quasi_periodic"] == "excluded"


@pytest.mark.parametrize("channel", ["p1", "p2"])
def test_an_inverted_microphone(clean: Campaign, channel: str) -> None:
    assert judged(clean, one(channel, lambda x, t: -x))[1] == {"inverted_channel": "excluded"}


def test_an_inverted_drive(clean: Campaign) -> None:
    """Told from three like runs: those whose forcing is on the same side of the free frequency."""
    rng = np.random.default_rng(8)
    more = (run_of("165Hz", 165.0, 1.8, rng), run_of("163Hz", 163.0, 2.2, rng))
    campaign = replace(clean, runs=(*clean.runs, *more))
    assert inspect(campaign) == Quality((), frozenset(), ())
    assert judged(campaign, one("drive", lambda x, t: -x), 2)[1] == {"inverted_channel": "excluded"}


def test_every_microphone_inverted(clean: Campaign) -> None:
    found = inspect(edited(clean, one("p2", lambda x, t: -x)))
    assert found.excluded == {r.name for r in clean.runs}


def test_exchanged_microphones(clean: Campaign) -> None:
    runs = list(clean.runs)
    s = runs[3].signals
    swapped = {
        "p1": replace(s["p1"], values=s["p2"].values),
        "p2": replace(s["p2"], values=s["p1"].values),
    }
    runs[3] = replace(runs[3], signals={**s, **swapped})
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [(f.run, f.flag) for f in found.flags] == [(runs[3].name, "swapped_channels")]


def test_frequency_and_amplitude_that_were_not_asked_for(clean: Campaign) -> None:
    runs = list(clean.runs)
    runs[2] = replace(runs[2], frequency_hz=166.02)  # the drive is at 166
    runs[3] = replace(runs[3], amplitude_v=0.63)  # it has 0.6 V
    runs[4] = replace(runs[4], frequency_hz=181.0)  # it is at 171
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [(f.run, f.flag, f.severity) for f in found.flags] == [
        (runs[2].name, "frequency_off_bin", "noted"),
        (runs[3].name, "drive_amplitude", "noted"),
        (runs[4].name, "frequency_off_bin", "excluded"),
    ]


def test_one_drive_far_from_what_was_asked(clean: Campaign) -> None:
    """By a fifth, where all others agree: the run is spoilt, whichever of the two is wrong; of two
    such runs neither is."""
    runs = list(clean.runs)
    runs[3] = replace(runs[3], amplitude_v=0.5)  # it has 0.6 V
    found = inspect(replace(clean, runs=tuple(runs)))
    assert [(f.run, f.flag, f.severity) for f in found.flags] == [
        (runs[3].name, "drive_amplitude", "excluded")
    ]
    assert "record again" in found.flags[0].detail
    runs[5] = replace(runs[5], amplitude_v=0.9 * (runs[5].amplitude_v or 1.0))
    both = inspect(replace(clean, runs=tuple(runs))).flags
    assert [(f.flag, f.severity) for f in both] == [("drive_amplitude", "noted")] * 2


def test_free_runs_that_are_none(clean: Campaign) -> None:
    """The generator left on; and a rig that does not oscillate."""
    on = one("drive", lambda x, t: x + np.sin(2 * np.pi * 168 * t))
    assert judged(clean, on, 0)[1] == {"drive_in_free_run": "excluded"}
    rng = np.random.default_rng(5)
    noise = pressures(lambda x, t: 3.0 * rng.standard_normal(x.size))
    assert judged(clean, noise, 0)[1] == {"no_limit_cycle": "excluded"}


def test_the_highest_bin_of_noise_is_no_limit_cycle(clean: Campaign) -> None:
    """At 22 Hz there are few bins, of which the highest has half of the power."""
    rng = np.random.default_rng(2)
    tone = pressures(
        lambda x, t: 0.3 * rng.standard_normal(t.size) + 0.016 * np.cos(2 * np.pi * 22 * t)
    )
    found, flags, _ = judged(clean, tone, 0)
    assert flags == {"no_limit_cycle": "excluded"}
    assert "22.0 Hz, has 52 %" in found.flags[0].detail


def test_what_toggles_from_sample_to_sample_is_no_limit_cycle(clean: Campaign) -> None:
    """At half the sample rate the phase of a line is lost, and so is its size."""
    rng = np.random.default_rng(3)
    toggling = pressures(
        lambda x, t: 0.3 * rng.standard_normal(t.size) + 0.03 * (-1.0) ** np.arange(t.size)
    )
    assert judged(clean, toggling, 0)[1] == {"no_limit_cycle": "excluded"}


def test_noise_at_low_frequency(clean: Campaign) -> None:
    rng = np.random.default_rng(6)
    wind = 2.0 * np.cumsum(rng.standard_normal(20000))
    wind -= np.linspace(wind[0], wind[-1], wind.size)
    _, flags, _ = judged(clean, pressures(lambda x, t: x + wind))
    assert flags["excess_low_frequency"] == "noted"


def test_records_that_are_too_short(clean: Campaign) -> None:
    brief = edited(clean, lambda name, x, t: x[:250], 3)
    assert "too_short" in {f.flag for f in inspect(brief).flags if f.severity == "excluded"}


def test_details_say_what_to_do(clean: Campaign) -> None:
    found, _, _ = judged(clean, clip(0.95))
    assert "p2" in found.flags[0].detail
    assert "record again" in found.flags[0].detail
