"""What declared characteristics lack when they are of low degree, and claims without values.

A loop whose characteristic has no odd power beyond the first has no limit cycle: the declared model
has no solution to start a search from.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import identify
from identify.effects import by_key
from identify.effects.nonlinearity import HigherOrder
from identify.effects.shaped import Setting, ShapedNonlinearity
from identify.record import DeclaredModel
from identify.structure import Structure
from identify.trace import Tried
from identify.verdict import Declared, judge
from tests.trace_material import campaign, fitted, tried_as

pytestmark = pytest.mark.no_cover

LINEAR = DeclaredModel(nonlinearity="linear")
QUADRATIC = DeclaredModel(nonlinearity_degree=2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("declared", "form"),
    [
        pytest.param(LINEAR, "quadratic_cubic", id="linear"),
        pytest.param(QUADRATIC, "cubic", id="2"),
    ],
)
def test_the_powers_that_a_low_degree_lacks_are_found(
    tmp_path: Path, declared: DeclaredModel, form: str
) -> None:
    """With the quadratic declared, a soft dead zone and a saturation had been claimed together,
    with a level known to ± 7e117 m."""
    measured = campaign(tmp_path, 4, "")
    truth = identify.identify(measured).assessment.fit
    found = identify.diagnose(replace(measured, declared_model=declared))
    assert found.verdict == "traced", found.explanation
    (effect,) = found.effects
    assert (effect.effect, effect.form, effect.location) == (
        "nonlinearity_shape",
        form,
        "nonlinearity",
    )
    for name, estimate in effect.parameters.items():
        full = truth.estimates[name.replace("nonlinearity_shape", "nonlinearity")]
        assert estimate.value == pytest.approx(full.value, abs=0.1 * full.stderr)
        assert estimate.stderr == pytest.approx(full.stderr, rel=0.05)


@pytest.mark.parametrize(
    ("structure", "forms"),
    [
        (Structure(nonlinearity="linear"), {"quadratic", "cubic", "quadratic_cubic"}),
        (Structure(degree=1), {"quadratic", "cubic", "quadratic_cubic"}),
        (Structure(degree=2), {"cubic", "quartic", "quartic_quintic"}),
        (Structure(degree=3), {"quartic", "quintic", "quartic_quintic"}),
        (Structure(degree=5), {"sextic", "septic", "sextic_septic"}),
        (Structure(nonlinearity="lagrange", nodes=(-1e-3, 1e-3, 2e-3)), {"quintic", "sextic"}),
    ],
)
def test_only_powers_beyond_the_declared_ones_are_offered(
    structure: Structure, forms: set[str]
) -> None:
    """A power that is declared already would be a second name of the same number."""
    powers = [e for e in identify.effects.CANDIDATES if isinstance(e, HigherOrder)]
    assert {e.form for e in powers if e.extends(structure)} >= forms
    for e in powers:
        assert not e.extends(structure) or min(e.powers) > structure.highest_power
    shape = ShapedNonlinearity(Setting(100.0, 2, highest_power=structure.highest_power))
    assert min(shape.powers.powers) == structure.highest_power + 1


def test_a_claim_has_values() -> None:
    """What explains the data with a number that they leave open by orders of magnitude is another
    law's limit, and no claim."""
    dead_zone = by_key("nonlinearity_shape:soft_dead_zone")
    structure = Structure(2).with_effects(dead_zone)
    theta = structure.parameters.to_internal(
        [100.0, 0.02, 300.0, 5.0, 180.0, 0.03, 30.0, 4.0, 90.0, -10.0, -100.0, 0.5, 2e5]
    )
    covariance = np.diag(np.full(theta.size, 1e-6))
    plain = replace(fitted(theta.size, 1.0), structure=structure, theta=theta)
    known = tried_as(replace(plain, covariance=covariance), dead_zone.key)
    assert known.plausible, known.implausibility
    covariance[-1, -1] = 1e20
    lost = tried_as(replace(plain, covariance=covariance), dead_zone.key)
    assert "nonlinearity_shape.level is not known" in lost.implausibility
    assert not lost.explains


@pytest.mark.parametrize(
    ("reason", "verdict"),
    [
        ("converged", "traced"),
        ("no step lowers the misfit any further", "traced"),
        ("not converged in 60 iterations", "unexplained"),
    ],
)
def test_only_what_has_come_to_an_end_is_claimed(
    monkeypatch: pytest.MonkeyPatch, reason: str, verdict: str
) -> None:
    """What was on its way still has no values."""
    monkeypatch.setattr(Tried, "plausible", True)
    declared = Declared(tried_as(fitted(9, 40.0)), None, {}, 0.0)  # type: ignore[arg-type]
    fit = replace(fitted(10, 1.0), converged=reason == "converged", reason=reason)
    delay = tried_as(fit, "flame_delay")
    data = SimpleNamespace(validation=(), noise_floor=lambda batches: 1e-3)
    found, _, said = judge(declared, [delay], data)  # type: ignore[arg-type]
    assert found == verdict
    if verdict == "unexplained":
        assert f"flame_delay comes near to the data, with no values: {reason}" in said


def test_what_explains_with_values_that_cannot_be_true_is_named_and_not_claimed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A pair that left nothing had been passed over in silence: a mode's node lay nearer to the
    flame than the range of its ratio allows (effects 80064)."""
    monkeypatch.setattr(Tried, "implausibility", "its delay is at the edge of its range (1)")
    declared = Declared(tried_as(fitted(9, 40.0)), None, {}, 0.0)  # type: ignore[arg-type]
    delay = tried_as(fitted(10, 1.0), "flame_delay")
    data = SimpleNamespace(validation=(), noise_floor=lambda batches: 1e-3)
    found, chosen, said = judge(declared, [delay], data)  # type: ignore[arg-type]
    assert (found, chosen) == ("unexplained", None)
    assert said == (
        "No known effect explains the data to within noise. Adding flame_delay would leave no more "
        "than noise, but its delay is at the edge of its range (1)."
    )
