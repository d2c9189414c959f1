"""κ and the threshold from one entrained window, in a Stuart–Landau world that is integrated."""

import math

import numpy as np
import pytest

from daq.coupling import Coupling, Decay, decay_of, when_suppressed
from daq.tongue import Law
from tests.test_daq_tongue import integrate

LAW = Law(6.0, 5.4, 0.01)


def entrained(law: Law, detuning: float, over: float) -> tuple[float, Decay]:
    """Forced amplitude at that multiple of the threshold (κ = 1), and how a disturbance dies."""
    forcing = over * law.threshold(detuning)
    still = integrate(law, detuning, forcing, 12.0, 1.0 + 0j, 2e-3)[-1]
    z = integrate(law, detuning, forcing, 3.0, still + 0.02, 2e-3)
    level = np.abs(z - still)
    late = slice(250, None)  # the faster of two real rates has died
    points = [(0.002 * i, math.log(v), 0.02) for i, v in enumerate(level[late]) if v > 1e-7]
    decay = decay_of(points[::25])
    assert decay is not None
    return abs(still), decay


@pytest.mark.parametrize("misread", [0.85, 1.2])
@pytest.mark.parametrize("detuning", [-25.0, 60.0])
def test_decay_gives_the_threshold_though_the_channel_misreads(
    detuning: float, misread: float
) -> None:
    """Where disturbances turn (a focus) the rate says what the amplitude cannot."""
    forced, decay = entrained(LAW, detuning, 1.2)
    drive = 1.2 * LAW.threshold(detuning)  # κ = 1
    blind = when_suppressed(LAW, drive, misread * forced, detuning, None, None, 170.0)
    seen = when_suppressed(LAW, drive, misread * forced, detuning, decay, None, 170.0)
    assert blind is not None
    assert seen is not None
    assert seen.per_s_per_v == pytest.approx(1.0, abs=0.03)
    assert seen.sigma < 0.03
    # what the amplitude alone says is off by more, and says so
    assert 0.03 < abs(math.log(blind.per_s_per_v)) < 3 * blind.sigma


def test_a_node_is_not_taken_for_a_focus() -> None:
    """With a bent resonance (Δω and B of one sign) disturbances return without turning, slowly
    though the drive is far over the threshold. Read as a focus that rate puts the threshold 20 %
    too high; the neighbour's κ decides between the two amplitudes that have this rate."""
    detuning, over = 14.0, 1.25
    forced, decay = entrained(LAW, detuning, over)
    drive = over * LAW.threshold(detuning)
    as_focus = math.sqrt((1 - decay.per_s / LAW.growth_rate_per_s) / 2)
    assert as_focus < 0.8 * forced
    neighbour = Coupling(1.0, 0.015, 172.0)
    found = when_suppressed(LAW, drive, forced, detuning, decay, neighbour.at(170.0), 170.0)
    assert found is not None
    assert found.per_s_per_v == pytest.approx(1.0, abs=0.03)


def test_a_neighbour_counts_less_from_farther_away() -> None:
    neighbour = Coupling(2.0, 0.01, 170.0)
    assert neighbour.at(170.0).sigma == 0.01
    assert neighbour.at(187.0).sigma == pytest.approx(math.hypot(0.01, math.log(1.1)), rel=1e-6)
    # two that know equally much: the geometric mean, and √2 better
    joined = neighbour.joined(Coupling(8.0, 0.01, 170.0))
    assert joined.per_s_per_v == pytest.approx(4.0)
    assert joined.sigma == pytest.approx(0.01 / math.sqrt(2))


def test_a_rise_or_a_blurred_fall_is_no_decay() -> None:
    assert decay_of([(0.0, -2.0, 0.02), (0.2, -1.9, 0.02)]) is None
    assert decay_of([(0.0, -2.0, 0.5), (0.2, -2.2, 0.5)]) is None
    assert decay_of([(0.0, -2.0, 0.02)]) is None
