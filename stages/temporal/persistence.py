"""How well the last segment predicts the next, against the average of all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def persistence(values: Floats, follows: NDArray[np.bool_]) -> float:
    """Rms error of the last value as the prediction of the next, over that of the average.

    Below 1 the last value predicts better, above 1 the average. Independent values give
    sqrt(2); an autocorrelation r from one to the next gives sqrt(2 (1 - r)). Canciani and
    Raquet (2016) found the last segment's sigma and tau the best predictors of the next.

    Parameters
    ----------
    values : (segment,); for sigma and tau take logarithms. NaN where unknown.
    follows : (segment - 1,), whether segment i + 1 begins where segment i ends.

    Returns
    -------
    The ratio; NaN with fewer than two pairs, or where nothing varies.
    """
    last, following = values[:-1], values[1:]
    known = follows & np.isfinite(last) & np.isfinite(following)
    if np.count_nonzero(known) < 2:
        return float("nan")
    average = float(np.mean(values[np.isfinite(values)]))
    error = np.sum((following[known] - last[known]) ** 2)
    spread = np.sum((following[known] - average) ** 2)
    return float(np.sqrt(error / spread)) if spread > 0.0 else float("nan")
