"""Likelihoods of sections against SciPy's distributions, and what is made of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm

from magtiles.catalog.kernels.road_match import FORMS, Form, choose, prepare, root_mean_square

Floats = NDArray[np.float64]


def random_map(n: int = 1300, seed: int = 0) -> tuple[Floats, Floats]:
    """Field and variance (n, 3); longer than a block of the kernel."""
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, 500.0, (n, 3)), rng.uniform(100.0, 400.0, (n, 3)) ** 2


def measured(section: Floats, field: Floats, variance: Floats) -> float:
    return float(norm.logpdf(section, field, np.sqrt(variance)).sum())


def differenced(section: Floats, field: Floats, variance: Floats) -> float:
    spread = np.sqrt(variance[1:] + variance[:-1])
    return float(norm.logpdf(np.diff(section, axis=0), np.diff(field, axis=0), spread).sum())


def demeaned(section: Floats, field: Floats, variance: Floats) -> float:
    """A bias of very wide prior on each axis, and the prior's density taken out again."""
    wide, total = 1e6, 0.0
    for a in range(3):
        covariance = np.diag(variance[:, a]) + wide**2
        likely = multivariate_normal(field[:, a], covariance)
        total += float(likely.logpdf(section[:, a])) + np.log(wide * np.sqrt(2.0 * np.pi))
    return total


TRUTH = {"measured": measured, "demeaned": demeaned, "differenced": differenced}


@pytest.mark.parametrize("form", FORMS)
def test_likelihoods_are_those_of_scipy(form: Form) -> None:
    """Miss below 1e-9; a prior of 1e6 nT costs the demeaned 2e-6."""
    field, variance = random_map()
    section = field[600:604] + np.random.default_rng(1).normal(0.0, 300.0, (4, 3))
    found = prepare(field, variance, form).log_likelihood(section, 0, len(field) - 3)
    for s in (0, 1, 511, 512, 600, 1296):
        wanted = TRUTH[form](section, field[s : s + 4], variance[s : s + 4])
        assert abs(found[s] - wanted) < (1e-5 if form == "demeaned" else 1e-9)
    window = prepare(field, variance, form).log_likelihood(section, 510, 700)
    assert np.abs(window - found[510:700]).max() < 1e-9


def test_a_bias_matters_only_to_measured_samples() -> None:
    field, variance = random_map()
    section = field[100:105]
    for form in FORMS:
        one = prepare(field, variance, form)
        plain, moved = (one.log_likelihood(section + b, 0, 1000) for b in (0.0, 4000.0))
        assert bool(np.abs(plain - moved).max() < 1e-6) is (form != "measured")
        assert int(plain.argmax()) == 100


class Told(NamedTuple):
    likely: dict[int, float]
    best: int
    ratio: float
    bin: int
    id: str


CASES = [
    Told({10: 0.0}, 10, np.inf, 10, "one peak"),
    Told({10: 0.0, 12: -0.5, 70: -1.0}, 10, np.e, 11, "another far away"),
    Told({10: 0.0, 40: -0.1, 41: -0.1, 43: -0.2}, 10, np.exp(0.1), 41, "a bin outweighs the peak"),
    Told({49: -0.3, 50: -0.3, 70: 0.0}, 70, np.exp(0.3), 70, "no bin over two runs"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.id)
def test_choices(case: Told) -> None:
    likely = np.full(100, -np.inf)
    for place, value in case.likely.items():
        likely[place] = value
    position = np.column_stack([np.arange(100.0), np.zeros(100)])
    run = np.repeat([0, 1], 50).astype(np.int64)
    found = choose(likely, position, run, minimum_distance_m=20.0, bin_points=6)
    assert (found.best, found.bin) == (case.best, case.bin)
    assert found.ratio == pytest.approx(case.ratio)
    total = sum(np.exp(v) for v in case.likely.values())
    assert found.peak == pytest.approx(1.0 / total)
    assert found.index("ml", least_ratio=99.0, least_peak=0.99) == case.best
    assert found.index("mlr", least_ratio=2.0, least_peak=0.0) == (
        case.best if case.ratio >= 2.0 else -1
    )
    assert found.index("abl", least_ratio=0.0, least_peak=0.9) == (-1 if total > 1.2 else case.bin)


def test_choices_agree_with_numpy() -> None:
    rng = np.random.default_rng(3)
    position = np.cumsum(rng.uniform(-1.0, 2.0, (400, 2)), axis=0)
    run = np.repeat(np.arange(4), 100).astype(np.int64)
    for _ in range(20):
        likely = rng.normal(0.0, 3.0, 400)
        found = choose(likely, position, run, minimum_distance_m=20.0, bin_points=7)
        best = int(likely.argmax())
        far = np.hypot(*(position - position[best]).T) >= 20.0
        assert found.best == best
        assert found.ratio == pytest.approx(np.exp(likely[best] - likely[far].max()))
        share = np.exp(likely - likely.max()).reshape(4, 100)
        sums = np.stack([np.convolve(row, np.ones(7), "valid") for row in share])
        r, i = np.unravel_index(int(sums.argmax()), sums.shape)
        inside = share[r, i : i + 7]
        centre = 100 * r + i + inside @ np.arange(7) / inside.sum()
        assert abs(found.bin - centre) <= 0.5 + 1e-9


def test_rss_of_features() -> None:
    difference = np.array([[3.0, 0.0, 4.0], [3.0, 0.0, 4.0]])
    assert root_mean_square(difference, "measured") == pytest.approx(np.sqrt(50.0 / 6.0))
    assert root_mean_square(difference, "demeaned") == 0.0
    assert root_mean_square(difference, "differenced") == 0.0
