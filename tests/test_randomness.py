"""Whether deviations are random or follow a law: false alarms as stated, laws found."""

import numpy as np
import numpy.typing as npt
import pytest

from identify.randomness import LAW_P, Law, law_in

FloatArray = npt.NDArray[np.float64]

RUNS, EACH, UNKNOWNS = 9, 8, 3
GROUPS = (("a",), ("b",), ("a", "b"))


def campaign(seed: int, law: float, spread: float = 30.0) -> Law | None:
    """Runs that deviate in two ways by `spread` times the noise, and, by `law` times that, along
    covariate «a» in the second of them."""
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, RUNS))
    tangents = rng.normal(size=(RUNS, EACH, 2))
    jacobian = rng.normal(size=(RUNS, EACH, UNKNOWNS))
    x = spread * rng.normal(size=(RUNS, 2)) * (law == 0)
    x[:, 1] += law * spread * a
    residual = rng.normal(size=(RUNS, EACH)) + np.einsum("rnq,rq->rn", tangents, x)
    V = np.eye(EACH) + spread**2 * tangents @ tangents.transpose(0, 2, 1)
    L = np.linalg.cholesky(V)
    deviations: FloatArray = np.zeros((RUNS, EACH, RUNS, 2))
    for r in range(RUNS):
        deviations[r, :, r] = np.linalg.solve(L[r], tangents[r])
    return law_in(
        np.linalg.solve(L, residual[..., None]).ravel(),
        np.linalg.solve(L, jacobian).reshape(-1, UNKNOWNS),
        spread * deviations.reshape(-1, RUNS, 2),
        {"a": a, "b": b},
        GROUPS,
    )


def test_random_deviations_pass_for_laws_as_seldom_as_stated() -> None:
    alarms = sum(campaign(seed, 0.0) is not None for seed in range(400))
    asked = 3 * len(GROUPS)  # each deviation and both, for every group
    assert alarms <= 400 * LAW_P * asked + 5  # Bonferroni's bound and two standard deviations


@pytest.mark.parametrize("law", [0.1, 1.0])  # the size of the spread decides nothing
def test_a_law_is_found_and_named(law: float) -> None:
    found = [campaign(seed, law) for seed in range(10)]
    assert all(f is not None and 1 in f.directions and "a" in f.covariates for f in found)
    assert sum(f is not None and f.directions == (1,) for f in found) >= 8


def test_what_is_nearly_absorbed_hides_no_law() -> None:
    """There is noise where the runs deviate together and a parameter takes nearly all of it up; a
    law that leaves nothing else had been measured by that (a flame whose gain falls with its mean
    square, claimed as one that differs at random)."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        deviations = np.linalg.qr(rng.normal(size=(60, 7)))[0].reshape(60, 7, 1)
        together, other = deviations[:, :, 0].sum(axis=1), rng.normal(size=60)
        a = rng.normal(size=7)
        law = deviations[:, :, 0] @ (a - a.mean())
        noise = rng.normal(size=60)
        noise -= deviations[:, :, 0] @ (deviations[:, :, 0].T @ noise) * 0.99  # little beside a law
        jacobian = (together + 0.04 * other)[:, None]
        law *= np.sqrt(6) / np.linalg.norm(law)  # a spread that came of it makes one of a run
        found.append(law_in(law + noise, jacobian, deviations, {"a": a}, [("a",)]))
    assert sum(f is not None for f in found) >= 38


def test_what_the_parameters_absorb_says_nothing() -> None:
    rng = np.random.default_rng(1)
    deviations = np.linalg.qr(rng.normal(size=(20, 4)))[0].reshape(20, 4, 1)
    everything = np.eye(20)
    assert (
        law_in(rng.normal(size=20), everything, deviations, {"a": np.arange(4.0)}, [("a",)]) is None
    )
