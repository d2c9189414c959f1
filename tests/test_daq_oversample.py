"""Decimation: what passes, what is stopped, and a rig behind it that keeps the contract."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from daq.decimate import Decimator, design
from daq.errors import InputError
from daq.oversample import OversamplingRig
from drivers.protocols import DuplexRig
from drivers.types import OutputLimits
from simulated_rig.build import build_rig
from tests.contract import RigContract

RATE = 40_000.0
FILTERS = cache(design)


def decimated(x: np.ndarray, factor: int = 4) -> np.ndarray:
    decimator = Decimator(design(RATE, factor), 1)
    return np.concatenate([decimator.feed(x[:, None]), decimator.finish()])[:, 0]


def test_phase_is_linear_and_its_delay_removed() -> None:
    """Inside the passband (4 kHz) a tone comes out at its own times, to the filter's ripple."""
    t = np.arange(20_000) / RATE
    found = design(RATE, 4)
    assert found.passband_hz == 4000.0
    assert found.ripple < 1e-4
    assert found.attenuation_db > 95
    for frequency in (170.0, 1000.0, 3900.0):
        out = decimated(np.sin(2 * np.pi * frequency * t))
        expected = np.sin(2 * np.pi * frequency * t[::4])
        edge = found.delay_frames // 4 + 1
        assert np.max(np.abs(out - expected)[edge:-edge]) < 2e-4


def test_aliases_are_stopped() -> None:
    t = np.arange(20_000) / RATE
    for frequency in (6000.0, 9000.0, 17_000.0):
        out = decimated(np.sin(2 * np.pi * frequency * t))
        edge = design(RATE, 4).delay_frames // 4 + 1
        assert np.max(np.abs(out[edge:-edge])) < 10 ** (-95 / 20)


@settings(max_examples=15, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 700), min_size=1, max_size=8),
    factor=st.integers(2, 5),
    seed=st.integers(0, 1000),
)
def test_block_sizes_do_not_matter(sizes: list[int], factor: int, seed: int) -> None:
    x = np.random.default_rng(seed).standard_normal((sum(sizes), 2))
    filter_ = FILTERS(RATE, factor)
    whole = Decimator(filter_, 2)
    expected = np.concatenate([whole.feed(x), whole.finish()])
    pieces = Decimator(filter_, 2)
    out, start = [], 0
    for size in sizes:
        out.append(pieces.feed(x[start : start + size]))
        start += size
    out.append(pieces.finish())
    np.testing.assert_allclose(np.concatenate(out), expected, atol=1e-12)
    assert len(expected) == -(-len(x) // factor)


def test_nonsense_is_refused() -> None:
    with pytest.raises(InputError, match="factor=1"):
        design(RATE, 1)


class TestOversampledRig(RigContract):
    """The simulated rig at 40 kHz, thinned out to 10 kHz. The filter rings for its own length, so
    commands seem to arrive early or late by as much, and edges ring a little."""

    drive_column = 2
    noise_v = 2e-2
    latency_s = 0.03

    def open_rig(self, limits: OutputLimits) -> DuplexRig:
        return OversamplingRig(build_rig(sample_rate_hz=40_000.0, limits=limits), 4)


def test_the_filter_stands_in_the_notes() -> None:
    with OversamplingRig(build_rig(sample_rate_hz=20_000.0), 2) as rig:
        notes = rig.run_notes()["decimation"]
    assert notes["factor"] == 2
    assert "taps" in notes
