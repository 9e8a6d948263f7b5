"""Least-squares fit of s exp(-k / tau) to autocorrelations, compiled: import only when fitting.

With phi = exp(-1 / tau), tau in steps, the best s at a tau is A / S and what it explains of the
squares is A^2 / S, where A = sum_k w_k c_k phi^k and S = sum_k w_k phi^2k: a function of
u = log tau alone. It may have several maxima: the highest on a row of nodes is refined.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magtiles.catalog.kernels.jit import compiled

Floats = NDArray[np.float64]

CLOSE = 1e-8
MOST_ROUNDS = 60


@compiled
def lagged_products(x: Floats, out: Floats) -> None:
    """Sums of x_i x_(i+k) over i, out (rows, n), of each row of x (rows, n)."""
    n = x.shape[1]
    for row in range(x.shape[0]):
        for k in range(n):
            total = 0.0
            for i in range(n - k):
                total += x[row, i] * x[row, i + k]
            out[row, k] = total


@compiled
def sums(u: float, weights: Floats, values: Floats) -> tuple[float, float, float]:
    """A, S and the derivative with u of log(A^2 / S), of one row of lags.

    Even and odd lags have powers of their own: neither then waits for the other's product.
    """
    rate = math.exp(-u)
    even, odd, stride = 1.0, math.exp(-rate), math.exp(-2.0 * rate)
    across, d_across, square, d_square = 0.0, 0.0, 0.0, 0.0
    for k in range(0, values.size - 1, 2):
        one, other = weights[k] * even, weights[k + 1] * odd
        across += one * values[k] + other * values[k + 1]
        d_across += k * (one * values[k]) + (k + 1) * (other * values[k + 1])
        square += one * even + other * odd
        d_square += k * (one * even) + (k + 1) * (other * odd)
        even *= stride
        odd *= stride
    if values.size % 2:
        k = values.size - 1
        across += weights[k] * even * values[k]
        d_across += k * weights[k] * even * values[k]
        square += weights[k] * even * even
        d_square += k * weights[k] * even * even
    return across, square, 2.0 * rate * (d_across / across - d_square / square)


@compiled
def fit_rows(nodes: Floats, powers: Floats, weights: Floats, values: Floats, out: Floats) -> None:
    """Sigma and tau, out (rows, 2), of each row of lags; weights, values (rows, lags).

    Weights are one or, where no two samples are so far apart, zero. `nodes` are values of u,
    powers (lags, nodes) the phi^k there. tau is 0 at the first node.
    NaN where all values are zero or no two samples are there.
    """
    whole = (powers * powers).sum(axis=0)
    for i in range(values.shape[0]):
        out[i] = math.nan
        if not (values[i, 0] > 0.0 and weights[i].sum() > 1.0):
            continue
        best = highest(powers, whole, weights[i], values[i])
        u = refined(nodes, best, weights[i], values[i])
        across, square, _ = sums(u, weights[i], values[i])
        out[i, 0], out[i, 1] = math.sqrt(across / square), math.exp(u) if u > nodes[0] else 0.0


@compiled
def highest(powers: Floats, whole: Floats, weights: Floats, values: Floats) -> int:
    """The node where A > 0 and A^2 / S is greatest; `whole` is S (nodes,) of weights of one."""
    across, square = np.zeros(whole.size), whole.copy()
    for k in range(values.size):
        for j in range(whole.size):
            across[j] += values[k] * powers[k, j]
        if weights[k] == 0.0:
            for j in range(whole.size):
                square[j] -= powers[k, j] * powers[k, j]
    best, explained = 0, 0.0
    for j in range(whole.size):
        if across[j] > 0.0 and across[j] * across[j] > explained * square[j]:
            best, explained = j, across[j] * across[j] / square[j]
    return best


@compiled
def refined(nodes: Floats, best: int, weights: Floats, values: Floats) -> float:
    """The u of the greatest A^2 / S between the best node and those beside it."""
    u = nodes[best]
    at_u = sums(u, weights, values)[2]
    there = min(max(best + (1 if at_u > 0.0 else -1), 0), nodes.size - 1)
    at_there = sums(nodes[there], weights, values)[2]
    return (
        nodes[there]
        if at_u * at_there > 0.0
        else turning(u, at_u, nodes[there], at_there, weights, values)
    )


@compiled
def turning(a: float, at_a: float, b: float, at_b: float, weights: Floats, values: Floats) -> float:
    """Root of the derivative between a and b."""
    for _ in range(MOST_ROUNDS):
        c = b - at_b * (b - a) / (at_b - at_a)
        at_c = sums(c, weights, values)[2]
        close = min(abs(c - a), abs(c - b)) < CLOSE
        if at_c * at_b <= 0.0:
            a, at_a = b, at_b
        else:
            at_a *= 0.5
        b, at_b = c, at_c
        if close or at_c == 0.0 or at_b == at_a:
            break
    return b
