"""Two gross effects sought at once: each alone leads the search for the other astray."""

import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from daq.importers import open_campaign
from identify import balance, start, trace
from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects import CATALOGUE, by_key
from identify.executor import InProcess
from identify.fit import fit_orbits
from identify.identification import Prepared, prepare
from identify.load import load_campaign
from identify.start.rough import coarse
from identify.structure import MODAL, Structure
from identify.trace import law_steps, pairs
from identify.trace.contesting import DOUBT, one_more
from identify.trace.contests import NEAR, varied
from identify.trace.exchange import forms_in_place, joins
from identify.trace.fewer import with_fewer
from identify.trace.foreseen import foreseen
from identify.trace.pairs import STANDING, pairs_from_afar, representatives
from identify.trace.places import within_a_place
from identify.trace.restated import renamed
from identify.trace.sizes import known_sizes
from identify.trace.tried import best_form, tried
from simulated_rig.campaigns import RecordedRun
from simulated_rig.effects import make_effect
from simulated_rig.random_rigs import MOST_TWO, random_rig
from tests.trace_material import (
    altered_campaign,
    fitted,
    only,
    record,
    search_for,
    searching,
    thesis_campaign,
    tried_as,
)

FloatArray = npt.NDArray[np.float64]

pytestmark = pytest.mark.no_cover  # measuring coverage doubles the time; the cases do it

SHARED = Path(__file__).parents[2] / "shared" / "cases"
THIRD_MODE = {
    "frequency_hz": 393.86,
    "damping": 0.05,
    "flame_residue_ratio": 0.18,
    "speaker_residue_ratio": -0.06,
}
DELAY_S = 8e-4


@pytest.mark.slow
def test_a_further_mode_beside_another_gross_effect(tmp_path: Path) -> None:
    effects = {"acoustic_mode": THIRD_MODE, "flame_delay": {"delay_s": DELAY_S}}
    ready = thesis_campaign(tmp_path, 4, effects)
    base = start.fit_from_data(ready.structure, ready.data)
    said: list[str] = []
    keys = {"acoustic_mode:mode", "flame_delay"}
    others = {"flame_dynamics:pole", "nonlinearity_shape:quintic", "channel_mismatch:gain_skew"}
    found = pairs_from_afar(
        ready.structure, ready.data, base, [by_key(k) for k in sorted(keys | others)], [],
        InProcess(), lambda share, text: said.append(text),
    )  # fmt: skip
    best = trace.best_form([t for t in found if t.explains])
    assert {e.key for e in best.effects} == keys
    delay = best.estimates["flame_delay.delay_s"]
    assert abs(delay.value - DELAY_S) < 4 * delay.stderr
    assert said[0].startswith("seeking ")
    assert said[-1] == "refitting pairs"


def test_of_a_pair_of_many_values_each_is_tried_and_few_at_a_time(tmp_path: Path) -> None:
    """Three modes, and two delays that are each started from at 25 values: with the modes that do
    not sing anywhere, half a million starts. Every value is tried somewhere, and what is solved for
    at once behind an amplifier that clips (2048 samples a period) fits into little memory."""
    rig = random_rig(3005, noise_db=50.0, modes=(3,))
    ready = record(tmp_path, 3005, rig, [], forced=8, validation=2, modes=3)
    base, rough = start.fit_from_data(ready.structure, ready.data), ready.data.coarse()
    known = known_sizes(ready.data, base)
    delays = by_key("flame_delay"), by_key("actuator_dynamics:delay")
    pair = pairs._Pair(ready.structure, delays, ready.data, rough, known, ())
    found = pairs._anywhere(pair)
    inner = len(ready.structure.parameters)
    assert len({tuple(np.round(s.theta[inner:], 6)) for s in found}) == len(pair.proposals) == 625
    assert len(found) < 1.1 * 4 * pairs.PLACED  # each with flame residues of either sign
    clipped = ready.structure.with_effects(by_key("actuator_nonlinearity:clipping"))
    level = np.log(0.5 * known.drive_amplitude)
    starts = [np.r_[s.theta[:inner], level] for s in found[:1024]]
    tracemalloc.start()
    try:
        assert len(coarse(clipped, rough, starts)) > 900
        assert tracemalloc.get_traced_memory()[1] < 3e8  # of all at once 1.0e9
    finally:
        tracemalloc.stop()


@pytest.mark.slow
def test_where_no_single_effect_comes_near_pairs_are_sought_at_once(tmp_path: Path) -> None:
    """Sound that takes time from the cone to the tube, and a flame that answers late."""
    effects = {"actuator_dynamics/delay": {"delay_s": 5e-4}, "flame_delay": {"delay_s": DELAY_S}}
    ready = thesis_campaign(tmp_path, 4, effects)
    keys = ("actuator_dynamics:delay", "flame_delay")
    best, rivals = search_for(ready, *keys, "channel_mismatch:gain_skew")
    assert set(best.key_of_forms) == set(keys)
    assert rivals == []
    delay = best.estimates["flame_delay.delay_s"]
    assert abs(delay.value - DELAY_S) < 4 * delay.stderr


@pytest.mark.slow
def test_pairs_that_the_tangents_promise(tmp_path: Path) -> None:
    """A loss and a microphone's lag: the one alone leaves far more than others do; the tangents
    where it has ended tell that the other makes up for it (42077, 54169)."""
    effects = {
        "nonlinear_damping/cubic": {"cubic_s_per_m2": 10.0},
        "channel_mismatch/lowpass": {"lowpass_hz": 4000.0},
    }
    ready = thesis_campaign(tmp_path, 4, effects)
    base = start.fit_from_data(ready.structure, ready.data)
    keys = ("nonlinear_damping:cubic_end", "flame_delay", "channel_mismatch:lowpass")
    singles = [only(ready, base, key) for key in keys]
    others = (*keys, "sensor_offset:modal_2", "nonlinearity_shape:quintic")
    available, run = [by_key(k) for k in others], InProcess()
    found = foreseen(singles, ready.data, available, (), run)
    best = min(found, key=lambda t: t.fit.chi2)
    assert set(best.key_of_forms) == {keys[0], keys[2]}
    assert best.explains
    assert not any(t.explains for t in singles)
    done = {t.key_of_forms for t in found}
    assert not done & {t.key_of_forms for t in foreseen(singles, ready.data, available, done, run)}


@pytest.mark.parametrize("last", [False, True])
def test_what_the_tangents_promised_last_is_tried_in_other_forms(
    last: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compression and a saturation that are both gross: no single is near, and the pair stood
    where the tangents had led it, in a form that leaves too much to be near (67315). What is grown
    from is tried in other forms there."""
    pair = tried_as(
        fitted(14, 304.0), "actuator_nonlinearity:cubic", "nonlinearity_shape:quartic_quintic"
    )
    better = tried_as(fitted(13, 1.0), "actuator_nonlinearity:cubic", "nonlinearity_shape:tanh")
    monkeypatch.setattr(trace.Tried, "plausible", True)
    monkeypatch.setattr(law_steps, "foreseen", lambda *a: [pair])
    monkeypatch.setattr(law_steps, "reformed", lambda found, *rest: [better] if found else [])
    going = searching(fitted(11, 2.5e5))
    law_steps.try_foreseen(going, last=last)
    assert going.tried == ([pair, better] if last else [pair])


@pytest.mark.slow
def test_an_offset_is_seen_in_a_further_mode_too(tmp_path: Path) -> None:
    """Two modes are declared: a form for three of them is there beside an effect that brings one,
    and only there."""
    mode = {
        "frequency_hz": 491.5,
        "damping": 0.05,
        "flame_residue_ratio": -0.094,
        "speaker_residue_ratio": -0.094,
    }
    effects = {"sensor_offset": {"offset_m": -0.0106}, "acoustic_mode": mode}
    ready = thesis_campaign(tmp_path, 735, effects, noise_db=45.0)
    keys = {"acoustic_mode:mode", "sensor_offset:modal_3"}
    base = start.fit_from_data(ready.structure, ready.data)
    catalogue = [by_key(k) for k in sorted({*keys, "sensor_offset:modal_2"})]
    tried = trace.search(ready.structure, ready.data, base, catalogue=catalogue).tried
    best = trace.best_form([t for t in tried if t.explains])
    assert set(best.key_of_forms) == keys
    without = [
        t for t in tried if t.key_of_forms == ("acoustic_mode:mode", "sensor_offset:modal_2")
    ]
    assert all(t.fit.chi2 > 5 * best.fit.chi2 for t in without)
    assert not any(t.key_of_forms == ("sensor_offset:modal_3",) for t in tried)


@pytest.mark.slow
def test_the_best_pair_is_varied_from_each_of_its_forms(tmp_path: Path) -> None:
    """A cubic amplifier beside a further mode: a search that was content with a form which has
    had its turn goes on from the next, and says what it has seen to."""
    mode, cubic = by_key("acoustic_mode:mode"), by_key("actuator_nonlinearity:cubic")
    quadratic = by_key("actuator_nonlinearity:quadratic")
    cubed = {"cubic_per_v2": 1e-3}
    effects = {"acoustic_mode": THIRD_MODE, "actuator_nonlinearity/compression": cubed}
    ready = thesis_campaign(tmp_path, 4, effects)
    larger = ready.structure.with_effects(mode)
    richer = start.fit_from_data(Structure(3), ready.data)
    theta = renamed(mode, larger, Structure(3), [richer.theta])[0]
    structure = larger.with_effects(quadratic)
    fit = fit_orbits(structure, ready.data, np.r_[theta, quadratic.to_internal((0.0,))])
    poor = tried(structure.effects, fit, ready.data)
    assert not poor.adequate
    assert poor.fit.chi2_per_dof < NEAR
    done: set[tuple[str, ...]] = set()
    found = varied([poor], ready.data, [mode, cubic, quadratic], InProcess(), done)
    assert [t.explains for t in found if t.key_of_forms == (mode.key, cubic.key)] == [True]
    assert done == {(mode.key, quadratic.key)}
    assert varied([poor], ready.data, [mode, cubic, quadratic], InProcess(), done) == []


def test_which_forms_stand_for_others() -> None:
    """Those listed, the best singles', and the first of an effect without one."""
    assert {e.key for e in CATALOGUE} >= STANDING
    near = tried_as(fitted(14, 20.0), "actuator_dynamics:pole")
    unlisted = [by_key(f"sensor_offset:{form}") for form in ("mode_shapes", "propagation")]
    available = [*unlisted, *(by_key(k) for k in ("actuator_dynamics:pole", "acoustic_mode:mode"))]
    listed = [by_key("actuator_dynamics:delay"), by_key("actuator_dynamics:acceleration")]
    chosen = [e.key for e in representatives([*available, *listed], [near])]
    assert chosen[0] == "acoustic_mode:mode"  # another structure says the same
    assert sorted(chosen[1:]) == [
        "actuator_dynamics:delay",
        "actuator_dynamics:pole",
        "sensor_offset:mode_shapes",
    ]
    alone = representatives([*available, *listed], [])
    assert "actuator_dynamics:pole" not in [e.key for e in alone]


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_as_many_modes_are_placed_as_there_are_others(count: int) -> None:
    """Of a tube with one mode none is: it had been the same start 36 times."""
    placements = start.dense_placements(count)
    assert {len(ratios) for ratios in placements} == {count}
    assert len(set(placements)) == len(placements) == {0: 1, 1: 10}.get(count, 36)


def test_signed_starts_have_both_signs_in_each_other_mode(tmp_path: Path) -> None:
    ready = thesis_campaign(tmp_path, 4, {})
    structure = Structure(3)
    placements = [(1.67, 2.33), (2.0, 3.0)]
    found = start.signed_starts(structure, ready.data.coarse(), ((),), placements)
    values = [structure.parameters.plain(s.theta) for s in found]
    kinds = {
        (
            round(v["mode2.frequency_hz"] / ready.data.free_hz, 2),
            *(bool(v[f"mode{i}.flame_residue"] > 0) for i in (2, 3)),
        )
        for v in values
    }
    assert len(kinds) == len(found) == 8
    assert [s.cost for s in found] == sorted(s.cost for s in found)


@pytest.mark.parametrize(
    ("form", "truth", "values"),
    [
        pytest.param(
            "gain", {"gain": 0.02}, {"channel_mismatch.gain": 0.02}, marks=pytest.mark.slow
        ),
        ("skew", {"skew_s": -2e-5}, {"channel_mismatch.skew_s": -2e-5}),
    ],
)
def test_a_free_run_is_corrected_for_its_microphones(
    tmp_path: Path, form: str, truth: dict[str, float], values: dict[str, float]
) -> None:
    """What leaks into a free run's velocity is in the measurement's own phase."""
    key = f"channel_mismatch:{form}"
    ready = thesis_campaign(tmp_path, 4, {key.replace(":", "/"): truth})
    assert any(b.free for b in ready.data.fit)
    clean = start.corrected(ready.data, [by_key(key)], values)
    assert clean is not None
    before = start.fit_from_data(ready.structure, ready.data)
    after = start.fit_from_data(ready.structure, clean)
    assert after.chi2_per_dof < 1.5 < before.chi2_per_dof


def test_orbits_are_sought_from_the_velocity_at_the_flame(tmp_path: Path) -> None:
    """A gross mismatch makes most of what is measured: from there, the orbits would be missed."""
    clean = thesis_campaign(tmp_path / "clean", 5, {}, noise_db=60.0)
    truth = start.fit_from_data(clean.structure, clean.data).theta
    ready = thesis_campaign(tmp_path / "gross", 5, {"channel_mismatch": {"gain": -0.04}}, 60.0)
    mismatch = by_key("channel_mismatch:gain")
    theta = np.r_[truth, mismatch.to_internal((-0.04,))]
    for b in ready.data.fit:
        assert balance.solve(ready.structure.with_effects(mismatch), theta, b.at).converged.all()


def test_what_has_been_stopped_at_the_edge_of_its_range_is_not_plausible() -> None:
    effect = by_key("acoustic_mode:mode")
    damping = effect.parameters[1]
    assert damping.plausible(0.05)
    assert not damping.plausible(np.exp(np.log(damping.lower)))
    coefficient = by_key("nonlinear_damping:cubic").parameters[0]
    assert coefficient.plausible(0.0)  # a signed one may end there of itself


def test_of_the_modes_any_may_be_the_one_too_many(tmp_path: Path) -> None:
    """Left out is the mode that is not there, under whatever name the descent came to it."""
    ready = thesis_campaign(tmp_path, 5, {})
    base = start.fit_from_data(ready.structure, ready.data)
    mode = by_key("acoustic_mode:mode")
    larger, v = ready.structure.with_effects(mode), base.values
    values = v | {f"acoustic_mode.{k}": v[f"mode2.{k}"] for k in MODAL}
    values |= dict(zip((f"mode2.{k}" for k in MODAL), (1700.0, 1e-3, 0.1, 0.1), strict=True))
    theta = larger.parameters.unknowns(values)
    swapped = tried_as(replace(base, structure=larger, theta=theta), mode.key)
    without = with_fewer(swapped, (), ready.data)
    assert without.chi2 == pytest.approx(base.chi2, rel=1e-3)


def explaining(key: str, own: dict[str, float], name: str, stderr: float) -> trace.Tried:
    """An effect of these values that explains the data, of which only `name` has an error, that of
    its unknown."""
    effect = by_key(key)
    structure = Structure(2).with_effects(effect)
    values = {q.name: 1.0 for q in structure.parameters.parameters}
    values |= {"mode1.damping": 0.01, "mode2.damping": 0.05, "mode1.flame_residue": 30.0}
    values |= {f"{effect.name}.{n}": x for n, x in own.items()}
    theta = structure.parameters.unknowns(values)
    covariance = np.zeros((theta.size, theta.size))
    at = structure.parameters.index[name]
    covariance[at, at] = stderr**2
    fit = replace(fitted(theta.size, 1.0), structure=structure, theta=theta, covariance=covariance)
    return tried_as(fit, key)


def a_further_mode(name: str, internal_stderr: float, **own: float) -> trace.Tried:
    """One more mode that explains the data, of its values only `name` known to within that."""
    values = {"damping": 0.04, "frequency_hz": 400.0, **own}
    return explaining("acoustic_mode:mode", values, name, internal_stderr)


def test_without_the_flame_s_part_nothing_sings() -> None:
    """A set in which the singing mode's flame residue is not seen explains nothing."""
    assert a_further_mode("mode1.flame_residue", 3.0).plausible
    silent = a_further_mode("mode1.flame_residue", 40.0)
    assert not silent.plausible
    assert silent.implausibility.startswith(
        "mode1.flame_residue is within its own error of nothing"
    )


def test_what_only_the_speaker_drives_is_no_mode() -> None:
    """Two notches of a speaker were claimed as one and a mode that the flame has no part in: a
    place where nothing is."""
    assert a_further_mode("acoustic_mode.flame_residue", 0.5).plausible
    driven = a_further_mode("acoustic_mode.flame_residue", 2.0)
    assert not driven.plausible
    assert driven.implausibility.startswith(
        "acoustic_mode.flame_residue is within its own error of nothing, and what only the speaker "
    )
    # where the speaker's part is no better known, the two together may be certain
    assert a_further_mode("acoustic_mode.speaker_residue", 2.0).plausible


def test_what_nobody_knows_has_been_stopped_by_nothing() -> None:
    """A damping at the edge of its range is told from one inside, or else is no objection."""
    lowest = by_key("acoustic_mode:mode").parameters[1].lower
    stopped = a_further_mode("acoustic_mode.damping", 0.3, damping=lowest)
    assert not stopped.plausible
    assert stopped.implausibility.startswith("acoustic_mode.damping is at the edge of its range")
    assert a_further_mode("acoustic_mode.damping", 25.0, damping=lowest).plausible


@pytest.mark.parametrize(
    ("key", "own"),
    [
        ("acoustic_mode:mode", {"damping": 0.04, "frequency_hz": 400.0}),
        ("actuator_dynamics:resonance", {"damping": 0.1, "frequency_hz": 400.0}),
        ("actuator_dynamics:peak", {"peak": 0.3, "damping": 0.1, "frequency_hz": 400.0}),
        ("channel_mismatch:upper_resonance", {"damping": 0.1, "frequency_hz": 4000.0}),
    ],
)
def test_what_resonates_must_do_so_somewhere(key: str, own: dict[str, float]) -> None:
    """Of a frequency that the data do not know to within its own size nothing has been seen: far
    above all harmonics, a peak of the speaker was a slope of 90 ns (left out 48105)."""
    name = f"{key.partition(':')[0]}.frequency_hz"
    assert explaining(key, own, name, 0.3).plausible
    assert not explaining(key, own, name, 4.0).plausible


@pytest.mark.parametrize(
    ("key", "name", "seen", "never"),
    [
        ("actuator_dynamics:pole", "time_s", 2e-6, 2e-7),
        ("actuator_dynamics:highpass", "corner_hz", 0.5, 0.008),
        ("sensor_dynamics:highpass", "corner_hz", 0.05, 0.001),
        ("flame_delay", "delay_s", 2e-6, 2e-7),
        ("flame_dynamics:pole", "time_s", 2e-6, 2e-7),
    ],
)
def test_what_no_device_has_is_no_cause(key: str, name: str, seen: float, never: float) -> None:
    """However little noise shows a phase of that size (an amplifier's corner of 8 mHz, 48105)."""
    unknown = f"{key.partition(':')[0]}.{name}"
    assert explaining(key, {name: seen}, unknown, 1e-9).plausible
    assert not explaining(key, {name: never}, unknown, 1e-9).plausible


@pytest.mark.slow
def test_two_effects_of_one_place(tmp_path: Path) -> None:
    """A speaker that lags and bends: each leads the other astray, and a freely shaped speaker does
    not. From what that makes of the rest, both are found."""
    effects = {
        "actuator_dynamics/voice_coil": {"pole_hz": 1500.0},
        "actuator_nonlinearity/compression": {"cubic_per_v2": 0.0115},
    }
    ready = thesis_campaign(tmp_path, 4, effects, noise_db=60.0)
    base = start.fit_from_data(ready.structure, ready.data)
    quiet = InProcess(), lambda share, text: None
    pieces = trace.shaped(ready.structure, ready.data, base, [], *quiet)
    assert {t.effects[0].location for t in pieces if t.adequate} == {"actuator"}
    keys = ("actuator_dynamics:pole", "actuator_nonlinearity:cubic", "flame_delay")
    known = [by_key(k) for k in keys]
    found = within_a_place(ready.structure, ready.data, pieces, known, *quiet)
    assert {e.name for t in found for e in t.effects} == {k.split(":")[0] for k in keys[:2]}
    (best,) = {t.key: t for t in found if t.explains}.values()
    assert len(best.effects) == 2
    lag = best.estimates["actuator_dynamics.time_s"]
    assert abs(lag.value - 1 / (2 * np.pi * 1500.0)) < 4 * lag.stderr
    bent = best.estimates["actuator_nonlinearity.a3"]
    assert abs(bent.value + 0.0115) < 4 * bent.stderr
    others = [t for t in pieces if not t.adequate]
    assert within_a_place(ready.structure, ready.data, others, known, *quiet) == []


def test_a_late_channel_with_a_lag_of_its_own(tmp_path: Path) -> None:
    """Two of the same name: a form of both is tried where neither explains the data alone."""
    effects = {
        "channel_mismatch/skew": {"skew_s": -2e-5},
        "channel_mismatch/lowpass": {"lowpass_hz": 4000.0},
    }
    ready = thesis_campaign(tmp_path, 4, effects, noise_db=60.0)
    keys = [f"channel_mismatch:{q}" for q in ("skew", "lowpass", "skew_lowpass", "gain_lowpass")]
    best, rivals = search_for(ready, *keys)
    assert best.key_of_forms == ("channel_mismatch:skew_lowpass",)
    assert rivals == []
    lag = best.estimates["channel_mismatch.lowpass_time_s"]
    assert abs(lag.value - 1 / (2 * np.pi * 4000.0)) < 4 * lag.stderr


def test_a_loss_is_seen_where_the_velocity_is_taken(tmp_path: Path) -> None:
    """What a loss makes of each mode stands at the sensor in that mode's own share."""
    effects = {
        "sensor_offset": {"offset_m": 0.01},
        "nonlinear_damping/quadratic": {"quadratic_per_m": 3.0},
    }
    ready = thesis_campaign(tmp_path, 4, effects, noise_db=90.0)
    base = start.fit_from_data(ready.structure, ready.data)
    own = by_key("nonlinear_damping:quadratic_end"), by_key("sensor_offset:modal_2")
    theta = np.r_[base.theta, own[0].to_internal((3.0, 1.0, 1.0)), own[1].to_internal((0.9,))]
    steps = (0.1, 0.03, 0.01, 0.003, 0.0)
    fit = fit_orbits(ready.structure.with_effects(*own), ready.data, theta, continuation=steps)
    assert fit.chi2_per_dof < 2.0


LAG_S = 1.5e-5


def late(values: FloatArray, lowpass: bool, lag_s: float = LAG_S) -> FloatArray:
    """A recording of 10 kHz that comes later than it was: by a delay, or by a low-pass."""
    mirrored = np.r_[values, values[::-1]]
    s = 2j * np.pi * np.fft.rfftfreq(mirrored.size, 1e-4)
    response = 1 / (1 + s * lag_s) if lowpass else np.exp(-s * lag_s)
    heard = np.fft.irfft(np.fft.rfft(mirrored) * response, mirrored.size)
    return np.asarray(heard[: values.size])


def late_below(run: RecordedRun, lowpass: bool = False) -> RecordedRun:
    return replace(run, p1=late(run.p1, lowpass))


@pytest.mark.parametrize(
    ("form", "other", "lag"),
    [
        ("lower_skew", "skew", "channel_mismatch.skew_s"),
        ("lower_lowpass", "lower_skew", "channel_mismatch.lowpass_time_s"),
    ],
)
def test_either_microphone_may_be_the_late_one(
    tmp_path: Path, form: str, other: str, lag: str
) -> None:
    """Where the lower one is, both are late against the drive besides: as a lead of the upper one
    it left 70 times the noise."""
    ready = altered_campaign(tmp_path, 7, partial(late_below, lowpass=form == "lower_lowpass"))
    best, rivals = search_for(ready, *(f"channel_mismatch:{f}" for f in (form, other)))
    assert best.key_of_forms == (f"channel_mismatch:{form}",)
    assert rivals == []
    found = best.estimates[lag]
    assert abs(found.value + LAG_S) < 4 * found.stderr < 1e-6


def beside_a_mode(ready: Prepared) -> trace.Tried:
    """The best pair of what may stand beside a further mode."""
    base = start.fit_from_data(ready.structure, ready.data)
    others = ("lower_skew", "gain_skew")
    keys = ("acoustic_mode:mode", "flame_delay", *(f"channel_mismatch:{q}" for q in others))
    found = pairs_from_afar(
        ready.structure, ready.data, base, [by_key(k) for k in keys], [], InProcess(),
        lambda share, text: None,
    )  # fmt: skip
    best = min(found, key=lambda t: t.fit.chi2)
    assert set(best.key_of_forms) == {"acoustic_mode:mode", "channel_mismatch:lower_skew"}
    return best


@pytest.mark.slow
def test_a_further_mode_beside_a_late_microphone(tmp_path: Path) -> None:
    """Both gross: with a microphone in time, no place of the mode came near (`d` with its lower
    microphone late was unexplained after six minutes)."""
    modes = [make_effect("acoustic_mode", THIRD_MODE)]
    best = beside_a_mode(altered_campaign(tmp_path, 4, late_below, modes))
    assert best.explains
    skew = best.estimates["channel_mismatch.skew_s"]
    assert abs(skew.value + LAG_S) < 4 * skew.stderr < 1e-6


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="../shared/cases is not here")
def test_starts_of_a_further_mode_are_not_given_up_early() -> None:
    """`d` with a low-pass of its lower microphone: of the starts the true one was behind after four
    steps, and what was left of them came to χ²/dof 6800. A delay for the low-pass leaves little."""
    recorded = load_campaign(open_campaign(SHARED / "d-extra-mode"))
    lag_s = 1 / (2 * np.pi * 5000.0)
    runs = []
    for run in recorded.runs:
        p1 = run.signals["p1"]
        heard = replace(p1, values=late(p1.values, True, lag_s))
        runs.append(replace(run, signals={**run.signals, "p1": heard}))
    best = beside_a_mode(prepare(replace(recorded, runs=tuple(runs))))
    assert best.fit.chi2_per_dof < 100
    assert abs(best.estimates["channel_mismatch.skew_s"].value + lag_s) < 1e-6


@pytest.mark.slow
def test_of_two_that_explain_the_data_one_may_lack_another_form(tmp_path: Path) -> None:
    """A delay of the speaker that had been taken for a pole left hardly more than noise beside
    a drift, but what it left was taken for a third effect (58053)."""
    truth = {
        "actuator_dynamics": {"delay_s": 2.4e-4},
        "parameter_drift": {"frequency_change": -0.004},
    }
    ready = thesis_campaign(tmp_path, 14, truth, noise_db=60.0)
    base = start.fit_from_data(ready.structure, ready.data)
    drift, pole, delay = (
        by_key(k)
        for k in ("parameter_drift:frequency", "actuator_dynamics:pole", "actuator_dynamics:delay")
    )
    alone = only(ready, base, drift.key)
    pairs = trace.try_effects(
        alone.fit.structure, ready.data, alone.fit, [pole], executor=InProcess(), keep=1,
        far=False, progress=lambda share, text: None,
    )  # fmt: skip
    assert pairs[0].explains
    assert pairs[0].fit_p < DOUBT
    going = replace(searching(base, available=[drift, pole, delay]), data=ready.data, tried=pairs)
    assert not one_more(going, 3)
    best = trace.best_form([t for t in going.tried if t.explains])
    assert best.key_of_forms == (delay.key, drift.key)
    assert best.evidence < pairs[0].evidence - trace.EVIDENCE
    assert {len(t.effects) for t in going.tried} == {2}


@pytest.mark.parametrize(
    ("form", "beside", "may"),
    [
        ("flame_dynamics:pole", "flame_dynamics:distributed_delay", True),
        ("flame_dynamics:pole", "flame_delay", True),
        ("flame_dynamics:pole", "flame_dynamics:second_time_scale", False),  # one time_s for both
        ("actuator_dynamics:pole", "actuator_dynamics:resonance", False),
    ],
)
def test_two_laws_of_one_name_stand_together_where_both_are_met(
    form: str, beside: str, may: bool
) -> None:
    assert joins(by_key(form), [by_key(beside)]) is may


@pytest.mark.slow
def test_two_laws_of_one_flame(tmp_path: Path) -> None:
    """A further pole and a distributed delay go by one name; a delay in the place of the pole
    explains the data too, and had been claimed for it (68051 of the study)."""
    effects = [
        make_effect("flame_dynamics/extra_pole", {"pole_hz": 905.4}),
        make_effect("flame_dynamics/distributed_delay", {"mean_delay_s": 2.195e-4}),
    ]
    rig = random_rig(68051, modes=MOST_TWO)
    ready = record(tmp_path, 68051, rig, effects, forced=7, validation=2)
    base = start.fit_from_data(ready.structure, ready.data)
    forms = [by_key("flame_delay"), *(e for e in CATALOGUE if e.name == "flame_dynamics")]
    found = trace.search(ready.structure, ready.data, base, catalogue=forms, depth=2)
    good = [t for t in found.tried if t.explains]
    assert ("flame_delay", "flame_dynamics") in {t.key for t in good}
    assert best_form(good).key == ("flame_dynamics", "flame_dynamics")


@pytest.mark.slow
def test_several_declared_modes_are_sought_wherever_they_are(tmp_path: Path) -> None:
    """Of three modes, one lies at 1.8 and one at 3.3 times the free frequency. From the usual
    placements a microphone's lag and a speaker that compresses led to other ones (68028)."""
    effects = [
        make_effect("channel_mismatch/lowpass", {"lowpass_hz": 7468.0}),
        make_effect("actuator_nonlinearity/compression", {"cubic_per_v2": 0.01016}),
    ]
    rig = random_rig(68028, coloured=True, modes=MOST_TWO)
    conditions = {"forced": 7, "validation": 2, "cold": 0, "modes": 3}
    ready = record(tmp_path, 68028, rig, effects, **conditions)
    base = start.fit_from_data(ready.structure, ready.data)
    forms = [by_key(k) for k in ("actuator_nonlinearity:quadratic_cubic", "channel_mismatch:skew")]
    quiet = InProcess(), lambda share, text: None
    (t,) = pairs_from_afar(ready.structure, ready.data, base, forms, [], *quiet)
    assert t.explains
    truth = [m.frequency_hz for m in rig.plant.modes]
    found = [t.fit.values[f"mode{i}.frequency_hz"] for i in (1, 2, 3)]
    np.testing.assert_allclose(sorted(found), sorted(truth), rtol=0.01)


@pytest.mark.slow
def test_pairs_are_led_down_a_long_valley(tmp_path: Path) -> None:
    """A loss and a speaker's pole: given up after a few steps at coarse noise, the pair lay behind
    others that fit it (100033: χ²/dof 0.5 against what three effects left, 14 000)."""
    effects = [
        make_effect("nonlinear_damping/cubic", {"cubic_s_per_m2": 16.646}),
        make_effect("actuator_dynamics/voice_coil", {"pole_hz": 1434.55}),
    ]
    rig = random_rig(100033, coloured=True, modes=MOST_TWO)
    ready = record(tmp_path, 100033, rig, effects, forced=9, validation=3)
    base = start.fit_from_data(ready.structure, ready.data)
    keys = ("nonlinear_damping:cubic_end", "actuator_dynamics:delay")
    others = ("acoustic_mode:mode", "channel_mismatch:gain_skew")
    forms = [e for e in CATALOGUE if e.key in {*keys, *others} and e.mode_count in (None, 2)]
    found = pairs_from_afar(
        ready.structure, ready.data, base, forms, [], InProcess(), lambda share, text: None
    )
    best = min(found, key=lambda t: t.fit.chi2)
    assert {e.key for e in best.effects} == set(keys)
    assert best.fit.chi2_per_dof < 10  # a delay for a pole of the same lag
    np.testing.assert_allclose(best.fit.values["actuator_dynamics.delay_s"], 1.11e-4, rtol=0.02)


def of_modes(key: str, count: int) -> Effect:
    return next(e for e in CATALOGUE if e.key == key and e.mode_count == count)


def test_beside_a_further_mode_a_form_has_a_share_of_that_too() -> None:
    """A loss at the end with shares of the two declared modes left out the third (68072)."""
    mode = by_key("acoustic_mode:mode")
    two, three = (of_modes("nonlinear_damping:quadratic_end", n) for n in (2, 3))
    structure = Structure(2)
    fit = replace(fitted(20, 14.0), structure=structure.with_effects(mode, two))
    t = replace(tried_as(fit, mode.key), effects=(mode, two), fit_p=0.0)
    found = forms_in_place(t, Dataset((), (), 0.0), [two, three], [t.key_of_forms])
    assert [(kept, old, form) for _, kept, old, form, _ in found] == [((mode,), two, three)]
    alone = replace(t, effects=(two,), fit=replace(fit, structure=structure.with_effects(two)))
    assert forms_in_place(alone, Dataset((), (), 0.0), [two, three], []) == []


def test_a_loss_at_the_end_starts_as_what_it_had_been_taken_for() -> None:
    """Of the singing mode alone: nothing of the others there. Of all alike: as much of each."""
    end = of_modes("nonlinear_damping:quadratic_end", 3)
    both = of_modes("nonlinear_damping:quadratic_cubic_end", 3)
    values = {"nonlinear_damping.coefficient": 4.0}
    alone, alike = (by_key(f"nonlinear_damping:quadratic{x}") for x in ("_mode", ""))
    assert end.starts_from(alone, values) == [(4.0, 0.0, 0.0, 0.0, 0.0)]
    assert end.starts_from(alike, values) == [(4.0, 1.0, 1.0, 1.0, 1.0)]
    assert both.starts_from(alone, values) == [(4.0, 0.0, 0.0, 0.0, 0.0, 0.0)]
    two = {**values, "nonlinear_damping.end_ratio2": -0.8, "nonlinear_damping.return_ratio2": 2.0}
    assert end.starts_from(of_modes("nonlinear_damping:quadratic_end", 2), two) == [
        (4.0, -0.8, 2.0, 1.0, 1.0)
    ]
    assert end.starts_from(by_key("nonlinear_damping:cubic_mode"), values) == []


@pytest.mark.slow
def test_a_loss_at_the_end_beside_a_further_mode(tmp_path: Path) -> None:
    shape = {"frequency_hz": 464.58, "damping": 0.01607}
    residues = {"flame_residue_ratio": 0.6755, "speaker_residue_ratio": -0.6755}
    effects = [
        make_effect("acoustic_mode", {**shape, **residues}),
        make_effect("nonlinear_damping/quadratic", {"quadratic_per_m": 2.2067}),
    ]
    rig = random_rig(68072, modes=MOST_TWO)
    ready = record(tmp_path, 68072, rig, effects, forced=7, validation=2)
    base = start.fit_from_data(ready.structure, ready.data)
    forms = [e for e in CATALOGUE if e.name == "nonlinear_damping" or e.key == "acoustic_mode:mode"]
    found = trace.search(ready.structure, ready.data, base, catalogue=forms, depth=2)
    best = best_form([t for t in found.tried if t.explains])
    assert best.key == ("acoustic_mode", "nonlinear_damping")
