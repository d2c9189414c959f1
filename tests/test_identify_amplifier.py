"""What bends the drive, one curve after another, against the same done sample by sample."""

from typing import Any

import numpy as np
import pytest

from identify.effect import Conditions, driven
from identify.effects import by_key
from identify.effects.scatter import DriveGain
from identify.structure import Structure
from tests.test_identify_balance import K, forced_conditions, theta

SIZES = {
    "quadratic_cubic": [0.03, -0.01],
    "saturation": [0.4],
    "clipping": [1.7],
    "unequal_clipping": [1.6, 1.9],
    "crossover": [0.04],
    "knee": [1.8, 8.0],
    "power_compression": [0.02],
}
CORNERED = ("clipping", "unequal_clipping", "crossover")
CORNERS = 5e-3  # a small step takes few samples, if any, from one side of a corner to the other


def two_volts() -> Conditions:
    """Runs of the same drive, with a second harmonic of its own."""
    at = forced_conditions()
    at.drive[:, 0], at.drive[:, 1] = -2.0j, 0.1
    return at


def structure_with(*forms: str) -> tuple[Structure, np.ndarray]:
    effects = [by_key(f"actuator_nonlinearity:{form}") for form in forms]
    own = [e.to_internal(SIZES[form]) for form, e in zip(forms, effects, strict=True)]
    return Structure().with_effects(*effects), np.concatenate([theta(Structure()), *own])


@pytest.mark.parametrize("forms", [["quadratic_cubic", "knee"], ["knee", "quadratic_cubic"]])
def test_a_distorted_drive_meets_its_rails_as_a_wave(forms: list[str]) -> None:
    """Whichever was found first: the rails are behind, and feel the mean that the square made."""
    structure, vector = structure_with(*forms)
    at = two_volts()
    samples = 20000
    tau = 2 * np.pi * np.arange(samples) / samples
    wave = 2.0 * np.sin(tau) + 0.1 * np.cos(2 * tau)
    wave = wave + 0.03 * wave**2 - 0.01 * wave**3
    wave = wave / (1 + np.abs(wave / 1.8) ** 8) ** 0.125
    exact = 2 * np.fft.rfft(wave)[1 : K + 1] / samples
    found = driven(structure.effects, structure.parameters.plain(vector), at, at.drive)
    np.testing.assert_allclose(found, np.tile(exact, (at.runs, 1)), atol=1e-9)


@pytest.mark.parametrize("form", SIZES)
def test_derivatives_behind_a_distortion_agree_with_differences(form: str) -> None:
    """By each curve's own parameters, and by those of a drive that has parameters itself."""
    own = "quadratic_cubic" if form != "quadratic_cubic" else "knee"
    bent, vector = structure_with(own, form)
    gain = DriveGain()
    structure = bent.with_effects(gain)
    vector = np.r_[vector, gain.to_internal([0.1])]
    at = two_volts()

    def drive(p: Any) -> Any:
        given = at.drive
        for e in structure.effects:
            given = e.generator(p, at) * given
        return driven(structure.effects, p, at, given)

    exact = drive(structure.parameters.seeded(vector[None], at.runs))
    names = structure.parameters.names
    for j in range(theta(Structure()).size, vector.size):
        h = np.zeros(vector.size)
        h[j] = 1e-5 * max(abs(vector[j]), 1e-2)
        up, down = (drive(structure.parameters.plain(vector + sign * h)) for sign in (1, -1))
        difference = (up - down) / (2 * h[j])
        size = np.max(np.abs(difference))
        assert size > 0, names[j]
        error = np.max(np.abs(exact.d[..., j] - difference))
        assert error < (CORNERS if form in CORNERED else 1e-6) * size, names[j]


@pytest.mark.parametrize("form", SIZES)
def test_of_many_starts_alike_each_gets_its_own(form: str) -> None:
    """Two values in turn for hundreds of starts that differ elsewhere: what is reckoned once for
    all that are alike is what each alone would get, exactly."""
    structure, vector = structure_with(form)
    at, own = two_volts(), structure.parameters.index[structure.effects[0].parameters[0].name]
    vectors = np.tile(vector, (200, 1))
    vectors[:, 0] += np.linspace(0.0, 0.1, 200)
    vectors[1::2, own] += 0.02
    rows = at.tile(len(vectors))
    found = driven(
        structure.effects, structure.parameters.plain(vectors, at.runs), rows, rows.drive
    ).reshape(len(vectors), at.runs, K)
    for one in (0, 1):
        alone = driven(structure.effects, structure.parameters.plain(vectors[one]), at, at.drive)
        np.testing.assert_array_equal(found[one::2], np.tile(alone, (100, 1, 1)))
    assert not np.array_equal(found[0], found[1])
