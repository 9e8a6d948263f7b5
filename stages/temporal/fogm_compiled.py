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

The best s at a tau is Q / n; what is left, the profile, depends on u = log tau alone. Its least
is where n Q'/Q + D' = 0, and bounds of tau where it has risen by 3.84. The best tau at an s is
where s = -Q'/D': along that ridge lie the bounds of sigma.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Floats = NDArray[np.float64]

CHI2_95 = 3.841458820694124
"""95 % point of chi-squared with one degree of freedom: half-width of a profile in -2 log L."""

CLOSE, BOUND_CLOSE = 1e-8, 1e-6
MOST_ROUNDS = 100

PROFILE, RIDGE = 0, 1


@compiled
def add_segment(x: Floats, sums: Floats) -> None:
    """Add the sums of one segment x (n,), NaN where missing, to `sums` (6, n).

    Rows are N, E, F, C, and the sums of x'-x and of x, by steps apart. In column 0 the first
    samples: their count, sum of squares, and sum (row 4).
    """
    before, last = -2, 0.0
    count, e, f, c, changes, lasts = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(x.size):
        value = x[i]
        if math.isnan(value):
            continue
        change = value - last
        if before == i - 1:
            count += 1.0
            e += change * change
            f += change * last
            c += last * last
            changes += change
            lasts += last
        elif before >= 0:
            put(sums, i - before, (1.0, change * change, change * last, last * last, change, last))
        else:
            put(sums, 0, (1.0, value * value, 0.0, 0.0, value, 0.0))
        before, last = i, value
    if count > 0.0:
        put(sums, 1, (count, e, f, c, changes, lasts))


@compiled
def put(sums: Floats, gap: int, values: tuple[float, float, float, float, float, float]) -> None:
    """Add to one column."""
    for row in range(6):
        sums[row, gap] += values[row]


@compiled
def compress(sums: Floats) -> Floats:
    """The columns of `sums` that hold anything, (7, m): steps apart, then the rows of `sums`."""
    used = 0
    for gap in range(sums.shape[1]):
        used += sums[0, gap] > 0.0
    packed, column = np.empty((7, used)), 0
    for gap in range(sums.shape[1]):
        if sums[0, gap] > 0.0:
            packed[0, column] = gap
            packed[1:, column] = sums[:, gap]
            column += 1
    return packed


@compiled
def centred(packed: Floats) -> Floats:
    """The sums (5, m) of the same segment less its mean."""
    total, count, m = 0.0, 0.0, 0.0
    for j in range(packed.shape[1]):
        total += packed[5, j] + packed[6, j]
        count += packed[1, j]
    m = total / count
    about = packed[:5].copy()
    first = packed[5, 0] - m
    about[2, 0] = first * first
    for j in range(1, packed.shape[1]):
        about[3, j] -= m * packed[5, j]
        about[4, j] += m * (m * packed[1, j] - 2.0 * packed[6, j])
    return about


@compiled
def terms(u: float, packed: Floats) -> tuple[float, float, float, float, float]:
    """n, D, Q of the likelihood at log tau = u, and the derivatives of D and Q with u."""
    count, squares = packed[1, 0], packed[2, 0]
    determinant, d_determinant, d_squares = 0.0, 0.0, 0.0
    rate = math.exp(-u)
    for j in range(1, packed.shape[1]):
        one_less = -math.expm1(-packed[0, j] * rate)
        phi = 1.0 - one_less
        variance = one_less * (1.0 + phi)
        d_one_less = -packed[0, j] * rate * phi
        d_variance = 2.0 * phi * d_one_less / variance
        half = packed[3, j] + one_less * packed[4, j]
        ratio = (packed[2, j] + one_less * (packed[3, j] + half)) / variance
        count += packed[1, j]
        determinant += packed[1, j] * math.log(variance)
        d_determinant += packed[1, j] * d_variance
        squares += ratio
        d_squares += 2.0 * half * d_one_less / variance - ratio * d_variance
    return count, determinant, squares, d_determinant, d_squares


@compiled
def slope(u: float, packed: Floats) -> float:
    """Derivative of the profile with u."""
    count, _, squares, d_determinant, d_squares = terms(u, packed)
    return count * d_squares / squares + d_determinant


@compiled
def rise(kind: int, u: float, packed: Floats, least: float) -> float:
    """-2 log L less its least: at the best s of u (PROFILE), or where u is the best of s (RIDGE).

    Infinite where u is the best of no s.
    """
    count, determinant, squares, d_determinant, d_squares = terms(u, packed)
    if kind == PROFILE:
        return count * (math.log(squares / count) + 1.0) + determinant - least
    s = -d_squares / d_determinant
    return count * math.log(s) + squares / s + determinant - least if s > 0.0 else math.inf


@compiled
def start(packed: Floats, span: tuple[float, float]) -> float:
    """A first u: from the regression of one sample on the last; with gaps, the best of many.

    Without gaps the profile has one minimum (its slope is a cubic in phi with one root between
    -1 and 1); with gaps there may be several.
    """
    if packed.shape[1] > 2:
        best, at_best = span[0], math.inf
        for i in range(int(span[1] - span[0]) + 1):
            value = rise(PROFILE, span[0] + i, packed, 0.0)
            if value < at_best:
                best, at_best = span[0] + i, value
        return best
    one_less = -packed[3, 1] / packed[4, 1] if packed[4, 1] > 0.0 else 1.0
    guess = packed[0, 1] / max(-math.log1p(-min(one_less, 0.999)), 1e-3)
    return min(max(math.log(guess), span[0]), span[1])


@compiled
def least_profile(packed: Floats, span: tuple[float, float]) -> float:
    """The u of the least profile: where its slope changes sign, next to `start`; else an end."""
    here = start(packed, span)
    at_here = slope(here, packed)
    end, step = (span[1], 0.25) if at_here < 0.0 else (span[0], -0.25)
    while True:
        there = here + step
        if (end - there) * step <= 0.0:
            there = end
        at_there = slope(there, packed)
        if at_here * at_there <= 0.0:
            return root_of_slope(packed, here, at_here, there, at_there)
        if there == end:
            return end
        here, at_here, step = there, at_there, 2.0 * step


@compiled
def root_of_slope(packed: Floats, a: float, at_a: float, b: float, at_b: float) -> float:
    """Root of the profile's slope between a and b, by the Illinois rule."""
    for _ in range(MOST_ROUNDS):
        if at_b == at_a:
            return b
        c = b - at_b * (b - a) / (at_b - at_a)
        at_c = slope(c, packed)
        close = min(abs(c - b), abs(c - a)) < CLOSE
        if at_c * at_b <= 0.0:
            a, at_a = b, at_b
        else:
            at_a *= 0.5
        b, at_b = c, at_c
        if close or at_c == 0.0:
            break
    return b


@compiled
def crossing(kind: int, packed: Floats, least: float, inside: float, outside: float) -> float:
    """Where the square root of `rise` passes that of 3.84, between u inside and outside.

    The root is close to a straight line in u. Illinois rule, halving where it is infinite.
    """
    aim = math.sqrt(CHI2_95)
    a, b = inside, outside
    at_a = math.sqrt(max(rise(kind, a, packed, least), 0.0)) - aim
    at_b = math.sqrt(max(rise(kind, b, packed, least), 0.0)) - aim
    if at_b <= 0.0:
        return outside
    if at_a >= 0.0:
        return inside
    side = 0
    for _ in range(MOST_ROUNDS):
        wide = math.isinf(at_b)
        c = 0.5 * (a + b) if wide else b - at_b * (b - a) / (at_b - at_a)
        at_c = math.sqrt(max(rise(kind, c, packed, least), 0.0)) - aim
        change = min(abs(c - a), abs(c - b))
        if at_c > 0.0:
            b, at_b = c, at_c
            at_a = 0.5 * at_a if side == 1 else at_a
            side = 1
        else:
            a, at_a = c, at_c
            at_b = 0.5 * at_b if side == -1 else at_b
            side = -1
        if change < BOUND_CLOSE:
            break
    return c


@compiled
def bound_of_tau(u: float, packed: Floats, least: float, end: float) -> float:
    """The u between the profile's least at u and `end` where it has risen by 3.84, or `end`."""
    inside, step = u, 1.0 if end > u else -1.0
    while inside != end:
        outside = inside + step
        if (end - outside) * step <= 0.0:
            outside = end
        if rise(PROFILE, outside, packed, least) > CHI2_95:
            return crossing(PROFILE, packed, least, inside, outside)
        inside, step = outside, 2.0 * step
    return end


@compiled
def edge_s(u: float, packed: Floats, level: float, upper: bool) -> float:
    """The largest or smallest s with -2 log L <= level at u: log r + 1 / r = g, s = r Q / n."""
    count, determinant, squares, _, _ = terms(u, packed)
    g = (level - determinant) / count - math.log(squares / count)
    half = max(g - 1.0, 0.0)
    first = math.sqrt(2.0 * half)
    w = first + half if upper else -first
    for _ in range(MOST_ROUNDS):
        steepness = -math.expm1(-w)
        if steepness == 0.0:
            break
        change = (w + math.exp(-w) - g) / steepness
        w -= change
        if abs(change) < CLOSE:
            break
    return squares / count * math.exp(w)


@compiled
def bounds(u: float, packed: Floats, span: tuple[float, float], out: Floats) -> None:
    """Fill out[1], out[2] and out[4], out[5] with the 95 % bounds of sigma and of tau.

    Where the profile of tau ends, s cannot be farther along the ridge.
    """
    least = rise(PROFILE, u, packed, 0.0)
    for side in range(2):
        end = span[side]
        at_tau = bound_of_tau(u, packed, least, end)
        at_sigma = crossing(RIDGE, packed, least, u, at_tau) if at_tau != u else u
        out[1 + side] = math.sqrt(edge_s(at_sigma, packed, least + CHI2_95, side == 1))
        out[4 + side] = end_of(side) if at_tau == end else math.exp(at_tau)


@compiled
def end_of(side: int) -> float:
    """The tau that an end of the search stands for."""
    return 0.0 if side == 0 else math.inf


@compiled
def fit(packed: Floats, span: tuple[float, float], bounded: bool, out: Floats) -> None:
    """Fill out (6,): sigma, its 95 % bounds, tau, its bounds; NaN where the samples fix none.

    `span` limits log tau; at its lower end tau is 0. Where all samples are equal the likelihood
    has no maximum. Unless `bounded` only sigma and tau are filled.
    """
    out[:] = math.nan
    if packed.shape[1] < 2 or packed[2, 1:].sum() <= 0.0:
        return
    u = least_profile(packed, span)
    if u >= span[1]:
        return
    count, _, squares, _, _ = terms(u, packed)
    out[0], out[3] = math.sqrt(squares / count), 0.0 if u <= span[0] else math.exp(u)
    if bounded:
        bounds(u, packed, span, out)


@compiled
def fit_each(x: Floats, span: tuple[float, float], out: Floats) -> None:
    """Fit every segment x (segments, n) about zero and about its mean: out (segments, 8).

    Columns: the six of `fit` about zero, then sigma and tau about the mean.
    """
    sums, about_mean = np.empty((6, x.shape[1])), np.empty(6)
    for i in range(x.shape[0]):
        out[i] = math.nan
        sums[:] = 0.0
        add_segment(x[i], sums)
        packed = compress(sums)
        if packed.shape[1] > 1:
            fit(packed, span, True, out[i, :6])
            fit(centred(packed), span, False, about_mean)
            out[i, 6], out[i, 7] = about_mean[0], about_mean[3]


@compiled
def fit_classes(
    x: Floats, members: NDArray[np.bool_], span: tuple[float, float], out: Floats
) -> None:
    """Joint fit of the segments x (segments, n) of each class: members (classes, segments).

    Fills out (classes, 6) as `fit` does.
    """
    classes, n = members.shape[0], x.shape[1]
    of_class, sums = np.zeros((classes, 6, n)), np.empty((6, n))
    for i in range(x.shape[0]):
        sums[:] = 0.0
        add_segment(x[i], sums)
        packed = compress(sums)
        for c in range(classes):
            if members[c, i]:
                for j in range(packed.shape[1]):
                    of_class[c, :, int(packed[0, j])] += packed[1:, j]
    for c in range(classes):
        fit(compress(of_class[c]), span, True, out[c])
