"""Gauss-Markov fits against full covariances, SciPy's optimisers, closed identities and chance."""

from __future__ import annotations

from itertools import pairwise

import fogm as truth
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, signal, stats

from magtiles.stages.temporal import fogm_compiled
from magtiles.stages.temporal.fogm import (
    Fit,
    autocorrelation,
    fit_autocorrelation,
    fit_pooled,
    fit_segments,
)
from magtiles.stages.temporal.persistence import persistence

Floats = NDArray[np.float64]

STEP_S = 60.0


def minus_two_log_likelihood(x: Floats, sigma: float, tau: float) -> float:
    """From the covariance matrix of all valid samples: nothing of ours."""
    at = np.flatnonzero(np.isfinite(x))
    covariance = sigma**2 * np.exp(-STEP_S * np.abs(at[:, None] - at) / tau)
    return float(-2.0 * stats.multivariate_normal.logpdf(x[at], cov=covariance))


def sums_of(x: Floats) -> Floats:
    sums = np.zeros((6, x.size))
    fogm_compiled.add_segment(x, sums)
    return fogm_compiled.compress(sums)


def short_segments() -> list[Floats]:
    """Forty samples each: whole, with gaps, with a long gap, faster and slower processes."""
    rng = np.random.default_rng(3)
    x = np.concatenate([truth.simulate(2, 20.0, tau, rng) for tau in (120.0, 600.0, 3000.0)])
    x = x[:, :40].copy()
    x[1::2][rng.random((3, 40)) < 0.25] = np.nan
    x[3, 10:25] = np.nan
    return list(x)


@pytest.mark.parametrize("x", short_segments())
@pytest.mark.parametrize(("sigma", "tau"), [(5.0, 60.0), (20.0, 900.0), (80.0, 1e5)])
def test_likelihood_is_that_of_the_full_covariance(x: Floats, sigma: float, tau: float) -> None:
    count, determinant, squares, *_ = fogm_compiled.terms(np.log(tau / STEP_S), sums_of(x))
    ours = count * np.log(2.0 * np.pi * sigma**2) + determinant + squares / sigma**2
    assert ours == pytest.approx(minus_two_log_likelihood(x, sigma, tau), rel=1e-10, abs=1e-6)


@pytest.mark.parametrize("x", short_segments())
def test_estimates_and_bounds_are_those_of_scipy(x: Floats) -> None:
    fit, _, _ = fit_segments(x[None], STEP_S)

    def surface(sigma: float, tau: float) -> float:
        return minus_two_log_likelihood(x, sigma, tau)

    found = optimize.minimize(
        lambda p: surface(*np.exp(p)), np.log([20.0, 600.0]), method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-9},
    )  # fmt: skip
    assert np.log([fit.sigma[0], fit.tau[0]]) == pytest.approx(found.x, abs=1e-4)
    level = found.fun + stats.chi2.ppf(0.95, 1)
    centre = np.log([fit.sigma[0], fit.tau[0]])
    for own, bounds in (
        (0, (fit.sigma_low[0], fit.sigma_high[0])), (1, (fit.tau_low[0], fit.tau_high[0]))
    ):  # fmt: skip
        for bound in bounds:
            least = profile(surface, own, float(np.log(bound)), centre)
            assert least == pytest.approx(level, abs=1e-4)


def profile(surface: object, own: int, at: float, centre: Floats) -> float:
    """The least of the surface over the other parameter (a log), searched on a wide range."""
    assert callable(surface)

    def along(other: float) -> float:
        logs = [0.0, 0.0]
        logs[own], logs[1 - own] = at, other
        return float(surface(*np.exp(logs)))

    nodes = centre[1 - own] + np.linspace(-7.0, 7.0, 57)
    best = int(np.argmin([along(v) for v in nodes]))
    within = nodes[max(best - 1, 0)], nodes[min(best + 1, 56)]
    return float(optimize.minimize_scalar(along, bounds=within, options={"xatol": 1e-8}).fun)


def test_estimates_keep_the_symmetries_of_the_process() -> None:
    x = truth.simulate(50, 20.0, 900.0, np.random.default_rng(7), gaps=0.2)
    whole = all_columns(x)
    backward, scaled = all_columns(x[:, ::-1]), all_columns(-3.0 * x)
    np.testing.assert_allclose(backward, whole, rtol=2e-6)  # a reversible process
    np.testing.assert_allclose(scaled[:, 3:6], whole[:, 3:6], rtol=2e-6)
    np.testing.assert_allclose(scaled[:, :3], 3.0 * whole[:, :3], rtol=2e-6)
    shifted = fit_segments(x + 1000.0, STEP_S)[1:]
    np.testing.assert_allclose(shifted, fit_segments(x, STEP_S)[1:], rtol=2e-6)


def all_columns(x: Floats) -> Floats:
    return columns(fit_segments(x, STEP_S)[0])


def columns(fit: Fit) -> Floats:
    each = fit.sigma, fit.sigma_low, fit.sigma_high, fit.tau, fit.tau_low, fit.tau_high
    return np.stack(each, axis=1)


def test_pooled_fit_of_one_segment_is_its_own() -> None:
    x = truth.simulate(3, 20.0, 900.0, np.random.default_rng(8), gaps=0.1)
    pooled = fit_pooled(x, STEP_S, np.eye(3, dtype=np.bool_))
    np.testing.assert_array_equal(columns(pooled), all_columns(x))


def test_pooled_likelihood_is_the_sum_of_the_segments() -> None:
    x = np.stack(short_segments()[:3])
    pooled = fit_pooled(x, STEP_S, np.ones((1, 3), np.bool_))
    found = optimize.minimize(
        lambda p: sum(minus_two_log_likelihood(row, *np.exp(p)) for row in x),
        np.log([20.0, 600.0]), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-9},
    )  # fmt: skip
    assert np.log([pooled.sigma[0], pooled.tau[0]]) == pytest.approx(found.x, abs=1e-4)


def test_without_information_nothing_is_claimed() -> None:
    x = np.full((5, 180), np.nan)
    x[1, 20] = 3.0
    x[2] = 7.0
    x[3], x[4] = 0.0, (-1.0) ** np.arange(180)
    fit, sigma, tau = fit_segments(x, STEP_S)
    assert np.isnan(columns(fit)[:4]).all()
    assert np.isnan(sigma[:4]).all()
    assert np.isnan(tau[:4]).all()
    assert fit.unidentified(10800.0).tolist() == [True] * 4 + [False]
    # Faster than the sampling: white noise at most.
    assert (fit.tau[4], fit.tau_low[4]) == (0.0, 0.0)
    assert fit.sigma[4] == pytest.approx(1.0, abs=1e-3)
    by_lags = np.stack(fit_autocorrelation(x, STEP_S))
    assert np.isnan(by_lags[:, [0, 1, 3]]).all()


def test_a_drift_is_unidentified() -> None:
    fit, _, _ = fit_segments(np.linspace(20.0, 40.0, 180)[None], STEP_S)
    assert fit.tau[0] > 10800.0
    assert fit.unidentified(10800.0).all()


def test_autocorrelation_is_the_sum_of_products() -> None:
    x = truth.simulate(4, 20.0, 900.0, np.random.default_rng(9))
    x[2:][np.random.default_rng(1).random((2, 180)) < 0.3] = np.nan
    x[3, 1:170] = np.nan  # no two samples some lags apart
    found, weight = autocorrelation(x)
    for row, values, present in zip(x, found, weight, strict=True):
        for k in range(180):
            products = row[: 180 - k] * row[k:]
            known = products[np.isfinite(products)]
            assert present[k] == (known.size > 0)
            expected = known.mean() * (180 - k) / 180 if known.size else 0.0
            assert values[k] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("samples", [500, 501, 10_800])
def test_autocorrelation_of_long_segments(samples: int) -> None:
    x = np.random.default_rng(2).standard_normal((2, samples))
    x[1, 40:60] = np.nan
    found, _ = autocorrelation(x)
    assert found[0] == pytest.approx(signal.correlate(x[0], x[0])[samples - 1 :] / samples)
    pairs = np.isfinite(x[1, 7:] * x[1, :-7])
    mean = (x[1, 7:] * x[1, :-7])[pairs].mean()
    assert found[1, 7] == pytest.approx(mean * (samples - 7) / samples, abs=1e-9)


def test_fit_to_the_autocorrelation_is_scipys() -> None:
    x = truth.simulate(20, 20.0, 900.0, np.random.default_rng(10))
    sigma, tau = fit_autocorrelation(x, STEP_S)
    lag = STEP_S * np.arange(180)

    def model(lag: Floats, variance: float, log_tau: float) -> Floats:
        return np.asarray(variance * np.exp(-lag / np.exp(log_tau)))

    for values, *ours in zip(autocorrelation(x)[0], sigma, tau, strict=True):
        starts = [(values[0], np.log(t)) for t in (100.0, 500.0, 2500.0)]
        fits = [optimize.curve_fit(model, lag, values, p0=p, ftol=1e-12)[0] for p in starts]
        best = min(fits, key=lambda p: float(np.sum((model(lag, *p) - values) ** 2)))
        assert ours == pytest.approx([np.sqrt(best[0]), np.exp(best[1])], rel=1e-4)


# Means and shares of 3000 segments scatter by 1.2 % and 0.4 %; docs/fogm.md has 10,000 of each.
@pytest.fixture(scope="module")
def found() -> dict[tuple[float, float], truth.Found]:
    rng = np.random.default_rng(11)
    taus, gaps = (300.0, 600.0, 2700.0, 7200.0), (0.0, 0.2)
    return {(t, g): truth.recover(3000, 20.0, t, rng, g) for t in taus for g in gaps}


def test_about_zero_the_mean_of_tau_is_unbiased(
    found: dict[tuple[float, float], truth.Found],
) -> None:
    for (tau, _), f in found.items():
        mean, median = f.biases(f.zero.tau, "tau")
        assert abs(mean) < 0.05, tau  # measured 1.7 % at most
        assert median < 0.0


def test_profile_intervals_cover(found: dict[tuple[float, float], truth.Found]) -> None:
    for f in found.values():
        assert 0.935 < f.covered("tau") < 0.965
        assert 0.935 < f.covered("sigma") < 0.965


def test_pooled_fits_are_right(found: dict[tuple[float, float], truth.Found]) -> None:
    for f in found.values():
        assert f.pooled.sigma[0] == pytest.approx(20.0, rel=0.03)
        assert f.pooled.tau[0] == pytest.approx(f.tau, rel=0.03 if f.tau < 5000.0 else 0.05)


def test_pooled_intervals_cover() -> None:
    rng = np.random.default_rng(12)
    x = truth.simulate(8000, 20.0, 1800.0, rng, gaps=0.1)
    members = np.repeat(np.eye(400, dtype=np.bool_), 20, axis=1)  # 400 classes of 20
    fit = fit_pooled(x, STEP_S, members)
    inside = (fit.tau_low <= 1800.0) & (fit.tau_high >= 1800.0)
    assert 0.92 < inside.mean() < 0.975


@pytest.mark.parametrize(("tau", "bias"), [(300.0, -0.05), (600.0, -0.10), (2700.0, -0.31)])
def test_about_the_mean_tau_is_biased_as_told(
    found: dict[tuple[float, float], truth.Found], tau: float, bias: float
) -> None:
    for gaps in (0.0, 0.2):
        f = found[tau, gaps]
        assert f.biases(f.about_mean[1], "tau")[0] == pytest.approx(bias, abs=0.025)


def test_of_slow_processes_a_segment_tells_little(
    found: dict[tuple[float, float], truth.Found],
) -> None:
    shares = [found[t, 0.0].zero.unidentified(10800.0).mean() for t in (600.0, 2700.0, 7200.0)]
    assert shares[0] == 0.0
    assert all(a < b for a, b in pairwise(shares))
    assert 0.17 < shares[2] < 0.24
    # The autocorrelation's tau does not say so: it stays below the segment.
    assert found[7200.0, 0.0].autocorrelation[1].max() < 10800.0


@pytest.mark.parametrize("r", [0.0, 0.5, 0.9])
def test_persistence_of_a_known_process(r: float) -> None:
    rng = np.random.default_rng(13)
    x = rng.standard_normal(20_000)
    for i in range(1, x.size):
        x[i] = r * x[i - 1] + np.sqrt(1.0 - r * r) * x[i]
    follows = np.ones(x.size - 1, np.bool_)
    assert persistence(x, follows) == pytest.approx(np.sqrt(2.0 * (1.0 - r)), rel=0.03)


def test_persistence_counts_neighbours_only() -> None:
    values = np.array([1.0, 1.0, 5.0, 5.0, np.nan, 9.0])
    follows = np.array([True, False, True, True, True])
    assert persistence(values, follows) == 0.0
    assert np.isnan(persistence(values, np.zeros(5, np.bool_)))
