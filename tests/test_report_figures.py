"""What the figures show, checked before it is drawn: spectra, tongue, residual, equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from identify.record import Medium, Run, Signal
from identify.report.controller import boundary, controller_steps
from identify.report.equations import equations, equations_text
from identify.report.misfit import in_noise_units
from identify.report.spectra import free_frequency, velocity_spectrum
from tests import report_material as material

RATE, N = 8000.0, 8000


def test_spectrum_of_a_line_is_its_amplitude() -> None:
    """On a bin the Hann-windowed peak is the amplitude (the window's two neighbours aside)."""
    t = np.arange(N) / RATE
    run = _run({"velocity": Signal(0.3 * np.cos(2 * np.pi * 170 * t + 1.0), "velocity", "m/s")})
    s = velocity_spectrum(run, Medium())
    peak = int(np.argmax(s.amplitude))
    assert s.frequency_hz[peak] == 170.0
    # rounding, and the window being symmetric instead of periodic: a part in N
    assert s.amplitude[peak] == pytest.approx(0.3, rel=2 / N)


def test_spectrum_from_two_microphones_follows_eq_5_2() -> None:
    """p(x) = A cos(kx) cos ωt has velocity amplitude ≈ A k sin(kx̄)/(ρω) between the microphones.

    The finite difference's own factor is sin(kΔ/2)/(kΔ/2), applied exactly.
    """
    f, c, rho = 200.0, 343.0, 1.2
    x = np.array([0.66, 0.71])
    k, t = 2 * np.pi * f / c, np.arange(N) / RATE
    p = np.cos(k * x)[:, None] * np.cos(2 * np.pi * f * t)
    run = _run({f"p{i}": Signal(p[i], "pressure", "Pa", position_m=float(x[i])) for i in (0, 1)})
    s = velocity_spectrum(run, Medium(rho, c))
    half = k * (x[1] - x[0]) / 2
    expected = k * np.sin(k * x.mean()) / (rho * 2 * np.pi * f) * np.sin(half) / half
    assert s.amplitude.max() == pytest.approx(expected, rel=2 / N)


def test_free_frequency_is_the_free_runs() -> None:
    campaign = material.recorded()
    expected, _ = material.steady(material.Structure(), material.tube())[0]
    # noise 1e-5 on 0.24 m/s over a second: standard error about 1e-7 Hz
    assert free_frequency(campaign) == pytest.approx(expected, abs=1e-4)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([164.0, 168.0, 172.0]), st.floats(0.05, 3.0), st.booleans()),
        min_size=1,
        max_size=20,
    )
)
def test_boundary_brackets_the_tongue(steps: list[tuple[float, float, bool]]) -> None:
    rows = [{"frequency_hz": f, "amplitude_v": a, "entrained": e} for f, a, e in steps]
    edge = boundary(rows)
    assert [hz for hz, _, _ in edge] == sorted({f for f, _, e in steps if e})
    for hz, low, high in edge:
        assert 0 <= low < high
        assert not any(e for f, a, e in steps if f == hz and a < high)


def test_residual_is_in_units_of_its_own_noise() -> None:
    _, after = material.pair()
    runs, sizes = in_noise_units(after)
    assert [c.kind for c in runs[:2]] == ["free", "forced"]
    for line, c in zip(sizes, runs, strict=True):
        np.testing.assert_allclose(line, np.abs(c.measured - c.predicted) / c.stderr)
    # the right model leaves noise: E|r|² is 1 less the fitted share; 6 σ of 80 squared values
    assert 0.5 < np.mean(sizes**2) < 1.5
    before = in_noise_units(material.pair()[0])[1]
    assert np.mean(before**2) > 50  # χ²/dof is 140 on the fitted runs


def test_equations_hold_every_fitted_number() -> None:
    """Read back from the printed model, the numbers are those fitted, to five digits."""
    _, after = material.pair()
    text = equations_text(after)
    for name in ("flame.pole_hz", "flame.delay_s", "nonlinearity.c2", "nonlinearity.c3"):
        value = after.parameters[name].value
        printed = [_float(word) for word in text.replace("·", " ").split() if _float(word)]
        assert any(abs(abs(value) / p - 1) < 1e-4 for p in printed if p), name
    page = equations(after)
    assert page.count("<math") == 3
    c2 = after.parameters["nonlinearity.c2"].value
    assert f"<mn>{abs(c2):.5g}</mn>" in page  # its sign is an operator of its own


def test_equations_of_a_failed_fit_have_symbols_only() -> None:
    a = material.without_convergence(material.pair()[1])
    assert not set("0456789") & set(equations_text(a).split("H(s) =")[1])


def _float(word: str) -> float | None:
    try:
        return float(word.strip("(),").removesuffix("Hz").replace("−", "-").replace("2π", ""))
    except ValueError:
        return None


def _run(signals: dict[str, Signal]) -> Run:
    return Run("r", "forced", RATE, signals, frequency_hz=170.0, amplitude_v=1.0)


def test_frequencies_are_written_where_there_is_room() -> None:
    """Of steps that end in a heap only those stand named that cover no other name or point."""
    steps = [
        {"frequency_hz": hz, "amplitude_v": v, "suppression_db": db, "entrained": True}
        for hz, v, db in ((160.0, 0.1, 40.0), (165.0, 0.50, 80.0), (166.0, 0.51, 80.5),
                          (170.0, 1.0, 60.0))
    ]  # fmt: skip
    left = controller_steps(steps).axes[0]
    named = {t.get_text() for t in left.texts}
    assert {"160", "170"} < named
    assert len({"165", "166"} & named) == 1
