"""What no candidate names: freely shaped pieces and deviating runs say where it lies."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import identify
from identify import diagnosis, start, trace, verdict
from identify.effect import Effect
from identify.effects import by_key
from identify.effects.shaped import (
    LAGS,
    Setting,
    Shaped,
    ShapedActuator,
    ShapedExperiment,
    ShapedFlame,
    ShapedForward,
    ShapedNonlinearity,
    lag,
)
from identify.executor import InProcess
from identify.record import Campaign
from identify.report.gallery import save_figures
from identify.results import PLACES
from identify.trace.places import deviating, remembering, shaped, whereabouts
from identify.trace.restated import by_name
from simulated_rig.effects import make_effect
from simulated_rig.random_rigs import MOST_TWO, random_rig
from tests.trace_material import (
    drawn_values,
    fitted,
    record,
    thesis_campaign,
    tried_as,
)

pytestmark = pytest.mark.no_cover  # measuring coverage doubles the time; the cases do it


@pytest.mark.parametrize(
    ("key", "parameters", "place"),
    [
        pytest.param("nonlinear_damping/cubic", {}, "forward", marks=pytest.mark.slow),
        ("flame_delay", {"delay_s": 3e-4}, "flame"),
        ("nonlinearity_shape/quartic", {}, "nonlinearity"),
        ("nonlinear_damping/quadratic", {"quadratic_per_m": 20.0}, "forward"),
        pytest.param("actuator_dynamics/voice_coil", {}, "actuator", marks=pytest.mark.slow),
        ("actuator_dynamics/voice_coil", {"pole_hz": 150.0}, "actuator"),
        pytest.param("actuator_nonlinearity/clipping", {}, "actuator", marks=pytest.mark.slow),
        pytest.param("channel_mismatch/gain", {}, "sensor", marks=pytest.mark.slow),
        ("sensor_offset", {"offset_m": 0.056}, "sensor"),
        ("parameter_drift/damping", {}, "experiment"),
    ],
)
def test_what_no_candidate_explains_is_placed(
    tmp_path: Path, key: str, parameters: dict[str, float], place: str
) -> None:
    """A freely shaped piece takes the misfit up where it lies, and nowhere else."""
    ready = thesis_campaign(tmp_path, 7, {key: parameters or drawn_values(key)})
    base = start.fit_from_data(ready.structure, ready.data)
    pieces = shaped(ready.structure, ready.data, base, [], InProcess(), lambda share, text: None)
    found = whereabouts(pieces, [], base)
    assert found.likely == (place,), found.words
    assert PLACES[place] in found.words


@pytest.mark.parametrize("time", LAGS)
def test_a_free_shape_starts_as_a_lag(time: float) -> None:
    """As near as the series, cut off there, leaves it: no |B^j − 1| is above 2."""
    piece = ShapedFlame(Setting(100.0, 2))
    h = dict(zip((q.name for q in piece.parameters), lag(time), strict=True))
    s = 2j * np.pi * np.array([90.0, 100.0, 110.0])
    exact = 1.0 / (1.0 + s * time / piece.corner)
    *_, before, last = lag(time)
    ratio = abs(last / before)
    cut = 2 * abs(last) * ratio / (1 - ratio)
    np.testing.assert_allclose(piece.response(h, s), exact, rtol=0, atol=cut)


@pytest.mark.parametrize("piece", [ShapedNonlinearity, ShapedForward])
def test_a_free_shape_restated_says_the_same(tmp_path: Path, piece: type[Shaped]) -> None:
    """Started from the richer structure's values, a piece predicts what that structure does."""
    ready = thesis_campaign(tmp_path, 7, {})
    data, shape = ready.data, piece(Setting(ready.data.free_hz, ready.structure.mode_count))
    richer = shape.restated(ready.structure)
    assert richer is not None
    theta = next(start.candidates(richer, data))
    larger = ready.structure.with_effects(shape)
    same = by_name(shape, larger, richer.parameters.plain(theta))
    one = start.coarse(richer, data, [theta], 0.01)[0].cost
    assert start.coarse(larger, data, [same], 0.01)[0].cost == pytest.approx(one, rel=1e-6)


@pytest.mark.slow
def test_a_known_effect_that_does_better_than_a_free_shape_speaks_for_its_place(
    tmp_path: Path,
) -> None:
    """Hysteresis follows no power of the flame's input: the smooth pieces of other places take
    more, and what remembers takes it all."""
    ready = thesis_campaign(tmp_path, 7, {"nonlinearity_shape": {"hysteresis_width": 0.0063}})
    base = start.fit_from_data(ready.structure, ready.data)
    run, silent = InProcess(), lambda share, text: None
    some = (ShapedExperiment, ShapedActuator, ShapedNonlinearity)
    pieces = shaped(ready.structure, ready.data, base, [], run, silent, some)
    assert whereabouts(pieces, [], base).likely != ("nonlinearity",)
    memory = remembering(ready.structure, ready.data, base, run, silent)
    assert [t.adequate for t in memory] == [True]
    assert whereabouts([*pieces, *memory], [], base).likely == ("nonlinearity",)
    tries = trace.try_effects(
        ready.structure, ready.data, base, [by_key("nonlinearity_shape:hysteresis")],
        executor=run, keep=1, far=False, progress=silent,
    )  # fmt: skip
    found = whereabouts(pieces, tries, base)
    assert found.likely == ("nonlinearity",), found.words
    assert found.left["nonlinearity"] == tries[0].fit.chi2_per_dof


@pytest.mark.parametrize(
    ("key", "parameters", "places"),
    [
        # a shift of the drive in time is one of the record, and their gains act nearly alike
        ("drive_scatter", {"gain_rms": 0.004, "phase_rms_rad": 0.004}, {"actuator", "sensor"}),
        ("flame_gain_modulation", {"modulation_rms": 0.02, "corner_hz": 2.0}, {"flame"}),
        pytest.param(
            "parameter_drift/frequency_walk",
            {"frequency_walk": 0.0005},
            {"experiment"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_runs_that_deviate_are_placed(
    tmp_path: Path, key: str, parameters: dict[str, float], places: set[str]
) -> None:
    """No law takes up what differs from run to run; runs that each deviate there do."""
    ready = thesis_campaign(tmp_path, 7, {key: parameters})
    base = start.fit_from_data(ready.structure, ready.data)
    run = InProcess()
    some = (ShapedActuator, ShapedExperiment)
    laws = shaped(ready.structure, ready.data, base, [], run, lambda share, text: None, some)
    assert not any(t.adequate for t in laws)
    deviations = deviating(ready.structure, ready.data, base, run)
    found = whereabouts([*laws, *deviations], [], base)
    assert set(found.likely) == places, found.words
    assert found.from_run_to_run
    assert "differs from run to run and " in found.words
    assert all(found.left[p] < 1.5 < min(t.fit.chi2_per_dof for t in laws) for p in places)
    assert found.to_json()["from_run_to_run"] is True


def test_a_place_that_takes_up_little_is_ruled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """The best leaves 28 % of 16.9 − 1, and three times as much is nearly all of it."""
    monkeypatch.setattr(trace.Tried, "plausible", True)
    left = {
        "parameter_drift:frequency": 5.5,
        "nonlinearity_shape:quintic": 9.0,
        "flame_delay": 15.0,
    }
    tries = [replace(tried_as(fitted(11, chi2), key), fit_p=0.0) for key, chi2 in left.items()]
    where = whereabouts([], tries, fitted(10, 16.9))
    assert where.likely == ("experiment", "nonlinearity")
    assert list(where.left) == ["experiment", "nonlinearity", "flame"]


def test_a_place_that_could_not_be_shaped_is_not_ruled_out() -> None:
    """Unless another explains it all."""
    shape = replace(tried_as(fitted(11, 9.0), "channel_mismatch:skew"), fit_p=0.0)
    where = whereabouts([shape], [], fitted(10, 500.0))
    others = ("forward", "flame", "nonlinearity", "actuator", "experiment")
    assert (where.likely, list(where.left)) == (("sensor", *others), ["sensor"])
    assert "no fit: forward, flame, nonlinearity, actuator, experiment" in where.words
    explains = tried_as(fitted(11, 1.0), "channel_mismatch:skew")
    assert whereabouts([explains], [], fitted(10, 500.0)).likely == ("sensor",)


def test_effects_of_two_places_that_leave_far_less_than_any_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each place's shape only comes near to what is not in it alone."""
    monkeypatch.setattr(trace.Tried, "plausible", True)
    one = replace(tried_as(fitted(11, 60.0), "channel_mismatch:skew"), fit_p=0.0)
    both = tried_as(fitted(12, 3.0), "acoustic_mode:mode", "parameter_drift:frequency")
    three = tried_as(fitted(13, 2.6), "acoustic_mode:mode", "flame_delay", "channel_mismatch:skew")
    found = whereabouts([one], [both, three], fitted(10, 500.0))
    assert (found.likely, found.together) == (("forward", "experiment"), 3.0)
    assert "the forward path and the course of the experiment together" in found.words
    assert found.to_json()["together"] == 3.0
    # what leaves little less does so for having more numbers
    near = replace(one, fit=fitted(11, 20.0))
    assert whereabouts([near], [both], fitted(10, 500.0)).together is None
    # what leaves much itself rules no place out
    lost = replace(one, fit=fitted(11, 900.0))
    less = tried_as(fitted(12, 30.0), "acoustic_mode:mode", "parameter_drift:frequency")
    found = whereabouts([], [lost, less], fitted(10, 7000.0))
    assert (found.likely, found.together) == (("sensor", "forward", "experiment"), None)


@pytest.mark.slow
def test_unexplained_says_where(tmp_path: Path) -> None:
    """Without the candidate that it is, a flame delay ends as unexplained, on the flame's side."""
    ready = thesis_campaign(tmp_path, 7, {"flame_delay": {"delay_s": 3e-4}})
    found = identify.diagnose(ready.campaign, catalogue=[by_key("channel_mismatch:gain")])
    assert found.verdict == "unexplained"
    assert found.whereabouts is not None
    assert found.whereabouts.likely == ("flame",)
    assert found.to_json()["whereabouts"]["likely"] == ["flame"]
    assert "lies in the flame path" in found.explanation
    assert "places" in [path.stem for path in save_figures(tmp_path / "figures", found)]


@pytest.mark.slow
def test_a_gross_misfit_of_one_place_is_sought_nowhere_else(tmp_path: Path) -> None:
    """A voice coil that no candidate names: the actuator's free shape explains it, and no other."""
    ready = thesis_campaign(tmp_path, 7, {"actuator_dynamics/voice_coil": {"pole_hz": 150.0}})
    others = [
        by_key(k) for k in ("channel_mismatch:gain", "sensor_dynamics:lowpass", "flame_delay")
    ]
    found = identify.diagnose(ready.campaign, catalogue=others)
    assert found.verdict == "unexplained"
    assert found.whereabouts is not None
    assert found.whereabouts.likely == ("actuator",)
    assert {len(c.effects) for c in found.candidates} == {1}


def assert_not_claimed(
    recordings: Campaign, catalogue: Sequence[Effect], said: str, place: str
) -> None:
    """Unexplained, for what is `said`, and likely in that place."""
    found = identify.diagnose(recordings, catalogue=catalogue)
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert said in found.explanation
    assert found.whereabouts is not None
    assert place in found.whereabouts.likely


@pytest.mark.slow
def test_what_only_comes_near_is_not_claimed_where_a_free_shape_is_far_likelier(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cubic loss that no candidate names: one more mode leaves χ²/dof 1.57 at 69 degrees of
    freedom, which chance leaves once in four hundred times. Its damping is stopped at the edge of
    the plausible; were that wider, a free shape would still speak against it."""
    monkeypatch.setattr("identify.parameters.EDGE", 0.0)
    loss = {"nonlinear_damping": {"cubic_s_per_m2": 0.7536}}
    recordings = thesis_campaign(tmp_path, 1050, loss, validation=3).campaign
    mode = [by_key("acoustic_mode:mode")]
    assert_not_claimed(recordings, mode, "far less likely than a law", "forward")
    monkeypatch.setattr(verdict, "DOUBTFUL", 0.0)  # uncontested, it would have been claimed
    assert identify.diagnose(recordings, catalogue=mode).verdict == "traced"


@pytest.mark.slow
def test_what_no_candidate_names_and_is_random_is_no_law_that_follows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flame's gain wanders within each run, little beside the noise (χ²/dof 1.2). Three numbers
    of a cycle follow what differs from run to run; one of chance does as well."""
    gain = {"modulation_rms": 0.0065, "corner_hz": 0.5506400742650892}
    wander = {"flame_gain_modulation": gain}
    recordings = thesis_campaign(tmp_path, 1207, wander, validation=3).campaign
    cycle = [by_key("parameter_drift:flame_gain_cycle")]
    assert_not_claimed(recordings, cycle, "no likelier than chance", "flame")
    monkeypatch.setattr(diagnosis, "SLIGHT", 0.0)  # uncontested, it would have been claimed
    assert identify.diagnose(recordings, catalogue=cycle).verdict == "traced"


@pytest.mark.slow
def test_what_runs_that_differ_at_random_leave_is_no_law_of_a_slight_misfit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same of another rig, χ²/dof 2.7: four numbers of a further mode take up what differs from
    run to run, and chance at any place is likelier by 10 to 30 with their tuning counted."""
    gain = {"modulation_rms": 0.0045454862055195975, "corner_hz": 1.2269461137136468}
    wander = [make_effect("flame_gain_modulation", gain)]
    rig = random_rig(49026, modes=MOST_TWO)
    recordings = record(tmp_path, 49026, rig, wander, forced=8, validation=2).campaign
    mode = [by_key("acoustic_mode:mode")]
    assert_not_claimed(recordings, mode, "no likelier than chance", "flame")
    monkeypatch.setattr(diagnosis, "SLIGHT", 0.0)  # uncontested, it would have been claimed
    assert identify.diagnose(recordings, catalogue=mode).verdict == "traced"


@pytest.mark.slow
def test_what_a_free_shape_outdoes_is_a_rival_still(tmp_path: Path) -> None:
    """A weak side resonator, χ²/dof 2, that no candidate names. Of two other laws that differ by
    less than 10, a free shape is likelier by more than that than one, and by less than the other:
    which is no surer for that."""
    branch = {
        "frequency_hz": 150.918093306,
        "damping": 0.0221717947957,
        "coupling": 0.0119895995073,
    }
    rig = random_rig(49113, modes=MOST_TWO)
    made = [make_effect("side_resonator", branch)]
    recordings = record(tmp_path, 49113, rig, made, forced=8, validation=2).campaign
    laws = [by_key("drive_pickup:velocity"), by_key("channel_mismatch:gain_phase")]
    found = identify.diagnose(recordings, catalogue=laws)
    assert found.verdict == "ambiguous", found.explanation
