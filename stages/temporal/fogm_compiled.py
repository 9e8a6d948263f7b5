"""Likelihood of sampled Gauss-Markov processes, compiled by numba: import only when one is fitted.

A first-order Gauss-Markov process of zero mean, sampled at equal steps with gaps, is a Markov
chain. A sample x' that follows x after k steps is normal about phi_k x with variance
s (1 - phi_k^2), where s = sigma^2 and phi_k = exp(-k / tau), tau in steps; the first has
variance s. So

    -2 log L = n log s + D(tau) + Q(tau) / s          (n log 2 pi left out)
    D = sum_k N_k log(1 - phi_k^2)
    Q = sum x_first^2 + sum_k [E_k + 2 (1-phi_k) F_k + (1-phi_k)^2 C_k] / (1 - phi_k^2)

with, over the N_k pairs that lie k steps apart, E = sum (x'-x)^2, F = sum (x'-x) x, C = sum x^2:
these sums hold all that the samples say, at any tau, and sums over segments add up to those of
their joint likelihood. Written with differences they lose no digits where phi is close to one.

The best s at a tau is Q / n; what is left depends on u = log tau alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Floats = NDArray[np.float64]

CHI2_95 = 3.841458820694124
"""95 % point of chi-squared with one degree of freedom: half-width of a profile in -2 log L."""

GOLDEN = 0.6180339887498949
NODES, NARROW, HALVINGS = 40, 1e-7, 40

PROFILE, S_HIGH, S_LOW, MISFIT = 0, 1, 2, 3


@compiled
def add_segment(x: Floats, shift: float, sums: Floats) -> None:
    """Add the sums of one segment, x (n,) less `shift`, NaN where missing, to `sums` (4, n).

    Rows are N, E, F, C by steps apart; column 0 holds the first samples: their count and the
    sum of their squares.
    """
    before = -1
    for i in range(x.size):
        if math.isnan(x[i]):
            continue
        value = x[i] - shift
        if before < 0:
            sums[0, 0] += 1.0
            sums[1, 0] += value * value
        else:
            last = x[before] - shift
            gap, change = i - before, value - last
            sums[0, gap] += 1.0
            sums[1, gap] += change * change
            sums[2, gap] += change * last
            sums[3, gap] += last * last
        before = i


@compiled
def compress(sums: Floats) -> Floats:
    """The columns of `sums` that hold anything, (5, m): steps apart, N, E, F, C."""
    used = np.flatnonzero(sums[0])
    packed = np.empty((5, used.size))
    packed[0] = used
    for row in range(4):
        for j in range(used.size):
            packed[row + 1, j] = sums[row, used[j]]
    return packed


@compiled
def terms(u: float, packed: Floats) -> tuple[float, float, float]:
    """Count n, D and Q of the likelihood at log tau = u."""
    count, determinant, squares = packed[1, 0], 0.0, packed[2, 0]
    rate = math.exp(-u)
    for j in range(1, packed.shape[1]):
        one_less = -math.expm1(-packed[0, j] * rate)
        variance = one_less * (2.0 - one_less)
        form = packed[2, j] + one_less * (2.0 * packed[3, j] + one_less * packed[4, j])
        count += packed[1, j]
        determinant += packed[1, j] * math.log(variance)
        squares += form / variance
    return count, determinant, squares


@compiled
def log_excess(g: float, upper: bool) -> float:
    """The root w of w + exp(-w) = g >= 1: above zero, or below; Newton from beyond it."""
    half = max(g - 1.0, 0.0)
    start = math.sqrt(2.0 * half)
    w = start + half if upper else -start
    for _ in range(50):
        slope = -math.expm1(-w)
        if slope == 0.0:
            break
        change = (w + math.exp(-w) - g) / slope
        w -= change
        if abs(change) < 1e-12 * (1.0 + abs(w)):
            break
    return w


@compiled
def target(kind: int, u: float, packed: Floats, level: float) -> float:
    """What is to be least over u = log tau.

    PROFILE: -2 log L at the best s. S_HIGH, S_LOW: minus the log of the largest and the log of
    the smallest s where -2 log L <= level. MISFIT: of the best s phi^k to the weights and
    autocorrelations `packed` (2, lags), less a constant.
    """
    if kind == MISFIT:
        across, square = project(u, packed)
        return -(across * across) / square if across > 0.0 else 0.0
    count, determinant, squares = terms(u, packed)
    best = math.log(squares / count)
    if kind == PROFILE:
        return count * (best + 1.0) + determinant
    w = log_excess((level - determinant) / count - best, kind == S_HIGH)
    return -(best + w) if kind == S_HIGH else best + w


@compiled
def project(u: float, lags: Floats) -> tuple[float, float]:
    """Weighted sums over lags of c_k phi^k and of phi^2k at log tau = u; lags (2, n): w, c."""
    phi = math.exp(-math.exp(-u))
    power, across, square = 1.0, 0.0, 0.0
    for k in range(lags.shape[1]):
        weighted = lags[0, k] * power
        across += weighted * lags[1, k]
        square += weighted * power
        power *= phi
    return across, square


@compiled
def golden(kind: int, low: float, high: float, packed: Floats, level: float) -> float:
    """Golden-section search for the least target between two u."""
    width = high - low
    left, right = high - GOLDEN * width, low + GOLDEN * width
    at_left, at_right = target(kind, left, packed, level), target(kind, right, packed, level)
    while high - low > NARROW:
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - GOLDEN * (high - low)
            at_left = target(kind, left, packed, level)
        else:
            low, left, at_left = left, right, at_right
            right = low + GOLDEN * (high - low)
            at_right = target(kind, right, packed, level)
    return 0.5 * (low + high)


@compiled
def least(kind: int, low: float, high: float, packed: Floats, level: float) -> float:
    """The u of the least target in [low, high]: the best of a row of nodes, then refined.

    Exactly `low` or `high` where the target is least at that end.
    """
    spacing = (high - low) / (NODES - 1)
    best, at_best = 0, math.inf
    for i in range(NODES):
        value = target(kind, low + i * spacing, packed, level)
        if value < at_best:
            best, at_best = i, value
    middle = low + best * spacing
    found = golden(kind, max(low, middle - spacing), min(high, middle + spacing), packed, level)
    if best == 0 and target(kind, low, packed, level) <= target(kind, found, packed, level):
        return low
    if best == NODES - 1 and found > high - 2.0 * NARROW:
        return high
    return found


@compiled
def crossing(u: float, end: float, packed: Floats, level: float) -> float:
    """Where the profile first exceeds `level`, going from u toward `end`; `end` if nowhere."""
    inside, step = u, 0.125 if end > u else -0.125
    while True:
        outside = inside + step
        if (end - outside) * step <= 0.0:
            outside = end
        if target(PROFILE, outside, packed, 0.0) > level:
            break
        if outside == end:
            return end
        inside, step = outside, 1.5 * step
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if target(PROFILE, middle, packed, 0.0) > level:
            outside = middle
        else:
            inside = middle
        if abs(outside - inside) < NARROW:
            break
    return 0.5 * (inside + outside)


@compiled
def fit(packed: Floats, span: tuple[float, float], bounds: bool, out: Floats) -> None:
    """Fill out (6,): sigma, its 95 % bounds, tau, its bounds; NaN where the samples fix none.

    `span` limits log tau: at its ends tau is 0 or infinite. Where all samples are equal the
    likelihood has no maximum. Without `bounds` only sigma and tau are filled.
    """
    out[:] = math.nan
    low, high = span
    if packed.shape[1] < 2 or packed[2, 1:].sum() <= 0.0:
        return
    u = least(PROFILE, low, high, packed, 0.0)
    count, _, squares = terms(u, packed)
    out[0], out[3] = math.sqrt(squares / count), tau_at(u, span)
    if not bounds:
        return
    level = target(PROFILE, u, packed, 0.0) + CHI2_95
    left, right = crossing(u, low, packed, level), crossing(u, high, packed, level)
    out[4], out[5] = tau_at(left, span), tau_at(right, span)
    smallest = golden(S_LOW, left, right, packed, level)
    largest = golden(S_HIGH, left, right, packed, level)
    out[1] = math.exp(0.5 * target(S_LOW, smallest, packed, level))
    out[2] = math.exp(-0.5 * target(S_HIGH, largest, packed, level))


@compiled
def tau_at(u: float, span: tuple[float, float]) -> float:
    """The tau of a u, steps; at the ends of the search zero and infinity."""
    if u <= span[0]:
        return 0.0
    return math.inf if u >= span[1] else math.exp(u)


@compiled
def fit_each(x: Floats, span: tuple[float, float], out: Floats) -> None:
    """Fit every segment x (segments, n) about zero and about its mean: out (segments, 8).

    Columns: the six of `fit` about zero, then sigma and tau about the mean.
    """
    sums, about_mean = np.empty((4, x.shape[1])), np.empty(6)
    for i in range(x.shape[0]):
        sums[:] = 0.0
        add_segment(x[i], 0.0, sums)
        fit(compress(sums), span, True, out[i, :6])
        sums[:] = 0.0
        add_segment(x[i], np.nanmean(x[i]), sums)
        fit(compress(sums), span, False, about_mean)
        out[i, 6], out[i, 7] = about_mean[0], about_mean[3]


@compiled
def fit_classes(
    x: Floats, members: NDArray[np.bool_], span: tuple[float, float], out: Floats
) -> None:
    """Joint fit of the segments x (segments, n) of each class: members (classes, segments).

    Fills out (classes, 6) as `fit` does.
    """
    sums = np.empty((4, x.shape[1]))
    for c in range(members.shape[0]):
        sums[:] = 0.0
        for i in range(x.shape[0]):
            if members[c, i]:
                add_segment(x[i], 0.0, sums)
        fit(compress(sums), span, True, out[c])


@compiled
def fit_exponentials(lags: Floats, span: tuple[float, float], out: Floats) -> None:
    """Fit s exp(-k / tau) to each of lags (segments, 2, n), weights and autocorrelations.

    Least squares, with s at its best for each tau; fills out (segments, 2): sigma, tau. NaN
    where all is zero or no two samples are there.
    """
    for i in range(lags.shape[0]):
        out[i] = math.nan
        if not (lags[i, 1, 0] > 0.0 and lags[i, 0].sum() > 1.0):
            continue
        u = least(MISFIT, span[0], span[1], lags[i], 0.0)
        across, square = project(u, lags[i])
        out[i, 0], out[i, 1] = math.sqrt(across / square), tau_at(u, span)
